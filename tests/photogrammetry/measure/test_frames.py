"""Points to frames: honest covariance, distance criterion, recurring evidence, unknown bodies, single cameras."""

from dataclasses import replace

import numpy as np
import pytest

from robcal.errors import DegenerateGeometry, InvalidInput
from robcal.photogrammetry.core.bodies import Body
from robcal.photogrammetry.measure.distance_criterion import culprits
from robcal.photogrammetry.measure.frames import measure_frames
from robcal.photogrammetry.measure.measured_points import MeasuredPoints
from robcal.photogrammetry.measure.points import measure_points
from robcal.photogrammetry.station.orientation import orient_station
from robcal.transforms import difference, exp_so3, frame, transform
from tests.photogrammetry.stations import PLATE, nees, simulate

SIGMA = 5e-5
BODY = Body("plate", 11 * np.arange(1, 6), PLATE)


def _points(seed=0, poses=40, stated=True, points=PLATE):
    rng = np.random.default_rng(seed)
    T = frame(exp_so3(rng.normal(size=(poses, 3))), rng.normal(size=(poses, 3)))
    t = len(points)
    p = transform(T[:, None], points) + rng.normal(size=(poses, t, 3)) * SIGMA
    C = np.tile(np.eye(3) * SIGMA**2, (poses * t, 1, 1)) if stated else None
    ids = np.tile(11 * np.arange(1, t + 1), poses)
    return T, MeasuredPoints.from_table(np.repeat(np.arange(poses), t), ids, p.reshape(-1, 3), C)


@pytest.mark.parametrize("stated", [True, False])
def test_covariance_of_frames(stated):
    values = []
    for seed in range(3):
        T, points = _points(seed, poses=100, stated=stated)
        f = measure_frames(points, BODY)
        assert len(f.pose) == 100
        values.append(nees(difference(f.world_T_body, T), f.covariance).mean())
    assert 0.9 < np.mean(values) < 1.12
    assert f.sigma is None if stated else abs(f.sigma / SIGMA - 1) < 0.1


def test_isolated_errors_are_eliminated():
    T, points = _points()
    p = points.p_world.copy()
    p[7 * 5 + 2] += [0.002, 0.0, 0.001]
    ids = points.target.copy()
    ids[[9 * 5, 9 * 5 + 1]] = ids[[9 * 5 + 1, 9 * 5]]
    f = measure_frames(replace(points, p_world=p, target=ids), BODY)
    assert {(r.pose, r.target) for r in f.rejected_points} == {(7, 33), (9, 11), (9, 22)}
    assert len(f.pose) == 40
    assert np.linalg.norm(difference(f.world_T_body, T)[:, :3], axis=1).max() < 4e-4
    assert not f.left_out


def test_pose_with_too_many_errors_is_rejected_with_reason():
    _, points = _points()
    p = points.p_world.copy()
    p[15:20] += np.random.default_rng(1).normal(size=(5, 3)) * 0.01
    f = measure_frames(replace(points, p_world=p), BODY)
    assert [r.pose for r in f.rejected_poses] == [3]
    assert "fewer than three" in f.rejected_poses[0].reason


@pytest.mark.parametrize("tolerance", [None, 0.00025])
def test_shifted_target_recurs_and_poses_survive(tolerance):
    T, points = _points()
    wrong = PLATE.copy()
    wrong[2, 0] += 0.001
    f = measure_frames(points, replace(BODY, points=wrong), tolerance=tolerance)
    assert len(f.pose) == 40
    assert f.left_out == (33,)
    assert not f.rejected_points
    assert np.allclose(f.recurring.targets[0].shift, [-0.001, 0, 0], atol=1e-4)
    # the other four carry the frame
    assert np.linalg.norm(difference(f.world_T_body, T)[:, :3], axis=1).max() < 4e-4


def test_shift_across_the_plane():
    rng = np.random.default_rng(3)
    plate = np.column_stack([rng.uniform(-0.2, 0.2, (10, 2)), np.zeros(10)])
    _, points = _points(points=plate)
    wrong = plate.copy()
    wrong[4, 2] += 0.0005
    f = measure_frames(points, Body("plate", 11 * np.arange(1, 11), wrong))
    assert f.left_out == (55,)
    assert len(f.pose) == 40


def test_swapped_targets_are_told():
    _, points = _points()
    wrong = PLATE.copy()
    wrong[[0, 3]] = wrong[[3, 0]]
    f = measure_frames(points, replace(BODY, points=wrong))
    assert {(t.target, t.swapped_with) for t in f.recurring.targets} == {(11, 44), (44, 11)}
    assert len(f.pose) == 40


def test_common_scale_is_evidence():
    _, points = _points()
    f = measure_frames(replace(points, p_world=points.p_world * (1 + 1.5e-3)), BODY)
    assert len(f.pose) == 40
    assert abs(f.recurring.scale_ppm - 1500) < 100
    assert not f.left_out


