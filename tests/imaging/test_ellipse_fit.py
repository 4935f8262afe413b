"""The grey-value model: derivatives, censoring, shading from a free fit."""

import numpy as np

from robcal.imaging.blobs import Candidates
from robcal.imaging.ellipse_fit import evaluate, grey_values, iterate, start
from robcal.imaging.noise import NoiseModel
from robcal.imaging.windows import Windows, gather_windows
from tests.imaging.rendering import Dot, expose, render


def one_dot(saturation: float = np.inf):
    image = expose(render(40, 40, [Dot(20.2, 19.6, 6, 5, 0.4)]), np.random.default_rng(1))
    candidates = Candidates(
        np.array([[20.0, 20.0]]),
        np.array([[6.0, 5.0]]),
        np.array([0.4]),
        np.array([15.0]),
        np.array([195.0]),
        np.array([0.7]),
    )
    return image, gather_windows(image, candidates, saturation)[0]


def from_origin(window: Windows, shape: list[float]) -> np.ndarray:
    """A shape (or parameters) in image coordinates as the fit counts them."""
    moved = np.array([shape])
    moved[:, :2] -= window.origin
    return moved


def test_derivatives_agree_with_differences() -> None:
    window = one_dot()[1].double()
    parameters = from_origin(window, [20.1, 19.8, 0.18, 0.01, 0.2, np.log(0.7), 14.0, 0.5, -0.3, 170.0, 4.0, -6.0])
    edge = np.array([False])
    _, jacobian = evaluate(parameters, window, edge)
    for k in range(12):
        step = np.zeros(12)
        step[k] = 1e-5
        difference = (
            grey_values(parameters + step, window, edge) - grey_values(parameters - step, window, edge)
        ) / 2e-5
        np.testing.assert_allclose(jacobian[:, k], difference, atol=2e-4)


def test_fit_finds_the_minimum() -> None:
    _, window = one_dot()
    noise = NoiseModel(2.0, 0.05, 15.0)
    shape = from_origin(window, [19.6, 20.3, 0.2, 0.0, 0.2, np.log(0.9)])
    fit = iterate(start(shape, np.array([15.0]), np.array([195.0]), window, np.array([False])), window, noise, 25, 1e-4)
    assert fit.converged[0]
    assert np.abs(fit.parameters[0, :2] + window.origin[0] - (20.2, 19.6)).max() < 0.03
    # every parameter's neighbourhood is worse
    covariance = fit.covariance()[0]
    for k in range(6):
        step = np.zeros(12)
        step[k] = np.sqrt(covariance[k, k])
        for sign in (-1, 1):
            moved = grey_values(fit.parameters + sign * step, window, np.array([False]))
            assert (fit.weight * (window.value - moved) ** 2).sum() > (fit.weight * fit.residual**2).sum()


def test_saturated_pixels_only_say_at_least() -> None:
    image, window = one_dot(saturation=120.0)
    clipped = np.minimum(image, 120)
    candidates = Candidates(
        np.array([[20.0, 20.0]]),
        np.array([[6.3, 5.3]]),
        np.array([0.4]),
        np.array([15.0]),
        np.array([120.0]),
        np.array([0.7]),
    )
    window = gather_windows(clipped, candidates, 120.0)[0]
    shape = from_origin(window, [20.0, 20.0, 0.17, 0.0, 0.19, np.log(0.8)])
    noise = NoiseModel(2.0, 0.0, 15.0)
    fit = iterate(start(shape, np.array([15.0]), np.array([150.0]), window, np.array([False])), window, noise, 25, 1e-3)
    assert np.abs(fit.parameters[0, :2] + window.origin[0] - (20.2, 19.6)).max() < 0.05
    assert fit.parameters[0, 9] > 105.0
