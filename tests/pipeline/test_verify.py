"""Which kept-out poses the verification counts."""

from dataclasses import replace

import numpy as np

from robcal import transforms as tf
from robcal.calibration.identification import identify
from robcal.calibration.measurements import RobotRecording, well_measured
from robcal.calibration.observations import DistanceObservations, FrameObservations
from robcal.recipe.verification import measured_elsewhere
from tests.calibration.scenarios import scenario

NAMES = [f"p{i}" for i in range(20)]


def recording(sigma_mm: list[float]) -> RobotRecording:
    sigma = np.array(sigma_mm) / 1e3
    covariance = (sigma**2)[:, None, None] * np.eye(6)
    frames = FrameObservations(np.arange(len(sigma)), np.tile(np.eye(4), (len(sigma), 1, 1)), covariance)
    return RobotRecording((frames,), (frames,), True)


def test_a_pose_seen_by_one_camera_only_is_left_out_and_named() -> None:
    kept, notes = well_measured(recording([0.05] * 19 + [3.0]), np.array([16, 17, 18, 19]), NAMES)
    np.testing.assert_array_equal(kept, [16, 17, 18])
    assert len(notes) == 1
    assert "p19" in notes[0]
    assert "3 mm only (usual: 0.05 mm)" in notes[0]


def test_evenly_measured_poses_all_count() -> None:
    rows = np.array([16, 17, 18, 19])
    for sigma in ([0.05] * 20, [0.05] * 16 + [0.3] * 4, [0.05] * 16 + [0.05, 3.0, 3.0, 3.0]):
        kept, notes = well_measured(recording(sigma), rows, NAMES)
        np.testing.assert_array_equal(kept, rows)
        assert notes == []


def test_kept_out_poses_measured_from_another_place_are_told() -> None:
    s = scenario(3)
    robot = identify(s.model, s.poses, [s.frames(s.poses)])
    rows, kept_out = np.arange(len(s.poses) // 2), np.arange(len(s.poses) // 2, len(s.poses))
    frames = s.frames(s.poses)
    still = RobotRecording((frames,), (frames,), True)
    assert measured_elsewhere(robot, s.poses, still, rows, kept_out) == ""
    world = tf.frame_from_xyzrpy([0.3, -0.2, 0.1, 0.0, 0.01, 0.02])
    moved = frames.world_T_tool.copy()
    moved[kept_out] = world @ moved[kept_out]
    other = replace(frames, world_T_tool=moved)
    assert "another place" in measured_elsewhere(
        robot, s.poses, RobotRecording((other,), (other,), True), rows, kept_out
    )


def test_a_wrong_length_of_a_wire_is_no_other_place() -> None:
    s = scenario(3)
    robot = identify(s.model, s.poses, [s.frames(s.poses)])
    n = len(s.poses)
    rows, kept_out = np.arange(n // 2), np.arange(n // 2, n)
    length = np.linalg.norm(s.frames(s.poses).world_T_tool[:, :3, 3], axis=1)
    length[kept_out] += 0.3
    wire = DistanceObservations(np.arange(n), length, np.full(n, 5e-5))
    assert measured_elsewhere(robot, s.poses, RobotRecording((wire,), (wire,), True), rows, kept_out) == ""
