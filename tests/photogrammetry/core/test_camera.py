"""Laws of the camera model: agreement with OpenCV, round trips, derivatives against differences."""

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from robcal.errors import InvalidInput
from robcal.photogrammetry.core.camera import INTRINSIC_NAMES, Camera, normalise, project, project_with_jacobians

factors = st.floats(0.6, 4.0)
seeds = st.integers(0, 2**32 - 1)


def some_camera(rng: np.random.Generator, factor: float) -> Camera:
    """A camera with moderate distortion, invertible within its field of view."""
    reach2 = (0.5 / factor) ** 2 * 1.6
    k1, k2, k3 = rng.uniform(-0.1, 0.1, 3) / [reach2, reach2**2, reach2**3]
    p1, p2 = rng.uniform(-2e-3, 2e-3, 2)
    f = factor * 2000
    return Camera(
        2000,
        1500,
        f,
        f * rng.uniform(0.98, 1.02),
        1000 + rng.normal(0, 20),
        750 + rng.normal(0, 20),
        k1,
        k2,
        p1,
        p2,
        k3,
    )


def some_points(rng: np.random.Generator, camera: Camera, shape: tuple[int, ...]) -> np.ndarray:
    """Points in front of the camera whose undistorted image lies in the picture."""
    uv = rng.uniform([0, 0], [camera.width, camera.height], (*shape, 2))
    rays = np.concatenate([(uv - [camera.cx, camera.cy]) / [camera.fx, camera.fy], np.ones((*shape, 1))], axis=-1)
    return rays * rng.uniform(0.3, 8.0, (*shape, 1))


@given(seeds, factors)
@settings(max_examples=40, deadline=None)
def test_projection_is_opencvs(seed: int, factor: float) -> None:
    rng = np.random.default_rng(seed)
    camera = some_camera(rng, factor)
    p = some_points(rng, camera, (20,))
    expected, _ = cv2.projectPoints(p[:, None], np.zeros(3), np.zeros(3), camera.matrix, camera.distortion)
    np.testing.assert_allclose(project(camera, p), expected[:, 0], atol=1e-8)


@given(seeds, factors, st.sampled_from([(), (1,), (7,), (2, 3)]))
@settings(max_examples=40, deadline=None)
def test_normalise_undoes_project(seed: int, factor: float, shape: tuple[int, ...]) -> None:
    rng = np.random.default_rng(seed)
    camera = some_camera(rng, factor)
    p = some_points(rng, camera, shape)
    ideal = normalise(camera, project(camera, p))
    assert ideal.shape == (*shape, 2)
    np.testing.assert_allclose(ideal, p[..., :2] / p[..., 2:], atol=1e-10)


@given(seeds, factors)
@settings(max_examples=30, deadline=None)
def test_derivatives_against_differences(seed: int, factor: float) -> None:
    rng = np.random.default_rng(seed)
    camera = some_camera(rng, factor)
    p = some_points(rng, camera, (6,))
    xy, d_point, d_in = project_with_jacobians(camera, p)
    np.testing.assert_allclose(xy, project(camera, p), atol=1e-10)
    for k in range(3):
        h = 1e-6
        step = np.zeros(3)
        step[k] = h
        difference = (project(camera, p + step) - project(camera, p - step)) / (2 * h)
        np.testing.assert_allclose(d_point[..., k], difference, rtol=1e-5, atol=1e-4)
    numbers = camera.vector
    for k in range(len(INTRINSIC_NAMES)):
        h = 1e-4 * max(abs(numbers[k]), 1e-2)
        step = np.zeros(9)
        step[k] = h
        ahead, behind = (project(camera.with_vector(numbers + s * step), p) for s in (1, -1))
        # the projection is linear in every single number, so only rounding is left
        np.testing.assert_allclose(d_in[..., k], (ahead - behind) / (2 * h), rtol=1e-6, atol=1e-4)


def test_behind_the_camera_is_nan() -> None:
    camera = Camera.from_size(640, 480)
    assert np.isnan(project(camera, [[0.0, 0.0, -1.0], [0.1, 0.0, 0.0]])).all()
    assert np.isnan(project_with_jacobians(camera, [0.0, 0.0, -1.0])[0]).all()


def test_normalise_says_nan_where_the_polynomial_folds() -> None:
    # k1 = -0.5: r (1 - r^2 / 2) has its maximum 0.544 at r = 0.816; 0.6 is reached by no ray
    camera = Camera(1000, 1000, 1000.0, 1000.0, 499.5, 499.5, k1=-0.5)
    out = normalise(camera, [[499.5 + 600.0, 499.5], [499.5 + 300.0, 499.5]])
    assert np.isnan(out[0]).all()
    assert np.isfinite(out[1]).all()


def test_the_centre_of_a_picture_of_integer_pixels() -> None:
    camera = Camera.from_size(5, 3)
    assert (camera.cx, camera.cy) == (2.0, 1.0)


def test_wrong_number_of_intrinsics_is_refused() -> None:
    with pytest.raises(InvalidInput, match="needs 9 parameters"):
        Camera.from_size(640, 480).with_vector([1.0, 2.0])
