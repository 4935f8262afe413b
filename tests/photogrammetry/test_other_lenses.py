"""Surveys and stations with lenses that are not Brown's; marks are projected by OpenCV, not by the library."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from robcal.errors import InvalidInput
from robcal.photogrammetry.core.adjustable import AdjustableCamera, adjustable, adjustable_names, plain
from robcal.photogrammetry.core.camera import INTRINSIC_NAMES, Camera, normalise, project, project_with_jacobians
from robcal.photogrammetry.core.lenses import FisheyeCamera, RationalCamera
from robcal.photogrammetry.core.splined import SplinedCamera, shift
from robcal.photogrammetry.measure.points import measure_points
from robcal.photogrammetry.station.network import StationMarks
from robcal.photogrammetry.station.orientation import orient_station
from robcal.photogrammetry.survey.survey import survey_body
from robcal.transforms import Array, invert, transform
from tests.photogrammetry.networks import Truth, aligned_error, detections, make_network
from tests.photogrammetry.stations import SIZE, nees, simulate

RATIONAL = RationalCamera(
    *SIZE, 3500.0, 3500.0, 1230.0, 1015.0, 0.35, 0.2, 3e-4, -2e-4, 0.02, 0.5, 0.1, 0.01, 1e-3, 0.0, -8e-4, 0.0
)
FISHEYE = FisheyeCamera(*SIZE, 3400.0, 3400.0, 1230.0, 1015.0, k1=-0.3, k2=0.2, k3=-0.1, k4=0.02)
LENSES = pytest.mark.parametrize("lens", [RATIONAL, FISHEYE], ids=["rational", "fisheye"])


def seen(lens: Camera, p: Array) -> Array:
    """Images (n, 2) of points in the camera's frame, by OpenCV."""
    still = np.zeros(3)
    if isinstance(lens, FisheyeCamera):
        return cv2.fisheye.projectPoints(p.reshape(-1, 1, 3), still, still, lens.matrix, lens.distortion)[0][:, 0]
    return cv2.projectPoints(p, still, still, lens.matrix, lens.distortion)[0][:, 0]


@LENSES
def test_nine_numbers_of_any_lens(lens: Camera) -> None:
    camera = adjustable(lens)
    assert isinstance(camera, AdjustableCamera)
    p = np.random.default_rng(0).uniform([-0.6, -0.5, 1.5], [0.6, 0.5, 3.0], (30, 3))
    xy, d_point, d_in = project_with_jacobians(camera, p)
    np.testing.assert_allclose(xy, seen(lens, p), atol=1e-9)
    np.testing.assert_allclose(project(camera, p), xy)
    np.testing.assert_allclose(normalise(camera, xy), p[:, :2] / p[:, 2:], atol=1e-9)
    for k, name in enumerate(INTRINSIC_NAMES):
        step = 1e-6 * np.eye(9)[k]
        ends = [project(camera.with_vector(camera.vector + s), p) for s in (step, -step)]
        np.testing.assert_allclose(d_in[..., k], (ends[0] - ends[1]) / 2e-6, atol=2e-3)
        assert bool(np.any(d_in[..., k])) == (name in adjustable_names(camera))
    assert plain(camera) == lens
    assert plain(camera.with_vector([3000.0, *camera.vector[1:]])).fx == 3000.0
    assert d_point.shape == (30, 2, 3)


