"""The map of the predicted error, and poses that would help, against the covariance itself."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from robcal.calibration.calibrated import CalibratedRobot
from robcal.calibration.workspace import helpful_poses, inputs_at, joint_limits, largest_gaps, sampled, workspace_map
from robcal.files.robot_file import read_robot

ROBOT = Path(__file__).parents[2] / "configs" / "robots" / "kr150_class.yaml"
MEASURED = np.diag([2e-5**2] * 3 + [1e-4**2] * 3)


@pytest.fixture(scope="module")
def robot() -> CalibratedRobot:
    """Identified from 25 poses of a quarter of the workspace."""
    model = read_robot(ROBOT)
    names = ("axis1.yaw", "axis2.pitch", "axis3.pitch", "axis3.x", "axis4.roll", "axis5.pitch")
    bare = CalibratedRobot(model=model, names=names, covariance=np.eye(6))
    lower, upper = joint_limits(bare)
    q = np.random.default_rng(2).uniform(lower, upper, (25, 6)) * 0.4
    T, J = bare.kernel.frames_and_jacobian(bare.kernel.theta0, inputs_at(bare, q, None), bare.columns)
    information = np.einsum("nip,ij,njq->pq", J, np.linalg.inv(MEASURED), J)
    return replace(bare, covariance=np.linalg.inv(information), q=q, tools=T)


def test_the_map_holds_the_worst_of_its_poses(robot: CalibratedRobot) -> None:
    q = sampled(robot, 9)
    found = workspace_map(robot, None, q)
    _, C = robot.predict(inputs_at(robot, q, None))
    error = np.sqrt(np.trace(C[:, :3, :3], axis1=1, axis2=2))
    np.testing.assert_allclose(found.error, error)
    assert np.nanmax(found.worst) == pytest.approx(error.max())
    assert np.isfinite(found.worst).sum() <= len(q)
    assert found.worst.shape == (len(found.height), len(found.radius))


def test_measuring_what_is_proposed_lowers_the_worst_error_as_promised(robot: CalibratedRobot) -> None:
    q = sampled(robot, 10)
    found = helpful_poses(robot, None, MEASURED, q, count=3)
    assert found is not None
    assert found.before == pytest.approx(workspace_map(robot, None, q).error.max(), rel=1e-6)
    assert np.all(np.diff([found.before, *found.after]) < 0)
    kernel = robot.kernel
    J = kernel.frames_and_jacobian(kernel.theta0, inputs_at(robot, found.q, None), robot.columns)[1]
    added = np.einsum("nip,ij,njq->pq", J, np.linalg.inv(MEASURED), J)
    better = replace(robot, covariance=np.linalg.inv(np.linalg.inv(robot.covariance) + added))
    assert found.after[-1] == pytest.approx(workspace_map(better, None, q).error.max(), rel=1e-3)
    # poses of the recording again help less than those proposed
    again = robot.q[:3]
    J = kernel.frames_and_jacobian(kernel.theta0, inputs_at(robot, again, None), robot.columns)[1]
    added = np.einsum("nip,ij,njq->pq", J, np.linalg.inv(MEASURED), J)
    same = replace(robot, covariance=np.linalg.inv(np.linalg.inv(robot.covariance) + added))
    assert found.after[-1] < workspace_map(same, None, q).error.max()


def test_the_largest_gap_of_each_joint() -> None:
    q = np.array([[0.1, 0.5], [0.2, 0.6], [0.9, 0.7]])
    share, start, end = largest_gaps(q, np.zeros(2), np.ones(2))
    np.testing.assert_allclose(share, [0.8, 0.2])
    np.testing.assert_allclose(start, [0.2, 0.0])
    np.testing.assert_allclose(end, [0.9, 0.5])
