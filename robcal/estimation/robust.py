"""Robust estimation by re-weighting: cost functions of the length of a whitened residual, and their weights.

Sources: Huber (1964); Geman and McClure (1987); Holland and Welsch (1977), iteratively re-weighted least squares. A
weight multiplies the squared residual; residuals that are not finite (behind a camera) have weight zero.
"""

import numpy as np

from robcal.estimation.grouping import Array


def huber_weights(length: Array, limit: float) -> Array:
    """Weights of residuals of these lengths (m,): 1 up to the limit, then falling with the inverse length."""
    weights = np.where(length > limit, limit / np.maximum(length, 1e-300), 1.0)
    return np.where(np.isfinite(length), weights, 0.0)


def huber_costs(length: Array, limit: float) -> Array:
    """Costs (m,): squares up to the limit, then linear."""
    return np.where(length > limit, 2.0 * limit * length - limit**2, length**2)


def geman_mcclure_weights(length: Array) -> Array:
    """Weights of residuals of these lengths (m,), in units of the scale from which on they count less and less."""
    return 1.0 / (1.0 + np.where(np.isfinite(length), length, np.inf) ** 2) ** 2


def geman_mcclure_costs(length: Array) -> Array:
    """Costs (m,), never above one."""
    return 1.0 - 1.0 / (1.0 + np.where(np.isfinite(length), length, np.inf) ** 2)


def median_scale(r: Array) -> float:
    """Standard deviation of a coordinate from the median length of residual vectors in the plane (m, 2)."""
    # the length of a standard normal vector in the plane has the median sqrt(2 ln 2)
    return float(np.median(np.linalg.norm(r, axis=1)) / np.sqrt(2.0 * np.log(2.0)))
