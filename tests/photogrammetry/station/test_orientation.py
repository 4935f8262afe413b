"""Orientation of a station: truth, honest covariance, and what recurs in the data told apart from blunders."""

from dataclasses import replace

import numpy as np
import pytest

from robcal.errors import DegenerateGeometry, InvalidInput
from robcal.photogrammetry.core.bodies import Body
from robcal.photogrammetry.core.camera import Camera, project
from robcal.photogrammetry.measure.points import measure_points
from robcal.photogrammetry.station.adjustment import linearise
from robcal.photogrammetry.station.network import StationMarks, StationSettings, Unknowns
from robcal.photogrammetry.station.orientation import orient_station
from robcal.photogrammetry.station.start import find_swap, resect_station
from robcal.transforms import exp_so3, frame, retract, transform
from tests.photogrammetry.stations import SIZE, Station, nees, simulate


def _orient(s: Station, cameras=None, **settings):
    return orient_station(s.marks, s.body, cameras or s.rough, s.sizes, settings=StationSettings(**settings))


def test_derivatives_against_differences():
    s = simulate(poses=3)
    o = _orient(s, s.cameras)
    x = Unknowns(np.array([c.vector for c in o.cameras]), o.world_T_exterior, o.world_T_body, o.body.points)
    marks = replace(o.marks, radius=np.full(len(o.marks), np.nan))
    lin = linearise(marks, x, o.cameras, np.ones(2))
    for k in range(6):
        step = np.zeros(6)
        step[k] = 1e-7
        for changed, block in (
            (replace(x, world_T_exterior=retract(x.world_T_exterior, step)), lin.by_exterior),
            (replace(x, world_T_body=retract(x.world_T_body, step)), lin.by_pose),
        ):
            numeric = -(linearise(marks, changed, o.cameras, np.ones(2)).residual - lin.residual) / 1e-7
            assert np.allclose(block[..., k], numeric, atol=1e-4 * np.abs(numeric).max())


def test_covariance_of_points_covers_the_truth():
    values = []
    for seed in range(4):
        s = simulate(seed=seed, points=8, flat=False, poses=30)
        o = _orient(s, s.cameras)
        m = measure_points(o, s.marks)
        true = transform(s.world_T_body[m.pose], s.true_points[s.body.index(m.target)])
        values.append(nees(m.p_world - true, m.total_covariance).mean())
        assert 0.9 < o.sigma0 < 1.1
    assert 0.4 < np.mean(values) < 2.0


@pytest.mark.parametrize("start", ["rough", "none"])
def test_lens_is_found_from_poor_start_values(start):
    s = simulate(points=15, flat=False, poses=30)
    o = _orient(s, s.rough if start == "rough" else dict.fromkeys(s.cameras))
    for camera, true in zip(o.cameras, s.cameras.values(), strict=True):
        assert abs(camera.fx - true.fx) < 2.0
        assert abs(camera.k1 - true.k1) < 5e-3
    kinds = {e.name for e in o.evidence}
    # a lens term is a finding only where a camera file lacks it
    assert kinds == ({"lens_radial", "lens_tangential"} if start == "rough" else set())


def test_perfect_cameras_are_not_given_distortion():
    s = simulate(seed=5)
    clean = {n: replace(c, k1=0.0, k2=0.0, p1=0.0, p2=0.0) for n, c in s.cameras.items()}
    from robcal.photogrammetry.core.camera import project
    from robcal.transforms import invert

    rng = np.random.default_rng(0)
    for name, m in s.marks.items():
        T = (invert(s.world_T_camera[name]) @ s.world_T_body)[m.pose]
        xy = project(clean[name], transform(T, s.true_points[s.body.index(m.target)]))
        s.marks[name] = replace(m, xy=xy + rng.normal(size=xy.shape) * 0.02)
    o = _orient(s, clean)
    assert not o.evidence
    assert all("k1" not in groups or "k3" not in groups for groups in o.free_interior.values())


def test_shifted_target_is_named_and_costs_no_marks():
    s = simulate(seed=1)
    points = s.body.points.copy()
    points[2] += [0.001, 0.0, 0.0]
    s.body = replace(s.body, points=points)
    o = _orient(s)
    shifts = [e for e in o.evidence if e.name == "target_shifted"]
    assert [e.where for e in shifts] == ["33"]
    assert np.allclose(shifts[0].estimate, [-0.001, 0, 0], atol=1e-4)
    assert len(o.rejected) <= 2
    assert o.sigma0 < 1.2


def test_swapped_targets_of_the_body_file():
    s = simulate(seed=1)
    points = s.body.points.copy()
    points[[1, 2]] = points[[2, 1]]
    s.body = replace(s.body, points=points)
    o = _orient(s)
    assert [(e.name, e.where, e.partner) for e in o.evidence if not e.name.startswith("lens")] == [
        ("target_swapped", "22", "33")
    ]
    assert o.sigma0 < 1.2


