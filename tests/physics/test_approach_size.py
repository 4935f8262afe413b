"""An error that grows with a joint's last move: found in a simulated campaign, with its size."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from robcal.calibration.joint_log import JointLog
from robcal.calibration.observations import PointObservations
from robcal.diagnosis.diagnose import diagnose
from robcal.robot.kernel import Kernel
from robcal.transforms import retract
from tests.diagnosis.recordings import concealed


def test_moves_follow_from_the_order_of_the_rows() -> None:
    q = np.array([[0.0, 1.0], [0.5, 1.0], [0.2, 3.0]])
    log = JointLog(("a", "b", "c"), q, (None,) * 3, np.zeros(3, bool), np.ones((3, 2)))
    assert np.allclose(log.stated()["move1"], [0.0, 0.5, -0.3])
    unknown = replace(log, approach=np.zeros((3, 2)))
    assert not np.any(unknown.stated()["move2"])


def test_it_is_found_where_it_is_and_as_large_as_it_is(tmp_path: Path) -> None:
    found, recording, _, _ = concealed(tmp_path, seed=100, effects=[], poses=60)
    share = -6e-4
    kernel = Kernel(found.model)
    inputs = recording.inputs(kernel)
    twist = kernel.joint_jacobian(kernel.theta0, inputs)[:, :, 2] * share * recording.covariates["move3"][:, None]
    tool = kernel.frames(kernel.theta0, inputs)
    change = retract(tool, twist) @ np.linalg.inv(tool)
    points = recording.observations
    assert isinstance(points, PointObservations)
    T = change[points.pose]
    moved = np.einsum("mij,mj->mi", T[:, :3, :3], points.p_world) + T[:, :3, 3]
    spoilt = replace(recording, observations=replace(points, p_world=moved))
    diagnosis = diagnose(found.model, spoilt, found.names, found.eliminated)
    first = diagnosis.findings[0]
    assert (first.cause.name, first.cause.where) == ("approach_size", "axis3")
    assert first.parameters["deg_per_deg"] == pytest.approx(share, abs=4.0 * float(str(first.sigma["deg_per_deg"])))
    assert diagnosis.model.terms[0].expression == "share*(move3)"
