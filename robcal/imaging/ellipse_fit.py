"""Least-squares fit of blurred ellipses to grey values, all ellipses of a group at once.

Grey value = b0 + b1 x + b2 y + (g0 + g1 x + g2 y) E(x, y): background plane, contrast with a linear gain gradient,
step profile E of :mod:`robcal.imaging.edge_model`. x, y in the linear terms count from the start's centre in units of
the dot's radius. The gain gradient costs precision (it looks like a shift of the edge), so it carries a
normal prior of zero mean whose variance is estimated from all dots of the image (empirical Bayes): no shading, no
cost; shading, no bias. Saturated pixels are censored: they only say that the value is at least the saturation level.

Pixels are in single precision, parameters and their normal equations in double. Centres cx, cy count from the origin of
the fit's window.
"""

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from robcal.columns import Columns
from robcal.imaging.edge_model import SHAPE_PARAMETERS, blurred_ellipse, profile_only, spot
from robcal.imaging.noise import NoiseModel
from robcal.imaging.windows import Windows

if TYPE_CHECKING:
    from robcal.imaging.ellipse_loop import Dots

Array = NDArray[np.float64]

PARAMETERS = SHAPE_PARAMETERS + 6  # b0, b1, b2, g0, g1, g2
_LN_BLUR_SIGMA = 1.0  # weak prior on ln s: keeps dots of two pixels from an edge sharper or softer than can be
_OUTLIER_SIGMA = 6.0
_SHADING_SIGMA_MIN = 1e-3  # per radius; keeps the prior finite
_SINGULAR = 1e-7  # smallest eigenvalue of a scaled normal matrix summed in single precision
_LN_S_MIN = float(np.log(0.28))
_COST_DIGITS = 2e-6  # relative accuracy of a cost summed in single precision


@dataclass(frozen=True)
class EllipseFits(Columns):
    """State of n fits.

    Attributes
    ----------
    parameters : (n, 12) cx, cy, B11, B12, B22, ln s, b0, b1, b2, g0, g1, g2.
    normal : (n, 12, 12) normal matrices with priors, in the metric of the stated noise.
    cost : (n,) weighted sum of squares with priors. converged : (n,) bool. is_spot : (n,) bool.
    weight : (n, p) used last, zero for pixels without information. residual : (n, p) grey values.
    shading_sigma : (n,) prior sigma of g1 / g0 and g2 / g0 per radius.
    """

    parameters: Array
    normal: Array
    cost: Array
    converged: NDArray[np.bool_]
    is_spot: NDArray[np.bool_]
    weight: Array
    residual: Array
    shading_sigma: Array

    def covariance(self) -> Array:
        """(n, 12, 12) inverse of the normal matrices; infinite centre variances where they are singular."""
        scale = 1.0 / np.sqrt(np.maximum(np.diagonal(self.normal, axis1=1, axis2=2), 1e-100))
        scaled = self.normal * scale[:, :, None] * scale[:, None, :]
        scaled[:, np.arange(PARAMETERS), np.arange(PARAMETERS)] += 1e-13
        inverse = np.linalg.inv(scaled)
        # the largest variance of a scaled parameter is the inverse of the smallest eigenvalue, nearly
        variance = np.diagonal(inverse, axis1=1, axis2=2)
        singular = ~((variance > 0.0) & (variance < 1.0 / _SINGULAR)).all(axis=1)
        inverse *= scale[:, :, None] * scale[:, None, :]
        inverse[singular] = np.diag(np.full(PARAMETERS, np.inf))
        return np.asarray(inverse, dtype=np.float64)


