"""Covariance, conditioning and global test of a whitened least-squares estimate."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import linalg, special

Array = NDArray[np.float64]


@dataclass(frozen=True)
class LinearStatistics:
    """What a whitened Jacobian tells about the estimate.

    Attributes
    ----------
    cofactor : (p, p) inverse of the normal matrix: covariance for unit variance of the whitened residuals.
    condition : of the Jacobian with columns of unit length.
    condition_raw : of the Jacobian in SI units.
    correlations : (p, p).
    singular_values : of the Jacobian in SI units divided by sqrt(rows), largest first.
    """

    cofactor: Array
    condition: float
    condition_raw: float
    correlations: Array
    singular_values: Array


def cofactor(J: Array) -> Array:
    """Inverse (p, p) of the normal matrix of a Jacobian (m, p) of full column rank, by QR of unit columns."""
    return np.zeros((0, 0)) if J.shape[1] == 0 else _inverse_normal(*_triangle(J))


def linear_statistics(J: Array) -> LinearStatistics:
    """Cofactor matrix, condition numbers and correlations of a whitened Jacobian (m, p) of full column rank."""
    if J.shape[1] == 0:
        empty = np.zeros((0, 0))
        return LinearStatistics(empty, 1.0, 1.0, empty, np.zeros(0))
    R, scale = _triangle(J)
    values = linalg.svdvals(R, check_finite=False)
    raw = linalg.svdvals(R * scale, check_finite=False)
    inverse = _inverse_normal(R, scale)
    sigma = np.sqrt(np.diag(inverse))
    return LinearStatistics(
        inverse,
        float(values[0] / values[-1]),
        float(raw[0] / raw[-1]),
        inverse / np.outer(sigma, sigma),
        raw / np.sqrt(len(J)),
    )


def _triangle(J: Array) -> tuple[Array, Array]:
    """Triangular factor (p, p) of a Jacobian with columns of unit length, and their lengths (p,)."""
    scale = np.linalg.norm(J, axis=0)
    return linalg.qr(J / scale, mode="r", check_finite=False)[0][: J.shape[1]], scale


def _inverse_normal(R: Array, scale: Array) -> Array:
    inverse = linalg.lapack.dtrtri(R)[0]
    return np.asarray((inverse @ inverse.T) / np.outer(scale, scale))


def global_test(cost: float, redundancy: int) -> tuple[float, float]:
    """sigma0 and the p-value of a residual sum as large or larger (chi-square) if the stated covariance holds."""
    if redundancy <= 0:
        return 1.0, 1.0
    return float(np.sqrt(2.0 * cost / redundancy)), float(special.chdtrc(redundancy, 2.0 * cost))
