"""Redundancy and data snooping: tests of single observations, what to take out, variance components.

Sources: Baarda (1968), "A testing procedure for use in geodetic networks" (w-test, redundancy numbers);
Foerstner (1979), variance components by sums of squares over redundancies.
"""

import numpy as np
from scipy import stats

from robcal.estimation.grouping import Array, IntArray


def mark_statistics(r: Array, cofactor: Array) -> Array:
    """Chi-square (2 degrees of freedom) of each mark's whitened residual (m, 2); zero where it has no redundancy.

    ``cofactor`` (m, 2, 2) of the whitened residuals (redundancy matrices).
    """
    C = cofactor
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
