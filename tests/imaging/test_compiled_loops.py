"""Compiled loops against the same in numpy and scipy."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import ndimage

from robcal.imaging.blob_tree import _label
from robcal.imaging.blobs import Candidates
from robcal.imaging.ellipse_fit import evaluate, iterate, start
from robcal.imaging.noise import NoiseModel
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