@pytest.mark.parametrize("cameras", [2, 3])
def test_camera_that_moved(cameras):
    s = simulate(seed=2, cameras=cameras)
    m = s.marks["right"]
    s.change("right", xy=m.xy + np.where(m.pose >= 25, 1.0, 0.0)[:, None] * [0.6, 0.4])
    o = _orient(s)
    moved = [e for e in o.evidence if e.name == "camera_moved"]
    assert [(e.where, e.pose) for e in moved] == [("right", 25)]
    assert o.sigma0 < 1.3
    assert len(o.rejected) < 5


def test_one_wrong_image_is_left_out():
    s = simulate(seed=3)
    m = s.marks["right"]
    s.change("right", xy=m.xy + np.where(m.pose == 7, 1.0, 0.0)[:, None] * [30.0, 10.0])
    o = _orient(s)
    assert {r.pose for r in o.rejected} == {7}
    assert not [e for e in o.evidence if e.name == "camera_moved"]
    assert o.sigma0 < 1.1


def test_slipped_images_are_refused_with_the_shift():
    s = simulate(seed=4)
    m = s.marks["right"]
    s.change("right", pose=(m.pose + 1) % 40)
    with pytest.raises(InvalidInput, match="slipped by 1"):
        _orient(s)


def test_unconnected_camera_is_refused():
    s = simulate(seed=4)
    left, right = s.marks["left"], s.marks["right"]
    for name, m, keep in (("left", left, left.pose < 20), ("right", right, right.pose >= 20)):
        s.marks[name] = StationMarks(m.pose[keep], m.target[keep], m.xy[keep], m.covariance[keep])
    with pytest.raises(InvalidInput, match="right shares no pose"):
        _orient(s)


def test_bad_input_is_named():
    s = simulate(poses=5)
    with pytest.raises(InvalidInput, match="target 999 is not on body"):
        orient_station(
            {"left": replace(s.marks["left"], target=np.full(len(s.marks["left"]), 999))}, s.body, s.rough, s.sizes
        )
    with pytest.raises(DegenerateGeometry, match="three or more"):
        orient_station(s.marks, s.body.select([0, 1]), s.rough, s.sizes)
    xy = s.marks["left"].xy.copy()
    xy[3] = np.nan
    with pytest.raises(InvalidInput, match="mark 3"):
        replace(s.marks["left"], xy=xy)
    double = s.marks["left"]
    twice = StationMarks(
        np.r_[double.pose, double.pose[:1]],
        np.r_[double.target, double.target[:1]],
        np.r_[double.xy, double.xy[:1]],
        np.r_[double.covariance, double.covariance[:1]],
    )
    with pytest.raises(InvalidInput, match="more than once"):
        orient_station({"left": twice}, s.body, s.rough, {"left": SIZE})


def test_noise_of_each_camera_is_estimated():
    s = simulate(points=12, flat=False)
    m = s.marks["right"]
    s.change("right", covariance=m.covariance / 4.0)
    o = _orient(s, s.cameras)
    assert abs(o.noise["left"] - 1.0) < 0.1
    assert abs(o.noise["right"] - 2.0) < 0.2


def test_exchanged_targets_that_mirror_a_small_plate_are_found() -> None:
    # corners of a square across its diagonal: most images still fit, mirrored, within what start values may cause
    points = 0.5 * np.array(
        [[-0.2, -0.18, 0.0], [0.21, -0.17, 0.03], [0.19, 0.2, 0.0], [-0.18, 0.21, 0.05], [0.02, 0.01, 0.11]]
    )
    ids = np.array([17, 151, 343, 727, 1003])
    body = Body("plate", ids, points, covariance=np.eye(15) * 1e-12)
    camera = Camera(4096, 3072, 3000.0, 3000.0, 2048.0, 1536.0)
    rng = np.random.default_rng(2)
    pose, target, xy = [], [], []
    for p in range(12):
        turn = exp_so3(rng.normal(0, 0.3, 3)) @ np.diag([1.0, -1.0, -1.0])
        T = frame(turn, np.array([0.1, 0.05, 1.3]) + rng.normal(0, 0.05, 3))
        pose += [p] * 5
        target += [17, 727, 343, 151, 1003]  # 151 and 727 exchanged
        xy.append(project(camera, transform(np.tile(T, (5, 1, 1)), points)))
    covariance = np.tile(0.05**2 * np.eye(2), (len(pose), 1, 1))
    marks = StationMarks(np.array(pose), np.array(target), np.concatenate(xy), covariance)
    images, _ = resect_station(("only",), [marks], [camera], body, 5.0)
    assert find_swap([marks], [camera], body, 5.0, images) in ((1, 3), (3, 1))
