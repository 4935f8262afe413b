"""Functions of the gravity regressor against the moments of the statics."""

from dataclasses import replace

import numpy as np
import pytest

from robcal.robot.gravity_regressor import direction_of_gravity, expressions, regressor
from robcal.robot.kernel import Kernel
from robcal.robot.model import Frame, RobotModel
from robcal.robot.terms import evaluate, identifier

HALF = np.pi / 2
CHAIN = (
    Frame("axis1", "z", xyz=(0.0, 0.0, 0.4)),
    Frame("axis2", "y", sign=-1, xyz=(0.2, 0.0, 0.0), rpy=(0.0, 0.3, 0.0)),
    Frame("axis3", "y", xyz=(0.8, 0.0, 0.0), rpy=(0.2, 0.0, 0.0)),
    Frame("slide", "x", prismatic=True, xyz=(0.1, 0.0, 0.2), rpy=(0.0, 0.0, HALF)),
    Frame("axis5", "x", xyz=(0.6, 0.0, 0.0), rpy=(0.0, 0.0, 0.4)),
    Frame("flange", xyz=(0.1, 0.0, 0.0), rpy=(0.0, HALF, 0.0)),
)


@pytest.mark.parametrize("frame", ["axis2", "axis3", "axis5"])
@pytest.mark.parametrize("angle", ["roll", "pitch", "yaw"])
def test_moments_of_any_masses_are_in_the_span(frame: str, angle: str) -> None:
    rng = np.random.default_rng(3)
    heavy = tuple(replace(f, mass=float(rng.uniform(1, 20)), cog=tuple(rng.normal(0, 0.2, 3))) for f in CHAIN)
    model = RobotModel("heavy", heavy, gravity=(2.0, -1.0, -9.0))
    kernel = Kernel(model)
    q = rng.uniform(-1.5, 1.5, (60, 5))
    variables = kernel.variables(kernel.theta0, kernel.poses(q))
    moment = variables[f"{identifier(frame)}_m{angle}"]
    laws = regressor(CHAIN, direction_of_gravity(model), frame, angle, len(CHAIN))
    columns = [sum(np.broadcast_to(evaluate(t, variables), 60) for t in expressions(law)) for law in laws]
    A = np.column_stack([np.ones(60), *columns])
    assert np.linalg.matrix_rank(A) == A.shape[1]
    left = moment - A @ np.linalg.lstsq(A, moment, rcond=None)[0]
    assert np.abs(left).max() < 1e-4 * np.abs(moment).max()


def test_an_upright_axis_has_none() -> None:
    gravity = direction_of_gravity(RobotModel("upright", CHAIN))
    assert regressor(CHAIN, gravity, "axis1", "yaw", 4) == ()
    assert len(regressor(CHAIN, gravity, "axis2", "pitch", 1)) == 2
