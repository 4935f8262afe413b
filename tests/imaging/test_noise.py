"""Noise estimated from images of known noise."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from robcal.imaging.noise import NoiseModel, correlation_factor, estimate_noise, quantisation_step, with_gain
from tests.imaging.rendering import expose


@pytest.mark.parametrize("sigma", [0.6, 1.5, 5.0])
def test_read_noise_on_even_ground(sigma: float) -> None:
    rng = np.random.default_rng(1)
    image = expose(np.zeros((400, 500)), rng, background=40.0, read_noise=sigma, gain=0.0)
    assert estimate_noise(image).variance == pytest.approx(sigma**2 + 1 / 12, rel=0.05)


def test_gain_from_areas_of_different_brightness() -> None:
    rng = np.random.default_rng(2)
    light = np.tile(np.linspace(0, 1, 1200), (600, 1))
    image = expose(light, rng, contrast=200.0, background=10.0, read_noise=1.0, gain=0.1)
    noise = estimate_noise(image)
    assert noise.gain == pytest.approx(0.1, rel=0.15)
    np.testing.assert_allclose(noise.at(np.array([30.0, 180.0])), 1 + 0.1 * np.array([30.0, 180.0]) + 1 / 12, rtol=0.12)


def test_objects_in_the_image_are_not_noise() -> None:
    rng = np.random.default_rng(3)
    light = np.zeros((600, 600))
    for _ in range(300):
        x, y = rng.integers(10, 590, 2)
        light[y - 5 : y + 5, x - 5 : x + 5] = 1
    noise = estimate_noise(expose(light, rng, read_noise=1.2, gain=0.0))
    assert noise.variance == pytest.approx(1.2**2 + 1 / 12, rel=0.12)


def test_black_image_has_the_noise_of_quantisation() -> None:
    noise = estimate_noise(np.zeros((100, 100), np.uint8))
    assert noise.sigma == pytest.approx(np.sqrt(1 / 12))


def test_step_of_stretched_data() -> None:
    rng = np.random.default_rng(4)
    assert quantisation_step((rng.integers(0, 4096, (50, 50)) << 4).astype(np.uint16)) == 16
    assert quantisation_step(np.zeros((50, 50), np.uint8)) == 1


def test_gain_from_dots_ignores_single_dirty_ones() -> None:
    rng = np.random.default_rng(5)
    noise = NoiseModel(4.0, 0.0, 10.0)
    grey = rng.uniform(60, 200, 80)
    variance = (4.0 + 0.05 * (grey - 10.0)) * rng.chisquare(20, 80) / 20
    variance[:8] *= 30
    assert with_gain(noise, grey, variance, np.full(80, 20.0)).gain == pytest.approx(0.05, rel=0.2)


def test_correlated_noise_factor_follows_the_variance_of_sums() -> None:
    rng = np.random.default_rng(6)
    field = gaussian_filter(rng.normal(size=(800, 800)), 0.5)
    field /= field.std()
    lag = float((field[:, :-1] * field[:, 1:]).mean())
    true = 64 * field.reshape(100, 8, 100, 8).mean(axis=(1, 3)).var()
    assert correlation_factor(lag) == pytest.approx(true, rel=0.35)
    assert correlation_factor(0.0) == 1.0