def test_no_false_evidence():
    found = [measure_frames(_points(seed)[1], BODY).recurring for seed in range(20)]
    assert not any(r.pairs or r.targets or r.scale_ppm for r in found)


def test_unknown_body_by_gram_schmidt():
    T, points = _points(poses=60)
    three = np.isin(points.target, [11, 22, 44])
    few = MeasuredPoints.from_table(points.pose[three], points.target[three], points.p_world[three])
    f = measure_frames(few, None)
    assert set(f.method) == {"gram_schmidt"}
    # the frame is the true one times one constant frame
    constant = np.linalg.inv(T[0]) @ f.world_T_body[0]
    d = difference(T @ constant, f.world_T_body)
    assert np.linalg.norm(d[:, :3], axis=1).max() < 1e-3
    assert np.allclose(f.body.points[0], 0.0, atol=1e-9)
    assert np.allclose(f.body.points[1, 1:], 0.0, atol=1e-9)
    f5 = measure_frames(points, None)
    assert len(f5.body) == 5
    assert np.isfinite(f5.body.points).all()


def test_degenerate_bodies_and_poses():
    line = Body("line", 11 * np.arange(1, 6), np.column_stack([np.arange(5) * 0.1, np.zeros(5), np.zeros(5)]))
    with pytest.raises(DegenerateGeometry, match="one line"):
        measure_frames(_points(points=line.points)[1], line)
    _, points = _points()
    keep = (points.pose != 4) | np.isin(points.target, [11, 22])
    f = measure_frames(MeasuredPoints.from_table(points.pose[keep], points.target[keep], points.p_world[keep]), BODY)
    assert [r.pose for r in f.rejected_poses] == [4]
    with pytest.raises(InvalidInput, match="above zero"):
        measure_frames(points, BODY, tolerance=0.0)
    with pytest.raises(InvalidInput, match="more than once"):
        MeasuredPoints.from_table([1, 1], [11, 11], np.zeros((2, 3)))
    with pytest.raises(InvalidInput, match="not a number"):
        MeasuredPoints.from_table([1, 1], [11, 22], np.full((2, 3), np.nan))


def test_culprits_are_the_smallest_set():
    badness = np.ones((6, 6))
    assert culprits(6, [], badness) == set()
    assert culprits(6, [(0, 1), (0, 2), (0, 3)], badness) == {0}
    badness[1, 4] = badness[4, 1] = 50.0
    assert culprits(6, [(0, 1)], badness) == {1}
    assert culprits(4, [(0, 1), (2, 3)], badness) is None


def test_single_camera_poses_come_by_resection():
    s = simulate(seed=6, poses=30, points=9, flat=False)
    m = s.marks["right"]
    blind = m.pose < 10
    s.change("right", pose=m.pose[~blind], target=m.target[~blind], xy=m.xy[~blind], covariance=m.covariance[~blind])
    o = orient_station(s.marks, s.body, s.cameras, s.sizes)
    points = measure_points(o, s.marks)
    assert set(points.n_cameras[points.pose < 10]) == {1}
    f = measure_frames(points, s.body)
    assert [f.method[i] for i in np.flatnonzero(f.pose < 10)] == ["resection"] * 10
    d = difference(f.world_T_body, s.world_T_body[f.pose])
    total = f.covariance + f.common_covariance
    assert 0.3 < nees(d, total)[f.pose < 10].mean() < 3.0
    # along the line of sight it is worse than across
    values = np.linalg.eigvalsh(f.covariance[f.pose < 10][:, :3, :3])
    assert (values[:, 2] > 9 * values[:, 0]).all()


def test_plane_before_one_camera():
    s = simulate(seed=7, poses=25, cameras=1)
    o = orient_station(s.marks, s.body, s.cameras, s.sizes)
    f = measure_frames(measure_points(o, s.marks), s.body)
    assert set(f.method) == {"resection"}
    assert len(f.pose) + len(f.rejected_poses) == 25
    turn = np.linalg.norm(difference(f.world_T_body, s.world_T_body[f.pose])[:, 3:], axis=1)
    assert turn.max() < 0.02  # never the mirrored pose


def test_targets_without_coordinates_do_not_spoil_the_covariance():
    _, points = _points()
    t = len(PLATE) + 1
    C = np.full((3 * t, 3 * t), np.nan)
    C[:-3, :-3] = np.eye(3 * t - 3) * 1e-12
    body = Body("plate", np.r_[BODY.ids, 99], np.r_[PLATE, np.full((1, 3), np.nan)], C)
    f = measure_frames(points, body)
    assert np.isfinite(f.common_covariance).all()
    assert len(f.pose) == 40
