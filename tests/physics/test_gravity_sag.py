"""Sag of an arm whose masses are not stated: found, with its axes, and predicted where nobody measured."""

from dataclasses import replace

import numpy as np

from robcal.calibration.observations import FrameObservations
from robcal.diagnosis.core.recording import Recording
from robcal.diagnosis.diagnose import diagnose
from robcal.physics.gravity_sag import without_masses
from robcal.robot.kernel import Kernel
from robcal.robot.model import Frame, RobotModel
from robcal.transforms import retract

ARM = (
    Frame("axis1", "z", xyz=(0.0, 0.0, 0.4)),
    Frame("axis2", "y", xyz=(0.2, 0.0, 0.0), mass=60.0, cog=(0.4, 0.0, 0.0)),
    Frame("axis3", "y", xyz=(0.9, 0.0, 0.0), mass=40.0, cog=(0.3, 0.0, 0.1)),
    Frame("axis4", "x", xyz=(0.7, 0.0, 0.1), mass=5.0, cog=(0.1, 0.0, 0.0)),
    Frame("flange", xyz=(0.1, 0.0, 0.0)),
)
FREE = tuple(f"{frame}.{kind}" for frame in ("axis2", "axis3", "axis4") for kind in ("x", "z", "pitch", "yaw"))
CELL = tuple(f"base.{kind}" for kind in ("x", "y", "z", "roll", "pitch", "yaw"))


def recorded(seed: int, count: int) -> Recording:
    rng = np.random.default_rng(seed)
    heavy = RobotModel("arm", ARM, parameters={"axis2.elastic_pitch": 2e-6, "axis3.elastic_pitch": 3e-6})
    kernel = Kernel(heavy, "converged")
    q = rng.uniform(-1.3, 1.3, (count, 4))
    sigma = np.repeat([2e-5, 2e-5], 3)
    measured = retract(kernel.frames(kernel.theta0, kernel.poses(q)), sigma * rng.standard_normal((count, 6)))
    covariance = np.tile(np.diag(sigma**2), (count, 1, 1))
    names = tuple(f"p{i}" for i in range(count))
    index = {"index": np.arange(count, dtype=float)}
    return Recording(q, (None,) * count, index, names, FrameObservations(np.arange(count), measured, covariance))


def test_sag_without_masses_is_found_and_predicted() -> None:
    light = RobotModel("arm", tuple(replace(f, mass=0.0, cog=(0.0, 0.0, 0.0)) for f in ARM))
    assert without_masses(light)
    diagnosis = diagnose(light, recorded(1, 60), (*CELL, *FREE), verify=recorded(2, 30))
    found = {(f.cause.name, f.cause.where, f.cause.direction) for f in diagnosis.findings}
    assert found == {("gravity_sag", "axis2", "y"), ("gravity_sag", "axis3", "y")}
    assert all(f.parameters["moment_free"] is True for f in diagnosis.findings)
    before, after, floor = diagnosis.heldout
    assert before > 3.0 * floor
    assert after < 1.2 * floor
    assert {term.cause for term in diagnosis.model.terms} == {"gravity_sag"}
