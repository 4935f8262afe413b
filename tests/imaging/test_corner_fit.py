"""Blurred corners: derivatives against differences, the model against supersampling, scatter against covariance."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from robcal.imaging.corner_fit import CornerWindows, fit_corners
from robcal.imaging.corner_model import blurred_corner
from robcal.imaging.noise import NoiseModel

pytestmark = pytest.mark.unit
_SUB = 16


def _places(half: int) -> tuple[np.ndarray, np.ndarray]:
    offset = np.arange(-half, half + 1.0)
    x, y = np.meshgrid(offset, offset)
    return x.ravel(), y.ravel()


def _supersampled(centre: np.ndarray, angle: np.ndarray, blur: float, half: int) -> np.ndarray:
    """Values -1..1 of a sharp corner, blurred on a fine grid and averaged over pixels."""
    reach = half + 6
    fine = (np.arange((2 * reach + 1) * _SUB) + 0.5) / _SUB - 0.5 - reach
    x, y = np.meshgrid(fine - centre[0], fine - centre[1])
    edges = [np.clip((np.cos(a) * x + np.sin(a) * y) * _SUB * 2, -1, 1) for a in angle]
    smooth = gaussian_filter(edges[0] * edges[1], blur * _SUB)
    pixels = smooth.reshape(2 * reach + 1, _SUB, 2 * reach + 1, _SUB).mean(axis=(1, 3))
    return pixels[6:-6, 6:-6]


@pytest.mark.parametrize("angles", [(0.1, 1.67), (0.5, 1.5), (-0.2, 2.2)])
def test_model_is_the_blurred_corner(angles: tuple[float, float]) -> None:
    half, blur, centre = 6, 0.8, np.array([0.23, -0.31])
    picture = _supersampled(centre, np.array(angles), blur, half)
    x, y = _places(half)
    shape = np.array([[*centre, *angles, 0.5 * np.log(blur**2 + 1 / 12)]])
    value, _ = blurred_corner(shape, np.zeros((1, 2)), x[None], y[None])
    assert np.abs(value[0] - picture.ravel()).max() < 0.012


def test_derivatives_agree_with_differences() -> None:
    rng = np.random.default_rng(1)
    x, y = _places(5)
    n = 6
    shape = np.column_stack(
        [rng.uniform(-0.5, 0.5, (n, 2)), rng.uniform(-0.3, 0.3, n), rng.uniform(1.2, 2.0, n), rng.uniform(-0.5, 0.5, n)]
    )
    curvature = rng.uniform(-0.01, 0.01, (n, 2))
    px, py = np.tile(x, (n, 1)), np.tile(y, (n, 1))
    _, gradient = blurred_corner(shape, curvature, px, py)
    for k in range(5):
        step = np.zeros(5)
        step[k] = 1e-5
        ahead, _ = blurred_corner(shape + step, curvature, px, py)
        behind, _ = blurred_corner(shape - step, curvature, px, py)
        np.testing.assert_allclose(gradient[:, k], (ahead - behind) / 2e-5, atol=2e-7)


def test_scatter_is_that_of_the_covariance_and_there_is_no_bias() -> None:
    rng = np.random.default_rng(3)
    n, half, noise = 300, 8, 2.0
    x, y = _places(half)
    true = np.column_stack([rng.uniform(-0.5, 0.5, (n, 2)), rng.normal(0.2, 0.05, n), rng.normal(1.6, 0.05, n)])
    shape = np.column_stack([true, np.full(n, np.log(0.76))])
    px, py = np.tile(x, (n, 1)), np.tile(y, (n, 1))
    value, _ = blurred_corner(shape, np.zeros((n, 2)), px, py)
    grey = 120.0 + 3.0 * px / half + 80.0 * value + rng.normal(0, noise, value.shape)
    none = np.zeros(grey.shape, bool)
    windows = CornerWindows(np.zeros((n, 2)), px, py, grey, ~none, none, np.zeros((n, 2)), half)
    start = shape + np.column_stack([rng.normal(0, 0.5, (n, 2)), rng.normal(0, 0.05, (n, 2)), rng.normal(0, 0.2, n)])
    fits = fit_corners(windows, start, NoiseModel(noise**2, 0.0, 40.0))
    error = fits.xy - true[:, :2]
    assert fits.converged.all()
    nees = np.einsum("ni,nij,nj->n", error, np.linalg.inv(fits.covariance), error)
    assert 0.85 < nees.mean() / 2 < 1.15
    assert np.abs(error.mean(axis=0)).max() < 4 * error.std() / np.sqrt(n)
    assert (fits.amplitude > 0).all()
