"""Whitening of what the observations of one pose share: the repeatability of the joints moves them all together."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from robcal.physics.cause import Array


@dataclass(frozen=True)
class SharedNoise:
    """Joint repeatability as a common error of all rows of a pose.

    Attributes
    ----------
    pose : (m_obs,) pose of each observation.
    moved : (m_obs, k, N) displacement of each observation per unit of each joint, whitened by the stated covariance.
    ratio : variance of the joints (rad^2 or m^2) in units of the variance factor.
    """

    pose: Array
    moved: Array
    ratio: float

    @cached_property
    def _blocks(self) -> list[tuple[Array, Array, Array]]:
        per = self.moved.shape[1]
        order = np.argsort(self.pose, kind="stable")
        pose = self.pose[order]
        starts = np.flatnonzero(np.r_[True, pose[1:] != pose[:-1]])
        blocks = []
        for members in np.split(order, starts[1:]):
            rows = (members[:, None] * per + np.arange(per)).ravel()
            A = self.moved[members].reshape(len(rows), -1)
            values, vectors = np.linalg.eigh(A @ A.T)
            root = np.sqrt(1.0 + self.ratio * np.clip(values, 0.0, None))
            blocks.append((rows, (vectors / root) @ vectors.T, (vectors * root) @ vectors.T))
        return blocks

    @cached_property
    def log_determinant(self) -> float:
        """Logarithm of the determinant of `1 + ratio A A'`, all poses together."""
        joints = self.moved.shape[2]
        total = 0.0
        for pose in np.unique(self.pose):
            A = self.moved[self.pose == pose].reshape(-1, joints)
            total += float(np.linalg.slogdet(np.eye(joints) + self.ratio * A.T @ A)[1])
        return total

    def whiten(self, rows_first: Array) -> Array:
        """Apply the inverse root of `1 + ratio A A'` to the rows (m, ...) pose by pose."""
        out = np.empty_like(rows_first)
        for rows, down, _ in self._blocks:
            out[rows] = down @ rows_first[rows]
        return out

    def unwhiten(self, rows_first: Array) -> Array:
        """Inverse of :meth:`whiten`."""
        out = np.empty_like(rows_first)
        for rows, _, up in self._blocks:
            out[rows] = up @ rows_first[rows]
        return out

    def subset(self, keep: Array) -> "SharedNoise":
        """Only the observations of the given indices."""
        return SharedNoise(self.pose[keep], self.moved[keep], self.ratio)


@dataclass(frozen=True)
class CommonNoise:
    """Errors that all observations share: the station's orientation, the coordinates of the body.

    `columns` (m, k) are the whitened displacements of all rows by one standard deviation of each common error.
    The covariance of whitened rows is `1 + N N'`; its inverse root is a change along k directions only.
    """

    columns: Array

    @cached_property
    def _directions(self) -> tuple[Array, Array]:
        U, s, _ = np.linalg.svd(self.columns, full_matrices=False)
        return U, np.sqrt(1.0 + s**2)

    def whiten(self, rows: Array) -> Array:
        """Apply the inverse root of the covariance to rows (m, ...)."""
        U, root = self._directions
        return np.asarray(rows + (U * (1.0 / root - 1.0)) @ (U.T @ rows))

    def unwhiten(self, rows: Array) -> Array:
        """Inverse of :meth:`whiten`."""
        U, root = self._directions
        return np.asarray(rows + (U * (root - 1.0)) @ (U.T @ rows))

    def estimate(self, whitened: Array) -> Array:
        """Most probable errors (k,) in their standard deviations, from rows (m,) as :meth:`whiten` returns them."""
        return np.asarray(self.columns.T @ self.whiten(whitened))
