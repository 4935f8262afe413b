"""Columns with a unit prior beside the fitted parameters: normal equations, whole and in folds that are kept out."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from robcal.diagnosis.core.fitting import Fit
from robcal.physics.cause import Array


@dataclass(frozen=True)
class Normals:
    """Normal equations of the fitted parameters and of columns whose amplitudes have a unit prior."""

    gram: Array
    right: Array
    fitted: int

    def solve(self, variance: float) -> Array:
        """Parameters and amplitudes; the prior weighs as the variance factor says."""
        return np.linalg.solve(self.gram + np.diag(ridge(self.gram, self.fitted, variance)), self.right)


def ridge(gram: Array, fitted: int, variance: float) -> Array:
    """What is added to the diagonal of normal equations: next to nothing for fitted parameters, a unit prior else."""
    added = np.full(len(gram), 1e-9 * np.max(np.diag(gram)))
    added[fitted:] = variance
    return added


def scaled(present: Fit) -> Array:
    """Jacobian (m, p) of the fitted parameters with columns of unit length."""
    size = np.linalg.norm(present.jacobian, axis=0)
    return present.jacobian / np.where(size > 0, size, 1.0)


@dataclass(frozen=True)
class Folded:
    """Normal equations of each fold, and in them the places of the fitted parameters and of each joint's columns."""

    folds: tuple[tuple[Array, Array, float, int], ...]
    ends: Array
    variance: float

    def _at(self, joints: Iterable[int]) -> Array:
        fitted = np.arange(int(self.ends[0]))
        return np.concatenate([fitted, *(np.arange(self.ends[k], self.ends[k + 1]) for k in joints)])

    def deviance(self, joints: Iterable[int]) -> Array:
        """Minus twice the logarithm of the predictive density (folds,) of each fold's residuals given the others', with
        the curves of the given joints.

        Unlike their sum of squares it weighs what a block shows by how well the other blocks determine it: one that
        reaches where no other was says little of which model is right.
        """
        fitted, at = int(self.ends[0]), self._at(joints)
        parts = [(N[np.ix_(at, at)], b[at], square, count) for N, b, square, count in self.folds]
        gram, right = np.sum([part[0] for part in parts], axis=0), np.sum([part[1] for part in parts], axis=0)
        square, added = sum(part[2] for part in parts), ridge(gram, fitted, self.variance)

        def evidence(N: Array, b: Array, total: float) -> float:
            L = np.linalg.cholesky(N + np.diag(added))
            white = np.linalg.solve(L, b)
            return (total - float(white @ white)) / self.variance + 2.0 * float(np.sum(np.log(np.diag(L))))

        whole = evidence(gram, right, square)
        out = [
            whole - evidence(gram - N, right - b, square - own) + count * np.log(self.variance)
            for N, b, own, count in parts
        ]
        return np.array(out)

    def kept_out(self, joints: Iterable[int]) -> float:
        """Sum of squares of the residuals that the other folds predict with the curves of the given joints."""
        fitted, at = int(self.ends[0]), self._at(joints)
        gram = np.sum([f[0] for f in self.folds], axis=0)[np.ix_(at, at)]
        right = np.sum([f[1] for f in self.folds], axis=0)[at]
        total = 0.0
        for N, b, square, _ in self.folds:
            here, own = N[np.ix_(at, at)], b[at]
            x = Normals(gram - here, right - own, fitted).solve(self.variance)
            total += square - 2.0 * float(x @ own) + float(x @ here @ x)
        return total


def folded(present: Fit, columns: Sequence[Array], label: Array) -> Folded:
    """The fitted parameters and the scaled columns (m, c) of each joint, in folds by the label (m,) of the rows."""
    fitted = scaled(present)
    X, r = np.column_stack([fitted, *columns]), present.residual
    folds = []
    for fold in np.unique(label):
        A, b = X[label == fold], r[label == fold]
        folds.append((A.T @ A, A.T @ b, float(b @ b), len(b)))
    ends = np.cumsum([fitted.shape[1], *(c.shape[1] for c in columns)])
    gram, right = np.sum([f[0] for f in folds], axis=0), np.sum([f[1] for f in folds], axis=0)
    return Folded(tuple(folds), ends, variance_with(present, X, gram, right, fitted.shape[1]))


def variance_with(present: Fit, X: Array, gram: Array, right: Array, fitted: int) -> float:
    """Variance factor with the columns in the model: two rounds, from that without."""
    variance = present.variance_factor
    for _ in range(2):
        left = present.residual - X @ Normals(gram, right, fitted).solve(variance)
        variance = float(left @ left) / max(len(left) - X.shape[1], 1)
    return variance


def amplitudes(present: Fit, columns: Sequence[Array]) -> list[Array]:
    """Amplitudes (c,) of each joint's scaled columns (m, c), estimated beside the fitted parameters."""
    fitted = scaled(present)
    X = np.column_stack([fitted, *columns])
    gram, right = X.T @ X, X.T @ present.residual
    x = Normals(gram, right, fitted.shape[1]).solve(variance_with(present, X, gram, right, fitted.shape[1]))
    ends = np.cumsum([fitted.shape[1], *(c.shape[1] for c in columns)])
    return [x[a:b] for a, b in pairwise(ends)]
