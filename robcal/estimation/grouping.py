"""Sums over groups of rows (all marks of an image, all rays of a point): the inner loops of batched adjustments."""

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]

_SMALL = 20_000


def sum_by(group: IntArray, values: Array, n: int) -> Array:
    """Sums of ``values`` (m, ...) over equal numbers in ``group`` (m,), shape (n, ...)."""
    m = len(group)
    if m == 0:
        return np.zeros((n, *values.shape[1:]))
    if n == 1:
        return values.sum(axis=0, keepdims=True)
    if n * m <= _SMALL:  # a dense matrix costs less than setting up a sparse one
        chooser = (group == np.arange(n)[:, None]).astype(float)
        return (chooser @ values.reshape(m, -1)).reshape(n, *values.shape[1:])
    adder = sparse.csr_matrix((np.ones(m), (group, np.arange(m))), shape=(n, m))
    return np.asarray(adder @ values.reshape(m, -1)).reshape(n, *values.shape[1:])


def members(group: IntArray, chosen: IntArray, n: int) -> tuple[IntArray, IntArray]:
    """Rows (k,) of ``group`` (m,) that belong to the ``chosen`` groups of n, and their places (k,) in ``chosen``."""
    if len(chosen) == n:
        return np.arange(len(group)), group
    place = np.full(n, -1, dtype=np.int64)
    place[chosen] = np.arange(len(chosen))
    rows = np.flatnonzero(place[group] >= 0)
    return rows, place[group[rows]]


def whitener(covariance: Array) -> Array:
    """Matrices W (..., k, k) with ``W' W = inverse(covariance)`` (inverse Cholesky factors)."""
    if covariance.shape[-1] != 2:
        return np.asarray(np.linalg.inv(np.linalg.cholesky(covariance)))
    # marks are many and 2 x 2: written out
    a, b, c = covariance[..., 0, 0], covariance[..., 1, 0], covariance[..., 1, 1]
    with np.errstate(divide="ignore", invalid="ignore"):
        first = np.sqrt(a)
        below = b / first
        second = np.sqrt(c - below**2)
        W = np.zeros(np.shape(covariance))
        W[..., 0, 0] = 1.0 / first
        W[..., 1, 0] = -below / (first * second)
        W[..., 1, 1] = 1.0 / second
    if not np.isfinite(W).all():
        raise np.linalg.LinAlgError("a covariance is not positive definite")
    return W