@LENSES
def test_a_station_adjusts_the_lens(lens: Camera) -> None:
    squares, kinds = [], set()
    for seed in range(2):
        s = simulate(seed=seed, points=8, flat=False, poses=30)
        rng = np.random.default_rng(seed)
        for name, marks in s.marks.items():
            camera_T_body = invert(s.world_T_camera[name]) @ s.world_T_body[marks.pose]
            xy = seen(lens, transform(camera_T_body, s.true_points[s.body.index(marks.target)]))
            inside = ((xy > 5) & (xy < np.array(SIZE) - 5)).all(axis=1)
            noisy = xy + 0.02 * rng.standard_normal(xy.shape)
            s.marks[name] = StationMarks(
                marks.pose[inside], marks.target[inside], noisy[inside], marks.covariance[inside]
            )
        start = adjustable(replace(lens, fx=lens.fx * 1.005, fy=lens.fy * 1.005, cx=lens.cx + 5.0))
        o = orient_station(s.marks, s.body, dict.fromkeys(s.cameras, start), s.sizes)
        assert 0.9 < o.sigma0 < 1.1
        for camera in o.cameras:
            kinds.add(type(plain(camera)))
            assert abs(camera.fx - lens.fx) < 3.0
        m = measure_points(o, s.marks)
        true = transform(s.world_T_body[m.pose], s.true_points[s.body.index(m.target)])
        squares.append(nees(m.p_world - true, m.total_covariance).mean())
    assert kinds == {type(lens)}
    assert 0.3 < np.mean(squares) < 2.5


def network_of(lens: Camera) -> tuple[Truth, np.random.Generator]:
    rng = np.random.default_rng(5)
    truth = make_network(rng, images=14, targets=40, size=SIZE, focal_factor=1.42, distortion=(0.0,) * 5)
    m = truth.marks
    xy = seen(lens, transform(truth.camera_T_body[m.image], truth.points[m.target]))
    marks = replace(m, xy=xy + truth.sigma * rng.standard_normal(xy.shape))
    return replace(truth, camera=lens, marks=marks), rng


@LENSES
def test_a_survey_adjusts_the_lens(lens: Camera) -> None:
    from robcal.photogrammetry.core.network import Lengths
    from robcal.photogrammetry.survey.survey import BodyTarget

    truth, rng = network_of(lens)
    targets = [BodyTarget(100 + i, "ring12", None, None) for i in range(40)]
    bar = Lengths([[100, 139]], [float(np.linalg.norm(truth.points[0] - truth.points[39]))], [3e-6])
    start = replace(lens, fx=lens.fx * 1.01, fy=lens.fy * 1.01)
    images = detections(truth, 40, rng)
    done = survey_body(images, targets, size=SIZE, camera=start, scale_bars=bar)
    net = done.network
    assert 0.85 < net.sigma0 < 1.15
    assert type(plain(net.camera)) is type(lens)
    assert abs(net.camera.fx - lens.fx) < 5.0
    rows = np.argsort(net.ids)
    error = aligned_error(net.points[rows], truth.points, scale=False)
    assert np.sqrt(np.mean(error**2)) < 5e-5
    with pytest.raises(InvalidInput, match="engine pycolmap adjusts Brown's lens alone"):
        survey_body(images, targets, size=SIZE, camera=start, scale_bars=bar, engine="pycolmap")


def test_a_station_takes_a_splined_lens() -> None:
    rng = np.random.default_rng(4)
    lens = replace(
        SplinedCamera(*SIZE, 3500.0, 3500.0, 1230.0, 1015.0, -0.08, 0.05, 2e-4, -1e-4),
        nodes=1.5 * rng.standard_normal((6, 7, 2)),
    )
    s = simulate(points=8, flat=False, poses=20)
    for name, marks in s.marks.items():
        camera_T_body = invert(s.world_T_camera[name]) @ s.world_T_body[marks.pose]
        p = transform(camera_T_body, s.true_points[s.body.index(marks.target)])
        u = seen(Camera(*SIZE, *lens.vector), p)
        noisy = u + shift(lens, u)[0] + 0.02 * rng.standard_normal(u.shape)
        s.marks[name] = replace(marks, xy=noisy)
    start = replace(lens, fx=lens.fx * 1.003, fy=lens.fy * 1.003)
    o = orient_station(s.marks, s.body, dict.fromkeys(s.cameras, start), s.sizes)
    assert 0.9 < o.sigma0 < 1.1
    assert all(isinstance(camera, SplinedCamera) for camera in o.cameras)
    rough = orient_station(s.marks, s.body, dict.fromkeys(s.cameras, start.brown), s.sizes)
    assert rough.rms_px > 3.0 * o.rms_px
