"""Three-point poses and resections: truth, covariance, misidentified marks, the two poses of a plane."""

import numpy as np
import pytest

from robcal.errors import DegenerateGeometry, InvalidInput
from robcal.photogrammetry.core.bodies import Body
from robcal.photogrammetry.core.camera import Camera, project
from robcal.photogrammetry.orientation.p3p import three_point_poses
from robcal.photogrammetry.orientation.resection import Resection, resect, resect_images
from robcal.transforms import difference, exp_so3, frame, transform
from tests.photogrammetry.stations import PLATE, nees

CAMERA = Camera(2448, 2048, 3600.0, 3600.0, 1220.0, 1030.0, -0.08, 0.05, 2e-4, -1e-4, 0.0)
BODY = Body("plate", np.arange(1, 6), PLATE)


def _image(rng, sigma=0.02, tilt=(0.5, -0.4, 0.7), z=2.0):
    T = frame(exp_so3(tilt), [0.1, -0.1, z])
    xy = project(CAMERA, transform(T, PLATE)) + rng.normal(size=(5, 2)) * sigma
    return T, xy, np.tile(np.eye(2) * sigma**2, (5, 1, 1))


def test_three_points_contain_the_true_pose():
    rng = np.random.default_rng(0)
    T = frame(exp_so3(rng.normal(size=(500, 3))), rng.normal(size=(500, 3)) * [0.5, 0.5, 0.3] + [0, 0, 3])
    points = rng.normal(size=(500, 3, 3)) * 0.2
    p = transform(T[:, None], points)
    found = three_point_poses(p[..., :2] / p[..., 2:], points)
    miss = np.abs(found - T[:, None]).max(axis=(-1, -2))
    assert np.nanmin(miss, axis=1).max() < 1e-6
    back = transform(found[:, :, None], points[:, None])
    again = back[..., :2] / back[..., 2:]
    exists = np.isfinite(found[..., 0, 0])
    assert np.abs(again - (p[..., :2] / p[..., 2:])[:, None])[exists].max() < 1e-5


def test_covariance_matches_scatter():
    rng = np.random.default_rng(1)
    values = []
    for _ in range(150):
        T, xy, C = _image(rng)
        fit = resect(CAMERA, BODY.ids, xy, C, BODY)
        values.append(nees(difference(fit.camera_T_body, T)[None], fit.covariance[None])[0])
    assert 0.8 < np.mean(values) < 1.2


def test_misidentified_marks_are_left_out():
    rng = np.random.default_rng(2)
    body = Body("plate", np.arange(12), rng.uniform(-0.3, 0.3, (12, 3)) * [1, 1, 0])
    T = frame(exp_so3([0.3, 0.2, 0.1]), [0, 0, 2.5])
    xy = project(CAMERA, transform(T, body.points)) + rng.normal(size=(12, 2)) * 0.02
    xy[[0, 3]] = xy[[3, 0]]
    fit = resect(CAMERA, body.ids, xy, np.tile(np.eye(2) * 4e-4, (12, 1, 1)), body)
    assert not fit.inliers[[0, 3]].any()
    assert fit.inliers.sum() == 10
    assert np.linalg.norm(difference(fit.camera_T_body, T)[:3]) < 1e-3


def test_plane_far_away_is_ambiguous_and_near_is_not():
    rng = np.random.default_rng(3)
    _, xy, C = _image(rng, sigma=0.02)
    assert not resect(CAMERA, BODY.ids, xy, C, BODY).ambiguous
    _, xy, C = _image(rng, sigma=1.0, tilt=(0.5, 0.2, 0.0), z=9.0)
    fit = resect(CAMERA, BODY.ids, xy, C, BODY)
    assert fit.ambiguous
    assert fit.alternative is not None


def test_bad_images_say_why():
    C = np.tile(np.eye(2), (5, 1, 1))
    line = Body("line", np.arange(5), np.column_stack([np.arange(5), np.zeros(5), np.zeros(5)]) * 0.1)
    with pytest.raises(DegenerateGeometry, match="line"):
        resect(CAMERA, line.ids, np.column_stack([np.arange(5) * 100, np.full(5, 500)]), C, line)
    with pytest.raises(DegenerateGeometry, match="three targets"):
        resect(CAMERA, BODY.ids[:2], np.zeros((2, 2)), C[:2], BODY)
    with pytest.raises(InvalidInput, match="no target 99"):
        resect(CAMERA, [99, 1, 2, 3], np.zeros((4, 2)), C[:4], BODY)


def test_many_images_agree_with_one_by_one():
    rng = np.random.default_rng(4)
    parts = [_image(rng, tilt=(0.5, 0.1 * k, 0.2)) for k in range(4)]
    image = np.repeat(np.arange(4), 5)
    many = resect_images(
        CAMERA,
        image,
        np.tile(BODY.ids, 4),
        np.concatenate([p[1] for p in parts]),
        np.concatenate([p[2] for p in parts]),
        BODY,
    )
    for result, (_, xy, C) in zip(many, parts, strict=True):
        assert isinstance(result, Resection)
        assert np.allclose(result.camera_T_body, resect(CAMERA, BODY.ids, xy, C, BODY).camera_T_body, atol=1e-7)
