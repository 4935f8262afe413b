"""Rational and fisheye lenses: against OpenCV, derivatives against differences, there and back."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from robcal.photogrammetry.core.camera import Camera, normalise, project, project_with_jacobians
from robcal.photogrammetry.core.lenses import FisheyeCamera, RationalCamera

pytestmark = pytest.mark.unit

SIZE = (1280, 960)
BROWN = Camera(*SIZE, 900.0, 905.0, 640.0, 470.0, -0.2, 0.08, 0.001, -0.0007, 0.01)
RATIONAL = RationalCamera(
    *SIZE, 900.0, 905.0, 640.0, 470.0, 0.4, 0.2, 0.001, -0.0007, 0.01, 0.6, 0.1, 0.02, 0.002, -0.001, 0.0015, 0.0004
)
FISHEYE = FisheyeCamera(*SIZE, 400.0, 402.0, 640.0, 470.0, k1=-0.02, k2=0.01, k3=-0.004, k4=0.0008)
POINTS = np.random.default_rng(1).uniform([-0.6, -0.5, 0.7], [0.6, 0.5, 1.5], (60, 3))


@pytest.mark.parametrize("camera", [BROWN, RATIONAL], ids=["brown", "rational"])
def test_projection_is_that_of_opencv(camera: Camera) -> None:
    theirs, _ = cv2.projectPoints(POINTS, np.zeros(3), np.zeros(3), camera.matrix, camera.distortion)
    np.testing.assert_allclose(project(camera, POINTS), theirs[:, 0], atol=1e-9)


def test_fisheye_projection_is_that_of_opencv() -> None:
    points = POINTS * [3.0, 3.0, 1.0]
    theirs, _ = cv2.fisheye.projectPoints(points[:, None], np.zeros(3), np.zeros(3), FISHEYE.matrix, FISHEYE.distortion)
    np.testing.assert_allclose(project(FISHEYE, points), theirs[:, 0], atol=1e-9)


@pytest.mark.parametrize("camera", [BROWN, RATIONAL, FISHEYE], ids=["brown", "rational", "fisheye"])
def test_derivatives_are_those_of_the_projection(camera: Camera) -> None:
    # on the axis as well, where a fisheye's formula has a removable gap
    points = np.vstack([POINTS, [[0.0, 0.0, 1.0], [1e-12, 0.0, 0.5]]])
    xy, by_point, by_numbers = project_with_jacobians(camera, points)
    np.testing.assert_array_equal(xy, project(camera, points))
    h = 1e-6
    for k in range(3):
        step = np.zeros(3)
        step[k] = h
        numeric = (project(camera, points + step) - project(camera, points - step)) / (2 * h)
        np.testing.assert_allclose(by_point[..., k], numeric, rtol=1e-6, atol=1e-3)
    for k, size in enumerate(np.maximum(np.abs(camera.vector), 0.01)):
        step = np.zeros(len(camera.vector))
        step[k] = h * size
        up, down = (project(camera.with_vector(camera.vector + s), points) for s in (step, -step))
        np.testing.assert_allclose(by_numbers[..., k], (up - down) / (2 * h * size), rtol=1e-5, atol=2e-4)


@pytest.mark.parametrize("camera", [BROWN, RATIONAL, FISHEYE], ids=["brown", "rational", "fisheye"])
def test_there_and_back(camera: Camera) -> None:
    np.testing.assert_allclose(normalise(camera, project(camera, POINTS)), POINTS[:, :2] / POINTS[:, 2:], atol=1e-9)


def test_a_rational_lens_without_further_terms_is_browns() -> None:
    same = RationalCamera(*SIZE, 1.0, 1.0, 0.0, 0.0).with_vector([*BROWN.vector, *np.zeros(7)])
    np.testing.assert_allclose(project(same, POINTS), project(BROWN, POINTS), atol=1e-12)


def test_a_fisheye_sees_beside_itself_but_has_no_ideal_coordinates_there() -> None:
    beside = np.array([[1.0, 0.0, 0.0], [0.5, 0.5, -0.1]])
    xy, by_point, _ = project_with_jacobians(FISHEYE, beside)
    assert np.isfinite(xy).all()
    assert np.isfinite(by_point).all()
    assert np.isnan(normalise(FISHEYE, xy)).all()
    straight = replace(FISHEYE, k1=0.0, k2=0.0, k3=0.0, k4=0.0)
    np.testing.assert_allclose(project(straight, beside[0])[0], 640.0 + 400.0 * np.pi / 2)
