"""Reliability of a network's marks: redundancy numbers, standardised residuals, data snooping, variance components.

Sources: Baarda (1968), "A testing procedure for use in geodetic networks" (w-test, redundancy numbers);
Förstner (1979), variance components by sums of squares over redundancies.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import stats

from robcal.photogrammetry.bundle.normals import Factor, Linearised, MarkOrder
from robcal.photogrammetry.core.network import IntArray
from robcal.transforms import Array


@dataclass(frozen=True)
class Reliability:
    """Per mark, sorted as in the MarkOrder.

    ``residual_cofactor`` (m, 2, 2) of the whitened residuals; ``share`` (m,) its trace, the mark's redundancy.
    """

    residual_cofactor: Array

    @property
    def share(self) -> Array:
        """Redundancy (m,) of each mark, 0 .. 2."""
        return np.trace(self.residual_cofactor, axis1=1, axis2=2)


def reliability(lin: Linearised, order: MarkOrder, factor: Factor, Q: Array, weights: Array) -> Reliability:
    """Cofactors of the whitened residuals ``I - J Q J'`` from the marginal cofactors of each mark's unknowns.

    ``weights`` (m,) are those of the normal equations; the result is for marks whitened with them.
    """
    k, marks = lin.k, order.marks
    t = order.targets
    Q_station, Q_mixed = factor.station_cofactors(Q)
    J = lin.J * np.sqrt(weights)[:, None, None]
    Jc, Jx, Jp = J[:, :, :k], J[:, :, k : k + 3], J[:, :, k + 3 :]
    Qx = Q[k:, k:].reshape(t, 3, t, 3)[np.arange(t), :, np.arange(t), :]
    Qxc = Q[k:, :k].reshape(t, 3, k)
    Qxp = Q_mixed[k:].reshape(t, 3, order.images, 6)
    Qcp = Q_mixed[:k].transpose(1, 0, 2)
    # half of the mixed terms plus half of the pure ones, then the transpose is added
    by_camera = 0.5 * (Jc @ Q[:k, :k]) + Jx @ Qxc[marks.target]
    by_point = 0.5 * (Jx @ Qx[marks.target])
    by_station = 0.5 * (Jp @ Q_station[marks.image]) + Jc @ Qcp[marks.image] + Jx @ Qxp[marks.target, :, marks.image, :]
    half = np.einsum("mia,mja->mij", by_camera, Jc)
    half += np.einsum("mia,mja->mij", by_point, Jx)
    half += np.einsum("mia,mja->mij", by_station, Jp)
    return Reliability(np.eye(2) - half - np.swapaxes(half, 1, 2))


def test_statistics(r: Array, rel: Reliability) -> Array:
    """Chi-square (2 degrees of freedom) of each mark's whitened residual (m, 2); zero where it has no redundancy."""
    C = rel.residual_cofactor
    det = C[:, 0, 0] * C[:, 1, 1] - C[:, 0, 1] * C[:, 1, 0]
    quadratic = C[:, 1, 1] * r[:, 0] ** 2 + C[:, 0, 0] * r[:, 1] ** 2 - 2.0 * C[:, 0, 1] * r[:, 0] * r[:, 1]
    return np.where(det > 1e-6, quadratic / np.maximum(det, 1e-6), 0.0)


def critical_value(marks: int, level: float) -> float:
    """Chi-square of two degrees of freedom that the largest of ``marks`` clean ones exceeds with probability level."""
    return float(stats.chi2.isf(level / max(marks, 1), 2))


def worst_marks(statistic: Array, critical: float, image: IntArray, target: IntArray) -> IntArray:
    """Rows to take out now: above the critical value and the largest of their image and of their target.

    A gross error also spoils its neighbours' residuals; the others get another chance after the next adjustment.
    """
    candidates = np.flatnonzero(statistic > critical)
    chosen: list[int] = []
    images: set[int] = set()
    targets: set[int] = set()
    for row in candidates[np.argsort(-statistic[candidates])]:
        if int(image[row]) in images or int(target[row]) in targets:
            continue
        chosen.append(int(row))
        images.add(int(image[row]))
        targets.add(int(target[row]))
    return np.array(chosen, dtype=np.int64)


def variance_factors(r: Array, share: Array, group: IntArray, groups: int) -> Array:
    """Variance factors (groups,): sum of squared whitened residuals by sum of redundancies; NaN for an empty group."""
    squares = np.bincount(group, weights=np.sum(r**2, axis=1), minlength=groups)
    redundancy = np.bincount(group, weights=share, minlength=groups)
    return np.where(redundancy > 1e-9, squares / np.maximum(redundancy, 1e-9), np.nan)
