"""Least squares that leaves alone what the data do not determine: minimum-norm steps and pseudo-covariances."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

UNDETERMINED = 1e-6
"""Directions of the scaled Jacobian below this share of the largest stay as they are: their sigma would be a radian."""
MANY = 120
"""Parameters from which normal equations replace the singular values of the Jacobian."""


def solve(jacobian: Array, residual: Array) -> Array:
    """Minimum-norm least-squares step (p,) of residuals (m,) by a Jacobian (m, p) of columns scaled to unit length."""
    scaled, safe = _scaled(jacobian)
    if jacobian.shape[1] > MANY:
        gram = scaled.T @ scaled + UNDETERMINED**2 * np.eye(jacobian.shape[1])
        return np.asarray(np.linalg.solve(gram, scaled.T @ residual) / safe)
    return np.asarray(np.linalg.lstsq(scaled, residual, rcond=UNDETERMINED)[0] / safe)


def pseudo_covariance(jacobian: Array) -> Array:
    """Pseudo-inverse (p, p) of the normal matrix, columns scaled; directions without information get no variance.

    By singular values of the Jacobian, since those of the normal matrix drown in rounding at the square of its range.
    """
    scaled, safe = _scaled(jacobian)
    if jacobian.shape[1] > MANY:  # the triangular factor has the same singular values
        scaled = np.asarray(np.linalg.qr(scaled, mode="r"))
    _, singular, right = np.linalg.svd(scaled, full_matrices=False)
    seen = singular > UNDETERMINED * singular.max(initial=0.0)
    root = (right[seen].T / singular[seen]) / safe[:, None]
    return root @ root.T


def _scaled(jacobian: Array) -> tuple[Array, Array]:
    """Columns of unit length (or zero), and their lengths (one for zero)."""
    size = np.linalg.norm(jacobian, axis=0)
    safe = np.where(size > 0, size, 1.0)
    return jacobian / safe, safe
