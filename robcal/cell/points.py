"""The calibrated robot as a measuring machine."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from robcal.cell.adjustment import ASSUMED_TOUCH, Adjusted, Equations, adjust
from robcal.cell.carried import CarriedFrames
from robcal.transforms import Array

MOST_TOGETHER = 400
"""Touches of points touched more than once that are adjusted together."""


@dataclass(frozen=True)
class TouchedPoints:
    """Points measured by touching them.

    Attributes
    ----------
    names : (p,); places : (p, 3) in base coordinates, m; covariance : (p, 3, 3); touches : (p,) how often.
    touch_sigma : noise of a touch that was used, m; estimated : from the repetitions.
    together : adjustment of the points that were touched more than once; None without such.
    """

    names: tuple[str, ...]
    places: Array
    covariance: Array = field(repr=False)
    touches: NDArray[np.int64]
    touch_sigma: float
    estimated: bool
    together: Adjusted | None = None


def measure_points(tip: CarriedFrames, points: Sequence[str], touch_sigma: float | None = None) -> TouchedPoints:
    """Places of touched points with the covariance of robot, tool, joints and touches.

    Parameters
    ----------
    tip : frames of the touching tool. points : name of the point of each touch; one touched again is averaged.
    touch_sigma : noise of a touch, m; None to estimate it from points touched more than once.
    """
    names = tuple(dict.fromkeys(points))
    which = np.array([names.index(name) for name in points])
    counts = np.bincount(which, minlength=len(names))
    repeated = np.flatnonzero(counts[which] > 1)[:MOST_TOGETHER]
    together = None
    if len(repeated):
        together = _averaged(tip.subset(repeated), which[repeated], touch_sigma)[1]
    sigma = touch_sigma or (ASSUMED_TOUCH if together is None else together.touch_sigma)
    places, covariance = np.zeros((len(names), 3)), np.zeros((len(names), 3, 3))
    for k in range(len(names)):
        rows = np.flatnonzero(which == k)
        p, adjusted = _averaged(tip.subset(rows), np.zeros(len(rows), dtype=np.int64), sigma)
        places[k], covariance[k] = p[0], adjusted.covariance
    estimated = touch_sigma is None and together is not None
    return TouchedPoints(names, places, covariance, counts, sigma, estimated, together)


def _averaged(tip: CarriedFrames, which: NDArray[np.int64], sigma: float | None) -> tuple[Array, Adjusted]:
    """Places (p, 3) of the points of touches, in the order of their numbers."""
    numbers, at = np.unique(which, return_inverse=True)
    n, p = len(tip), len(numbers)
    A = np.zeros((n, 3, p, 3))
    A[np.arange(n), :, at, :] = -np.eye(3)
    B = np.zeros((n, 3, 6))
    B[:, :, :3] = tip.T[:, :3, :3]
    touch = np.repeat(np.arange(n), 3)

    def linearise(places: Array) -> Equations:
        f = tip.T[:, :3, 3] - places[at]
        return Equations(f.ravel(), A.reshape(3 * n, 3 * p), B.reshape(3 * n, 6), touch)

    start = np.array([tip.T[at == k, :3, 3].mean(axis=0) for k in range(p)])
    return adjust(linearise, lambda places, step: places + step.reshape(-1, 3), start, tip, sigma)
