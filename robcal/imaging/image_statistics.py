"""Statistics of all fitted dots of an image: noise around and inside them, its correlation, and shading."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from robcal.imaging.edge_model import signed_distance
from robcal.imaging.ellipse_fit import EllipseFits, bright_sums, free_shading
from robcal.imaging.noise import NoiseModel, correlation_factor, with_gain
from robcal.imaging.windows import Windows

Array = NDArray[np.float64]

_CLEAN_RESIDUAL = 0.06  # RMS residual by contrast of a dot that is used to estimate noise
_SHADING_SIGMA = 0.02  # sigma of a dot's relative gradient per radius above which it cannot separate shading from shift


def without_doubt(window: Windows, fit: EllipseFits) -> NDArray[np.bool_]:
    """(n,) fits that are dots without doubt: only these are used to estimate the image's noise."""
    used = np.maximum((fit.weight > 0).sum(axis=1), 1)
    rms = np.sqrt(np.where(fit.weight > 0, fit.residual**2, 0.0).sum(axis=1) / used)
    return fit.converged & (rms < _CLEAN_RESIDUAL * np.abs(fit.parameters[:, 9])) & (used > 24)


def noise_around(
    groups: list[Windows], fits: list[EllipseFits], clean: list[NDArray[np.bool_]], noise: NoiseModel
) -> NoiseModel:
    """The noise model with the read noise seen around the dots, where it is more than the quietest parts show."""
    found = []
    for window, fit, good in zip(groups, fits, clean, strict=True):
        background = (fit.weight > 0) & _is_background(window, fit)
        count = background.sum(axis=1)
        use = good & (count >= 20)
        squares = np.where(background, fit.residual**2, 0.0).sum(axis=1)
        # three parameters of the background plane, two more for what the edge takes
        found.append((squares[use] / (count[use] - 5.0)) - noise.gain * (fit.parameters[use, 6] - noise.level))
    variances = np.concatenate(found) if found else np.zeros(0)
    if len(variances) < 8:
        return noise
    typical = float(np.median(variances))
    return replace(noise, variance=typical) if typical > 1.3 * noise.variance else noise


def _is_background(window: Windows, fit: EllipseFits) -> NDArray[np.bool_]:
    distance = signed_distance(fit.parameters, window.x, window.y)
    return distance > 2.4 * np.exp(fit.parameters[:, 5, None])


def noise_inside(
    groups: list[Windows], fits: list[EllipseFits], clean: list[NDArray[np.bool_]], noise: NoiseModel
) -> NoiseModel:
    """The noise model with the gain seen on the bright pixels of the dots, by residuals and their redundancy."""
    grey, variance, weights = [], [], []
    for window, fit, good in zip(groups, fits, clean, strict=True):
        use = np.flatnonzero(good)
        if use.size == 0:
            continue
        redundancy, squares, mean = bright_sums(fit.select(use), window.select(use))
        enough = redundancy > 0.1
        variance.append((squares / np.maximum(redundancy, 1e-9))[enough])
        grey.append(mean[enough])
        weights.append(redundancy[enough])
    if not grey:
        return noise
    return with_gain(noise, np.concatenate(grey), np.concatenate(variance), np.concatenate(weights))


def noise_correlation(groups: list[Windows], fits: list[EllipseFits], clean: list[NDArray[np.bool_]]) -> float:
    """Noise correlation from the residuals of neighbouring background pixels (rows are in reading order)."""
    products, squares, count = [], [], 0
    for window, fit, good in zip(groups, fits, clean, strict=True):
        background = (fit.weight > 0) & good[:, None] & _is_background(window, fit)
        pair = background[:, :-1] & background[:, 1:]
        pair &= (window.x[:, 1:] - window.x[:, :-1] == 1) & (window.y[:, 1:] == window.y[:, :-1])
        normalised = np.clip(fit.residual * np.sqrt(fit.weight), -4.0, 4.0)
        left, right = normalised[:, :-1], normalised[:, 1:]
        products.append(np.where(pair, left * right, 0.0).sum(axis=1)[good])
        squares.append(np.where(pair, 0.5 * (left**2 + right**2), 0.0).sum(axis=1)[good])
        count += int(pair.sum())
    if count < 300:
        return 1.0
    product, square = np.concatenate(products), np.concatenate(squares)
    # the middle of the dots: single ones have texture around them
    use = square > 0
    lag_one = product[use] / square[use]
    order = np.argsort(lag_one)
    weight = np.cumsum(square[use][order])
    middle = (weight > 0.25 * weight[-1]) & (weight <= 0.75 * weight[-1])
    kept = order[middle] if middle.sum() >= 4 else order
    return correlation_factor(float(product[use][kept].sum() / square[use][kept].sum()))


def shading_priors(groups: list[Windows], fits: list[EllipseFits]) -> tuple[Array, float]:
    """Prior sigma of each dot's relative gain gradient per radius, (n,), and the common one of the image, per px."""
    n = max((int(window.index.max()) + 1 for window in groups), default=0)
    square, variance, good, radius = np.zeros(n), np.ones(n), np.zeros(n, bool), np.ones(n)
    for window, fit in zip(groups, fits, strict=True):
        gradient, expected = free_shading(fit)
        dof = np.maximum((fit.weight > 0).sum(axis=1) - 10, 1)
        chi2 = np.einsum("np,np,np->n", fit.weight, fit.residual, fit.residual) / dof
        rows = window.index
        square[rows] = 0.5 * (gradient**2).sum(axis=1) / window.radius**2
        variance[rows] = expected * np.maximum(chi2, 1.0) / window.radius**2
        good[rows], radius[rows] = (chi2 < 50.0) & (expected < _SHADING_SIGMA**2), window.radius
    common = 0.0
    if good.any():
        s, v = square[good], variance[good]
        keep = s <= np.quantile(s, 0.95) if len(s) >= 20 else np.ones(len(s), bool)
        for _ in range(8):
            weight = 1.0 / (v[keep] + common) ** 2
            common = max(0.0, float((weight * (s[keep] - v[keep])).sum() / weight.sum()))
    # a dot with a gradient beyond the scatter found here (99.9 % of two normal numbers) is left free, if it is
    # determined at all
    unusual = (square > 6.9 * (variance + common)) & (variance * radius**2 < _SHADING_SIGMA**2)
    return radius * np.sqrt(np.where(unusual, square, common)), float(np.sqrt(common))
