"""Stated sigmas that the residuals contradict are not those of the weights."""

import numpy as np
import pytest

from robcal.calibration.identification import IdentifiedRobot, IdentifyOptions
from robcal.calibration.measurements import RobotRecording
from robcal.calibration.observations import FrameObservations, PointObservations
from robcal.calibration.variance_components import identify_recording
from robcal.robot.kernel import Kernel
from tests.calibration.scenarios import scenario

SIGMA, TURN = 5e-5, 1e-4
POINTS = np.array([[0.2, 0.0, 0.05], [-0.15, 0.2, 0.0], [0.0, -0.2, 0.1]])


def _identified(
    stated: float, *, points: bool = False, seed: int = 3
) -> tuple[IdentifiedRobot, RobotRecording, float, float]:
    """A robot from frames (or three targets) whose stated sigmas are a factor off; the recording that was used; its
    mean error and its mean predicted sigma at kept-out poses, m."""
    s = scenario(seed, n=60)
    T = s.truth.frames(s.theta, s.poses)
    made: FrameObservations | PointObservations
    if points:
        n = len(T)
        pose, place = np.repeat(np.arange(n), 3), np.tile(POINTS, (n, 1))
        p = np.einsum("nij,nj->ni", T[pose, :3, :3], place) + T[pose, :3, 3] + SIGMA * s.rng.normal(size=(3 * n, 3))
        said = np.tile((stated * SIGMA) ** 2 * np.eye(3), (3 * n, 1, 1))
        made = PointObservations(pose, place, p, said, np.tile(np.arange(3), n))
    else:
        made = FrameObservations.isotropic(s.frames(s.poses).world_T_tool, stated * SIGMA, stated * TURN)
    recording = RobotRecording((made,), (made,), stated=True)
    rows = np.arange(len(T))
    kernel = Kernel(s.model)
    found, used = identify_recording(s.model, s.poses, recording, rows, IdentifyOptions(), kernel)
    predicted, C = found.predict(s.kept_out)
    miss = np.linalg.norm((predicted - s.truth.frames(s.theta, s.kept_out))[:, :3, 3], axis=1)
    return found, used, float(np.sqrt(np.mean(miss**2))), float(np.sqrt(np.mean(np.trace(C[:, :3, :3], 0, 1, 2))))


@pytest.mark.parametrize("points", [False, True])
@pytest.mark.parametrize("stated", [0.05, 1.0, 2.0, 20.0])
def test_robot_and_its_uncertainty_do_not_depend_on_a_wrong_stated_sigma(stated: float, points: bool) -> None:
    right, _, least, _ = _identified(1.0, points=points)
    found, used, miss, sigma = _identified(stated, points=points)
    assert set(found.names) == set(right.names)
    assert miss == pytest.approx(least, rel=0.02)
    assert 0.5 < miss / sigma < 2.0
    assert (used.weighted != 1.0) == (stated > 1.0 or (points and stated < 1.0))


def test_what_the_model_misses_does_not_make_a_stated_sigma_wrong() -> None:
    s = scenario(5, n=60)
    T = s.frames(s.poses).world_T_tool.copy()
    T[:, 0, 3] += 1e-3 * np.sin(5.0 * s.poses.q[:, 1])
    made = FrameObservations.isotropic(T, SIGMA, TURN)
    recording = RobotRecording((made,), (made,), stated=True)
    found, used = identify_recording(
        s.model, s.poses, recording, np.arange(60), IdentifyOptions(robust=False), Kernel(s.model)
    )
    assert found.sigma0 > 3.0
    assert used is recording
