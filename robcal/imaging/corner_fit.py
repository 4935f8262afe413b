"""Least-squares fit of blurred corners to grey values, all corners of an image at once.

Grey value = b0 + b1 x + b2 y + (a0 + a1 x + a2 y) f(x, y): mean of dark and bright, half their difference, both with a
linear change over the window (shading), and the corner f of :mod:`robcal.imaging.corner_model`. x, y in the linear
terms count from the window's middle in units of its half width. Their gradients look like a shift of the corner; they
carry a normal prior whose mean and variance come from all corners of the image (empirical Bayes). Saturated pixels are
censored.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from robcal.columns import Columns
from robcal.estimation.batched import NormalEquations, minimise_each
from robcal.estimation.summary import TerminationSettings
from robcal.imaging.corner_model import SHAPE_PARAMETERS, blurred_corner
from robcal.imaging.noise import NoiseModel, correlation_factor

Array = NDArray[np.float64]

PARAMETERS = SHAPE_PARAMETERS + 6  # b0, b1, b2, a0, a1, a2
_GRADIENTS = (6, 7, 9, 10)
_LN_BLUR_SIGMA = 0.5  # weak prior on ln s, keeps windows of a few pixels sane
_OUTLIER_SIGMA, _OUTLIER_CONTRAST, _OUTLIERS_MAX = 6.0, 0.06, 0.05
_FLOOR = 0.001  # px, systematic part that no noise covers (pixel response, aliasing)
_PIXELS_MIN = 20
_SHADING_SIGMA, _SHADING_LEAST = 0.1, 0.005  # of a gradient by half the contrast over half a window
_SETTINGS = TerminationSettings(max_iterations=25, cost_tolerance=1e-7, negligible=1e-4)


@dataclass(frozen=True)
class CornerWindows(Columns):
    """Pixels around n corners, p each, row by row, padded.

    Attributes
    ----------
    origin : (n, 2) pixel in the middle. x, y, value : (n, p) place from the origin, px, and grey value.
    valid : (n, p) pixels that show this corner alone. saturated : (n, p). curvature : (n, 2) of both edges, 1/px.
    half : half width of the windows, px.
    """

    origin: Array
    x: Array
    y: Array
    value: Array
    valid: NDArray[np.bool_]
    saturated: NDArray[np.bool_]
    curvature: Array
    half: float


@dataclass(frozen=True)
class CornerFits(Columns):
    """Fits of n corners.

    Attributes
    ----------
    xy : (n, 2) px. covariance : (n, 2, 2). angle : (n, 2) rad of the edges' normals. blur : (n,) px with the pixel's.
    level : (n,) mean grey value. amplitude : (n,) half the contrast, positive where f is bright. chi2 : (n,) residual
    variance by that of the noise. misfit : (n,) RMS residual beyond noise by contrast. saturated, converged : (n,).
    """

    xy: Array
    covariance: Array
    angle: Array
    blur: Array
    level: Array
    amplitude: Array
    chi2: Array
    misfit: Array
    saturated: NDArray[np.bool_]
    converged: NDArray[np.bool_]


@dataclass(frozen=True)
class _State(Columns):
    parameters: Array
    precision: Array
    residual: Array
    normal: Array
    converged: NDArray[np.bool_]


def model_values(parameters: Array, windows: CornerWindows) -> tuple[Array, Array]:
    """Grey values (n, p) and derivatives (n, 11, p)."""
    x, y = windows.x, windows.y
    profile, by_shape = blurred_corner(parameters[:, :SHAPE_PARAMETERS], windows.curvature, x, y)
    u, v = x / windows.half, y / windows.half
    b0, b1, b2, a0, a1, a2 = (parameters[:, SHAPE_PARAMETERS + k, None] for k in range(6))
    amplitude = a0 + a1 * u + a2 * v
    jacobian = np.empty((len(parameters), PARAMETERS, x.shape[1]))
    jacobian[:, :SHAPE_PARAMETERS] = by_shape * amplitude[:, None]
    jacobian[:, 5], jacobian[:, 6], jacobian[:, 7] = 1.0, u, v
    jacobian[:, 8] = profile
    np.multiply(profile, u, out=jacobian[:, 9])
    np.multiply(profile, v, out=jacobian[:, 10])
    return b0 + b1 * u + b2 * v + amplitude * profile, jacobian


def fit_corners(
    windows: CornerWindows,
    start: Array,
    noise: NoiseModel,
    curvature_of: Callable[[Array, NDArray[np.bool_]], Array] | None = None,
) -> CornerFits:
    """Fit all corners.

    Parameters
    ----------
    start : (n, 5) shape: place from the window's origin, angles of the normals of both edges, ln s.
    curvature_of : the edges' curvatures (n, 2) from better places (n, 2) px, of which some (n,) are good.

    Notes
    -----
    Two rounds: the first gives the noise and the shading of the image and places from which the edges' curvature is
    known, the second uses all that and leaves single outlying pixels out. Covariances grow with residuals beyond noise
    and with the correlation of neighbouring pixels.
    """
    parameters = np.zeros((len(start), PARAMETERS))
    parameters[:, :SHAPE_PARAMETERS] = start
    parameters[:, 5], parameters[:, 8] = _levels(windows, start)
    valid = windows.valid & (windows.valid.sum(axis=1) > _PIXELS_MIN)[:, None]
    shading = np.zeros(4), np.full(4, _SHADING_SIGMA)
    first = _minimise(parameters, windows, valid, noise, start[:, 4], shading)
    noise, correlation = _seen_noise(first, noise, windows)
    shading = _shading(first)
    if curvature_of is not None:
        good = first.converged & (_chi2(first)[0] < 4.0)
        windows = replace(windows, curvature=curvature_of(first.parameters[:, :2] + windows.origin, good))
    second = _minimise(first.parameters, windows, valid, noise, start[:, 4], shading)
    odd = np.abs(second.residual) > np.maximum(
        _OUTLIER_SIGMA / np.sqrt(np.maximum(second.precision, 1e-12)),
        _OUTLIER_CONTRAST * 2.0 * np.abs(second.parameters[:, 8, None]),
    )
    odd &= valid
    few = odd.any(axis=1) & (odd.sum(axis=1) <= _OUTLIERS_MAX * valid.sum(axis=1))
    if few.any():
        rows = np.flatnonzero(few)
        part = second.select(rows)
        again = _minimise(part.parameters, windows.select(rows), (valid & ~odd)[rows], noise, start[rows, 4], shading)
        second = second.replaced(rows, again)
    return _fits(second, windows, correlation)


def _levels(windows: CornerWindows, start: Array) -> tuple[Array, Array]:
    """Mean level and signed amplitude (n,) from the means where f is clearly positive and negative."""
    profile, _ = blurred_corner(start, windows.curvature, windows.x, windows.y)

    def mean(chosen: NDArray[np.bool_]) -> Array:
        count = chosen.sum(axis=1)
        return np.asarray(np.where(chosen, windows.value, 0.0).sum(axis=1) / np.maximum(count, 1))

    high, low = mean(windows.valid & (profile > 0.7)), mean(windows.valid & (profile < -0.7))
    amplitude = 0.5 * (high - low)
    return 0.5 * (high + low), np.where(np.abs(amplitude) < 1e-3, 1e-3, amplitude)


def _minimise(
    parameters: Array,
    windows: CornerWindows,
    valid: NDArray[np.bool_],
    noise: NoiseModel,
    ln_blur: Array,
    shading: tuple[Array, Array],
) -> _State:
    """Minimum of all fits; ``shading``: mean and sigma (4,) of the gradients by the amplitude."""
    model, _ = model_values(parameters, windows)
    precision = valid / noise.at(model)
    residual = np.zeros_like(precision)
    used = np.zeros_like(precision)
    prior = np.zeros((len(parameters), PARAMETERS))
    prior[:, 4] = 1.0 / _LN_BLUR_SIGMA**2
    amplitude = _scales(parameters)
    prior[:, _GRADIENTS] = 1.0 / (shading[1] * amplitude) ** 2
    target = np.zeros((len(parameters), PARAMETERS))
    target[:, 4] = ln_blur
    target[:, _GRADIENTS] = shading[0] * amplitude
    # a window without pixels has no minimum; a weak prior on everything keeps its equations regular
    prior += 1e-9

    def equations(state: Array, rows: NDArray[np.int64]) -> NormalEquations:
        with np.errstate(over="ignore", invalid="ignore"):
            grey, jacobian = model_values(state, windows.select(rows))
            r = windows.value[rows] - grey
            weight = np.where(windows.saturated[rows] & (r < 0), 0.0, precision[rows])
            weighted = jacobian * weight[:, None]
            matrix = weighted @ jacobian.transpose(0, 2, 1)
            right = np.einsum("npk,nk->np", weighted, r)
            cost = np.einsum("nk,nk,nk->n", weight, r, r)
        offset = target[rows] - state
        offset[:, [0, 1, 2, 3, 5, 8]] = 0.0
        at = np.arange(PARAMETERS)
        matrix[:, at, at] += prior[rows]
        right += prior[rows] * offset
        cost = cost + (prior[rows] * offset**2).sum(axis=1)
        cost = np.where(np.isfinite(cost), cost, np.inf)
        residual[rows], used[rows] = r, weight
        return NormalEquations(np.nan_to_num(matrix), np.nan_to_num(right), cost)

    def retract(state: Array, step: Array) -> Array:
        length = np.hypot(step[:, 0], step[:, 1])
        factor = np.minimum(1.0, 1.0 / np.maximum(length, 1e-12))
        factor = np.minimum(factor, 0.3 / np.maximum(np.abs(step[:, 2:5]).max(axis=1), 1e-12))
        moved = state + step * factor[:, None]
        moved[:, 4] = np.clip(moved[:, 4], np.log(0.28), np.log(6.0))
        return moved

    solved = minimise_each(equations, retract, parameters, _SETTINGS)
    everything = np.arange(len(parameters))
    final = equations(solved.state, everything)
    return _State(solved.state, used.copy(), residual.copy(), final.matrix, solved.converged)


def _chi2(state: _State) -> tuple[Array, NDArray[np.int64]]:
    count = (state.precision > 0).sum(axis=1)
    dof = np.maximum(count - PARAMETERS + 2, 1)
    return np.einsum("np,np,np->n", state.precision, state.residual, state.residual) / dof, dof


def _seen_noise(state: _State, noise: NoiseModel, windows: CornerWindows) -> tuple[NoiseModel, float]:
    """The noise that the residuals of clean corners show, and how their neighbours are correlated."""
    chi2, _ = _chi2(state)
    expected = 1.0 / np.maximum(state.precision.max(axis=1), 1e-12)
    clean = state.converged & (chi2 * expected < (0.1 * state.parameters[:, 8]) ** 2)
    if clean.sum() < 8:
        return noise, 1.0
    factor = float(np.median(chi2[clean]))
    normalised = np.clip(state.residual * np.sqrt(state.precision), -4.0, 4.0)
    used = (state.precision > 0) & clean[:, None]
    pair = used[:, 1:] & used[:, :-1] & (np.diff(windows.x, axis=1) == 1) & (np.diff(windows.y, axis=1) == 0)
    left, right = normalised[:, 1:], normalised[:, :-1]
    squares = 0.5 * ((left**2 + right**2) * pair).sum()
    lag_one = float((left * right * pair).sum() / max(squares, 1e-12))
    seen = replace(noise, variance=noise.variance * factor, gain=noise.gain * factor)
    return seen, correlation_factor(lag_one)


def _scales(parameters: Array) -> Array:
    """(n, 4) what gradients are relative to: of the mean level half the contrast, of the contrast itself, signed."""
    amplitude = np.where(np.abs(parameters[:, 8]) < 1.0, 1.0, parameters[:, 8])
    size = np.abs(amplitude)
    return np.stack([size, size, amplitude, amplitude], axis=-1)


def _shading(state: _State) -> tuple[Array, Array]:
    """Mean and sigma (4,) of the relative gradients of all corners, without what noise makes of them."""
    chi2, _ = _chi2(state)
    clean = state.converged & (chi2 < 4.0)
    if clean.sum() < 8:
        return np.zeros(4), np.full(4, _SHADING_SIGMA)
    scales = _scales(state.parameters)
    gradient = (state.parameters[:, _GRADIENTS] / scales)[clean]
    inverse = NormalEquations(state.normal, state.parameters, chi2).inverse()
    noise = (np.diagonal(inverse, axis1=1, axis2=2)[:, _GRADIENTS] / scales**2)[clean]
    mean = np.median(gradient, axis=0)
    # median of a squared normal number
    square = np.median((gradient - mean) ** 2, axis=0) / 0.4549 - np.nanmedian(noise, axis=0)
    return mean, np.sqrt(np.maximum(square, _SHADING_LEAST**2))


def _fits(state: _State, windows: CornerWindows, correlation: float) -> CornerFits:
    chi2, dof = _chi2(state)
    covariance = NormalEquations(state.normal, state.parameters, chi2).inverse()[:, :2, :2]
    excess = np.where(chi2 > 1.0 + 3.0 * np.sqrt(2.0 / dof), chi2, 1.0)
    covariance = covariance * (excess * correlation)[:, None, None] + _FLOOR**2 * np.eye(2)
    used = state.precision > 0
    count = np.maximum(used.sum(axis=1), 1)
    square = np.where(used, state.residual**2, 0.0).sum(axis=1) / count
    expected = np.where(used, 1.0 / np.maximum(state.precision, 1e-12), 0.0).sum(axis=1) / count
    contrast = 2.0 * np.abs(state.parameters[:, 8])
    good = state.converged & (count > _PIXELS_MIN) & np.isfinite(covariance).all(axis=(1, 2))
    return CornerFits(
        xy=state.parameters[:, :2] + windows.origin,
        covariance=covariance,
        angle=state.parameters[:, 2:4],
        blur=np.exp(state.parameters[:, 4]),
        level=state.parameters[:, 5],
        amplitude=state.parameters[:, 8],
        chi2=chi2,
        misfit=np.sqrt(np.maximum(square - expected, 0.0)) / np.maximum(contrast, 1e-6),
        saturated=np.asarray((windows.saturated & windows.valid).any(axis=1)),
        converged=good,
    )
