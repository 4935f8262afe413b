"""The blurred ellipse against differences and against supersampled images."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.special import ndtr

from robcal.imaging.edge_model import (
    axes_from_matrix,
    blurred_ellipse,
    edge_distance,
    matrix_from_axes,
    profile_only,
    signed_distance,
    spot,
    tail,
)
from tests.imaging.rendering import Dot, render

SHAPE = np.array([[10.2, 9.7, 0.21, 0.04, 0.33, np.log(0.8)], [9.5, 10.1, 0.5, -0.2, 0.6, np.log(0.6)]])


def pixels(n: int, half: int = 10) -> tuple[np.ndarray, np.ndarray]:
    y, x = np.mgrid[0 : 2 * half + 1, 0 : 2 * half + 1].astype(float)
    return np.tile(x.ravel(), (n, 1)), np.tile(y.ravel(), (n, 1))


@pytest.mark.parametrize("function", [blurred_ellipse, spot])
def test_derivatives_agree_with_differences(function) -> None:
    x, y = pixels(2)
    _, derivative = function(SHAPE, x, y)
    for k in range(6):
        step = np.zeros(6)
        step[k] = 1e-6
        difference = (function(SHAPE + step, x, y)[0] - function(SHAPE - step, x, y)[0]) / 2e-6
        np.testing.assert_allclose(derivative[:, k], difference, atol=2e-6)


def test_distance_is_exact_for_circles() -> None:
    x, y = pixels(1)
    shape = np.array([[10.3, 9.9, 1 / 4.5, 0.0, 1 / 4.5, 0.0]])
    distance = np.hypot(x - 10.3, y - 9.9) - 4.5
    np.testing.assert_allclose(signed_distance(shape, x, y), distance, atol=1e-9)
    np.testing.assert_allclose(edge_distance(shape, x, y)[0], distance, atol=1e-9)


@given(major=st.floats(0.5, 50), ratio=st.floats(0.2, 0.99), angle=st.floats(-np.pi / 2 + 0.01, np.pi / 2 - 0.01))
@settings(max_examples=60, deadline=None)
def test_axes_and_matrix_are_inverse(major: float, ratio: float, angle: float) -> None:
    axes, back = axes_from_matrix(matrix_from_axes(np.array([[major, ratio * major]]), np.array([angle])))
    np.testing.assert_allclose(axes[0], [major, ratio * major], rtol=1e-9)
    assert abs(np.sin(back[0] - angle)) < 1e-6 / (1 - ratio)


@pytest.mark.parametrize(("a", "b"), [(3.0, 3.0), (6.0, 4.0), (9.0, 4.5)])
def test_profile_agrees_with_area_integration(a: float, b: float) -> None:
    blur = 0.7
    light = render(31, 31, [Dot(15.3, 14.8, a, b, 0.4)], blur, sub=16)
    shape = np.concatenate(
        [[[15.3, 14.8]], matrix_from_axes(np.array([[a, b]]), np.array([0.4])), [[np.log(np.sqrt(blur**2 + 1 / 12))]]],
        axis=1,
    )
    x, y = pixels(1, 15)
    model = blurred_ellipse(shape, x, y)[0].reshape(31, 31)
    # the edge of a blurred disc recedes by s^2 / 2R, which a fit takes up in the radius
    assert np.abs(model - light).max() < 0.09
    # the centre of gravity is what matters
    grid = np.indices(light.shape)[::-1]
    for axis in range(2):
        assert (grid[axis] * model).sum() / model.sum() == pytest.approx(
            (grid[axis] * light).sum() / light.sum(), abs=2e-3
        )


def test_profile_without_derivatives_is_the_same() -> None:
    x, y = pixels(2)
    is_spot = np.array([False, True])
    value = profile_only(SHAPE, x, y, is_spot)
    np.testing.assert_allclose(value[0], blurred_ellipse(SHAPE, x, y)[0][0], atol=1e-12)
    np.testing.assert_allclose(value[1], spot(SHAPE, x, y)[0][1], atol=1e-12)


@pytest.mark.parametrize("function", [blurred_ellipse, spot])
@pytest.mark.parametrize("radius", [1.0, 8.0, 60.0])
def test_single_precision_is_enough(function, radius: float) -> None:
    shape = np.array([[0.3, -0.4, 1 / radius, 0.1 / radius, 1.3 / radius, np.log(0.8)]])
    half = int(radius + 4)
    x, y = (pixel - half for pixel in pixels(1, half))
    value, derivative = function(shape, x, y)
    single, rough = function(shape, x.astype(np.float32), y.astype(np.float32))
    assert single.dtype == rough.dtype == np.float32
    np.testing.assert_allclose(single, value, atol=2e-5)
    # a centre is found to a thousandth of a pixel: derivatives by the centre (0, 1) matter most
    np.testing.assert_allclose(rough[:, :2], derivative[:, :2], atol=1e-4)
    np.testing.assert_allclose(rough, derivative, atol=2e-4 * np.abs(derivative).max())


def test_tail_of_the_normal_distribution() -> None:
    t = np.linspace(-9.0, 9.0, 2001)
    np.testing.assert_allclose(tail(t), ndtr(-t), atol=1e-15)
    np.testing.assert_allclose(tail(t.astype(np.float32)), ndtr(-t), atol=3e-7)