def evaluate(
    parameters: Array, windows: Windows, is_spot: NDArray[np.bool_], out: Array | None = None
) -> tuple[Array, Array]:
    """Model grey values (n, p) and their derivatives (n, 12, p); `out` (n, >= 12, p) takes the derivatives."""
    shape, x, y = parameters[:, :SHAPE_PARAMETERS], windows.u, windows.v
    jacobian = np.empty((len(x), PARAMETERS, x.shape[1]), x.dtype) if out is None else out[:, :PARAMETERS]
    by_shape = jacobian[:, :SHAPE_PARAMETERS]
    if is_spot.all():
        profile, _ = spot(shape, windows.x, windows.y, by_shape)
    else:
        profile, _ = blurred_ellipse(shape, windows.x, windows.y, by_shape)
        if is_spot.any():
            profile[is_spot], by_shape[is_spot] = spot(shape[is_spot], windows.x[is_spot], windows.y[is_spot])
    b0, b1, b2, g0, g1, g2 = _linear(parameters, x)
    gain = g0 + g1 * x + g2 * y
    by_shape *= gain[:, None]
    jacobian[:, 6] = 1.0
    jacobian[:, 7] = x
    jacobian[:, 8] = y
    jacobian[:, 9] = profile
    np.multiply(profile, x, out=jacobian[:, 10])
    np.multiply(profile, y, out=jacobian[:, 11])
    return b0 + b1 * x + b2 * y + gain * profile, jacobian


def _linear(parameters: Array, like: Array) -> list[Array]:
    typed = parameters.astype(like.dtype, copy=False)
    return [typed[:, SHAPE_PARAMETERS + k, None] for k in range(6)]


def grey_values(parameters: Array, windows: Windows, is_spot: NDArray[np.bool_]) -> Array:
    """Model grey values (n, p)."""
    profile = profile_only(parameters[:, :SHAPE_PARAMETERS], windows.x, windows.y, is_spot)
    b0, b1, b2, g0, g1, g2 = _linear(parameters, windows.u)
    return b0 + b1 * windows.u + b2 * windows.v + (g0 + g1 * windows.u + g2 * windows.v) * profile


def start(shape: Array, base: Array, peak: Array, windows: Windows, is_spot: NDArray[np.bool_]) -> EllipseFits:
    """Fits before their first step, from (n, 6) shapes and grey levels below and at the top of the blobs."""
    n = len(shape)
    parameters = np.zeros((n, PARAMETERS))
    parameters[:, :SHAPE_PARAMETERS] = shape
    parameters[:, 6], parameters[:, 9] = base, peak - base
    zeros = np.zeros_like(windows.x)
    return EllipseFits(
        parameters,
        np.zeros((n, PARAMETERS, PARAMETERS)),
        np.full(n, np.inf),
        np.zeros(n, bool),
        is_spot,
        zeros,
        zeros,
        np.zeros(n),
    )


def iterate(
    fits: EllipseFits,
    windows: Windows,
    noise: NoiseModel,
    steps: int,
    tolerance: float = 0.02,
    dropped: NDArray[np.bool_] | None = None,
    prior_blur: Array | None = None,
) -> EllipseFits:
    """Levenberg-Marquardt steps on all fits that have not converged.

    Parameters
    ----------
    steps : at most. tolerance : converged when a step moves the centre less than this part of its sigma.
    dropped : (n, p) pixels left out as outliers. prior_blur : (n,) ln s of the weak prior, default the start's.
    """
    n = len(fits.parameters)
    if n == 0:
        return fits
    from robcal.imaging.ellipse_loop import Fits, minimise_all  # compiled: imported where it runs

    used = windows.valid if dropped is None else windows.valid & ~dropped
    dots = _dots(fits, windows, used, fits.parameters[:, 5] if prior_blur is None else prior_blur)
    ended = Fits(
        fits.parameters.copy(),
        np.empty((n, PARAMETERS, PARAMETERS)),
        np.empty(n),
        np.zeros(n, bool),
        np.zeros_like(windows.x),
        np.zeros_like(windows.x),
    )
    noise_model = np.array([noise.variance, noise.gain, noise.level, noise.step**2 / 12.0])
    minimise_all(dots, noise_model, np.array([steps, tolerance, _COST_DIGITS, _LN_S_MIN]), ended)
    return replace(fits, **ended._asdict())


