"""Which points and poses the distances to other targets condemn, and under which name."""

import numpy as np
import pytest

from robcal.errors import DegenerateGeometry
from robcal.photogrammetry.core.bodies import Body
from robcal.photogrammetry.measure.elimination import PoseFault
from robcal.photogrammetry.measure.frames import measure_frames
from robcal.photogrammetry.measure.measured_points import MeasuredPoints
from robcal.transforms import retract, transform

POINTS = np.array([[0, 0, 0], [0.3, 0, 0], [0, 0.25, 0], [0.3, 0.25, 0.02], [0.15, 0.1, 0.05]])
BODY = Body("plate", np.arange(1, 6), POINTS)
SIGMA = 2e-5


def _measured(rng: np.random.Generator, poses: int = 8) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    T = [retract(np.eye(4), np.concatenate([rng.uniform(-1, 1, 3), rng.normal(size=3)])) for _ in range(poses)]
    p = np.array([transform(t, POINTS) for t in T]) + SIGMA * rng.normal(size=(poses, 5, 3))
    return np.repeat(np.arange(poses), 5), np.tile(np.arange(1, 6), poses), p.reshape(-1, 3)


def _points(pose: np.ndarray, target: np.ndarray, p: np.ndarray) -> MeasuredPoints:
    m = len(pose)
    C = np.tile(SIGMA**2 * np.eye(3), (m, 1, 1))
    return MeasuredPoints(pose, target, p, C, np.full(m, 2), np.full(m, np.nan))


def test_one_wrong_point_goes_alone() -> None:
    pose, target, p = _measured(np.random.default_rng(1))
    p[5 * 2 + 3] += [0.0, 1e-3, 0.0]
    done = measure_frames(_points(pose, target, p), BODY)
    assert [(r.pose, r.target) for r in done.rejected_points] == [(2, 4)]
    assert done.rejected_poses == ()
    assert done.targets[2] == (1, 2, 3, 5)


@pytest.mark.parametrize(
    ("keep", "shifted", "fault"), [([0, 1], [], PoseFault.FEW_TARGETS), ([0, 1, 2, 3, 4], [0, 1, 2], PoseFault.LENGTHS)]
)
def test_pose_without_a_frame_has_the_fault_by_name(keep: list[int], shifted: list[int], fault: PoseFault) -> None:
    rng = np.random.default_rng(2)
    pose, target, p = _measured(rng)
    for i in shifted:
        p[15 + i] += rng.normal(size=3) * 5e-3
    use = (pose != 3) | np.isin(np.tile(np.arange(5), 8), keep)
    done = measure_frames(_points(pose[use], target[use], p[use]), BODY)
    assert [(r.pose, r.fault) for r in done.rejected_poses] == [(3, fault)]


def test_mirrored_body_misfits_and_is_not_a_matter_of_lengths() -> None:
    pose, target, p = _measured(np.random.default_rng(3))
    p[20:25] = p[20:25] * [1, 1, -1]  # distances stay, the hand changes
    done = measure_frames(_points(pose, target, p), BODY)
    assert [(r.pose, r.fault) for r in done.rejected_poses] == [(4, PoseFault.MISFIT)]


def test_misfit_of_most_poses_is_evidence_not_a_fault() -> None:
    pose, target, p = _measured(np.random.default_rng(4))
    done = measure_frames(_points(pose, target, p * [1, 1, -1]), BODY)
    assert done.rejected_poses == ()
    assert len(done.pose) == 8
    assert any("evidence" in note for note in done.notes)


def test_targets_in_a_line_carry_no_frame() -> None:
    line = Body("rod", np.arange(1, 6), np.outer(np.arange(5.0), [0.1, 0.0, 0.0]))
    pose, target, p = _measured(np.random.default_rng(5))
    with pytest.raises(DegenerateGeometry, match="line"):
        measure_frames(_points(pose, target, p), line)
