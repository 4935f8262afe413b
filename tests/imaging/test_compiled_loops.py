"""Compiled loops against the same in numpy and scipy."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import ndimage
from scipy.special import ndtr

from robcal.imaging.blob_tree import _label
from robcal.imaging.blobs import Candidates
from robcal.imaging.ellipse_fit import evaluate, iterate, start
from robcal.imaging.noise import NoiseModel
from robcal.imaging.ring_loop import blur_segments, sample_rings
from robcal.imaging.windows import gather_windows
from tests.imaging.rendering import Dot, expose, render

pytestmark = pytest.mark.unit


@pytest.mark.parametrize("spot", [False, True])
def test_normal_equations_are_those_of_the_derivatives(spot: bool) -> None:
    image = expose(render(40, 40, [Dot(20.2, 19.6, 6, 5, 0.4)]), np.random.default_rng(1))
    place, axes = np.array([[20.0, 20.0]]), np.array([[3.0, 2.5] if spot else [6.0, 5.0]])
    grey = np.array([15.0]), np.array([195.0])
    candidates = Candidates(place, axes, np.array([0.4]), *grey, np.array([0.7]))
    window = gather_windows(image, candidates, np.inf)[0]
    shape = np.array([[0.1, -0.2, 0.2, 0.01, 0.25, np.log(0.8)]])
    noise = NoiseModel(2.0, 0.05, 15.0)
    first = start(shape, *grey, window, np.array([spot]))
    fit = iterate(first, window, noise, 0)
    model, jacobian = evaluate(first.parameters, window, np.array([spot]))
    weight = window.valid / noise.at(model)
    np.testing.assert_allclose(fit.residual[window.valid], (window.value - model)[window.valid], atol=2e-3)
    np.testing.assert_allclose(fit.weight, weight, rtol=1e-5)
    normal = np.einsum("nip,np,njp->nij", jacobian, weight, jacobian, dtype=float)
    normal[:, 5, 5] += 1.0
    normal[:, (10, 11), (10, 11)] += 1.0 / (1e-3 * 180.0) ** 2
    scale = np.sqrt(np.diagonal(normal[0]))
    np.testing.assert_allclose(fit.normal[0] / np.outer(scale, scale), normal[0] / np.outer(scale, scale), atol=3e-6)


@settings(deadline=None, max_examples=40)
@given(st.integers(0, 2**32 - 1), st.floats(0.2, 0.8))
def test_parts_are_the_connected_ones(seed: int, share: float) -> None:
    mask = np.random.default_rng(seed).random((13, 17)) < share
    pixels = np.flatnonzero(mask).astype(np.int32)
    mark, members = np.zeros(mask.size, np.int32), np.empty(len(pixels), np.int32)
    first = np.zeros(len(pixels) + 2, np.int64)
    parts = _label(pixels, mark, mask.shape[1], members, first)
    expected, count = ndimage.label(mask)
    assert parts == count
    np.testing.assert_array_equal(mark.reshape(mask.shape), expected)  # both in the order of their first pixels
    for part in range(parts):
        own = members[first[part + 1] : first[part + 2]]
        np.testing.assert_array_equal(own, np.flatnonzero(expected.ravel() == part + 1))


@pytest.mark.parametrize("segments", [8, 12])
def test_blurred_segments_are_differences_of_the_normal_distribution(segments: int) -> None:
    random = np.random.default_rng(4)
    angles, phase = np.linspace(0.0, 2.0 * np.pi, 60, endpoint=False), random.uniform(-7.0, 7.0, 3)
    sigma, width = random.uniform(0.02, 0.4, (3, 60)), 2.0 * np.pi / segments
    brightness, density, later = np.empty((3, 3, 60, segments))
    blur_segments(angles, phase, sigma, brightness, density)
    middle = (np.arange(segments) + 0.5) * width
    delta = (angles[None, :, None] - phase[:, None, None] - middle + np.pi) % (2.0 * np.pi) - np.pi
    blur = sigma[..., None]
    expected = ndtr((delta + 0.5 * width) / blur) - ndtr((delta - 0.5 * width) / blur)
    np.testing.assert_allclose(brightness, expected, atol=1e-14)
    blur_segments(angles + 1e-6, phase, sigma, later, np.empty_like(density))
    np.testing.assert_allclose((later - brightness) / 1e-6, density, atol=1e-3 * np.abs(density).max())


def test_grey_values_on_circles_are_bilinear() -> None:
    random = np.random.default_rng(5)
    image = random.integers(0, 255, (40, 50), dtype=np.uint8)
    xy, matrix = np.array([[20.3, 18.8], [47.0, 20.0]]), np.array([[[6.0, 1.0], [1.0, 4.0]]] * 2)
    rho, phi = np.array([0.5, 1.5]), np.linspace(0.0, 6.0, 7)
    circle, grey = np.stack([np.cos(phi), np.sin(phi)], axis=-1), np.empty((2, 2, 7))
    complete = sample_rings(image, xy, matrix, rho, circle, grey)
    assert complete.tolist() == [True, False]
    places = np.einsum("nij,aj->nai", matrix, circle)[:, None] * rho[None, :, None, None] + xy[:, None, None]
    expected = ndimage.map_coordinates(image.astype(float), [places[..., 1], places[..., 0]], order=1, mode="nearest")
    np.testing.assert_allclose(grey, expected, atol=1e-9)