def _dots(fits: EllipseFits, windows: Windows, used: NDArray[np.bool_], prior_blur: Array) -> "Dots":
    from robcal.imaging.ellipse_loop import Dots

    priors = [
        prior_blur,
        np.full(len(used), 1.0 / _LN_BLUR_SIGMA**2),
        np.maximum(fits.shading_sigma, _SHADING_SIGMA_MIN),
        windows.radius,
        np.maximum(used.sum(axis=1), 1),
    ]
    places = (windows.x, windows.y, windows.u, windows.v, windows.value)
    return Dots(*places, used, windows.saturated, _last(used), fits.is_spot, np.stack(priors, axis=1))


def bright_sums(fits: EllipseFits, windows: Windows) -> tuple[Array, Array, Array]:
    """Of the pixels of each dot above 0.6 of its contrast: redundancy, sum of squared residuals, mean grey value (n,).

    The mean is weighted by the pixels' redundancies; 0 where there are none.
    """
    from robcal.imaging.ellipse_loop import sum_bright  # compiled: imported where it runs

    covariance = fits.covariance()
    covariance[~np.isfinite(covariance)] = 0.0
    sums = np.zeros((len(covariance), 3))
    dots = _dots(fits, windows, fits.weight > 0, fits.parameters[:, 5])
    sum_bright(dots, fits.parameters, fits.weight, covariance, sums)
    return sums[:, 0], sums[:, 1], sums[:, 2] / np.maximum(sums[:, 0], 1e-9)


def _last(used: NDArray[np.bool_]) -> NDArray[np.int64]:
    """(n,) pixels of each row up to the last one used."""
    return np.asarray(used.shape[1] - np.argmax(used[:, ::-1], axis=1))


def free_shading(fits: EllipseFits) -> tuple[Array, Array]:
    """What the gain gradients would be if they were free, to first order.

    Returns
    -------
    gradient : (n, 2) relative change of contrast per radius. variance : (n,) mean of the two.
    """
    contrast = np.maximum(np.abs(fits.parameters[:, 9]), 1e-3)
    normal = fits.normal.copy()
    precision = 1.0 / (np.maximum(fits.shading_sigma, _SHADING_SIGMA_MIN) * contrast) ** 2
    right = np.zeros((len(normal), PARAMETERS))
    for k in (10, 11):
        # taking the prior away moves the minimum by its own pull
        right[:, k] = precision * fits.parameters[:, k]
        normal[:, k, k] -= precision
    return _marginal_shading(fits, normal, right, contrast)


def _marginal_shading(fits: EllipseFits, normal: Array, right: Array, contrast: Array) -> tuple[Array, Array]:
    scale = 1.0 / np.sqrt(np.maximum(np.diagonal(normal, axis1=1, axis2=2), 1e-100))
    scaled = normal * scale[:, :, None] * scale[:, None, :]
    scaled[:, np.arange(PARAMETERS), np.arange(PARAMETERS)] += 1e-10
    # gradient of the data's cost at the present parameters equals minus the prior's pull (stationary point)
    inverse = np.linalg.inv(scaled) * scale[:, :, None] * scale[:, None, :]
    step = np.einsum("nij,nj->ni", inverse, right)
    gradient = (fits.parameters[:, 10:12] + step[:, 10:12]) / contrast[:, None]
    variance = 0.5 * (inverse[:, 10, 10] + inverse[:, 11, 11]) / contrast**2
    return gradient, np.maximum(variance, 1e-18)


def outliers(fits: EllipseFits, windows: Windows) -> NDArray[np.bool_]:
    """(n, p) pixels that neither noise nor a slightly wrong model explains: hot pixels, dust."""
    contrast = np.abs(fits.parameters[:, 9, None])
    normalised = np.abs(fits.residual) * np.sqrt(fits.weight)
    # the model's own misfit is the typical residual
    typical = np.sqrt(
        np.einsum("np,np->n", fits.weight, fits.residual**2) / np.maximum((fits.weight > 0).sum(axis=1), 1)
    )
    limit = _OUTLIER_SIGMA * np.maximum(1.0, np.minimum(typical, 3.0))[:, None]
    flagged = windows.valid & (normalised > limit) & (np.abs(fits.residual) > 0.06 * contrast)
    # more than a few percent of outliers is not dust but another shape
    few = flagged.sum(axis=1) <= 0.04 * windows.valid.sum(axis=1)
    return flagged & few[:, None]
