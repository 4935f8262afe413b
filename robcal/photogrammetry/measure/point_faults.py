"""Faults that all measured points have in common: a wrong unit, or coordinates that mirror the body."""

import numpy as np

from robcal.errors import DegenerateGeometry
from robcal.photogrammetry.core.bodies import Body, IntArray
from robcal.transforms import Array, fit_frame, transform

LEAST_RATIO, LARGEST_RATIO = 0.2, 5.0
"""Measured lengths by those of the body; beyond, the units differ. Real scale errors are a thousand times smaller."""
MIRRORED = 0.1
"""RMS miss of the mirrored points by that of the points as they are, below which they are called mirrored."""


def length_ratio(pose: IntArray, target: IntArray, p_world: Array, body: Body) -> float | None:
    """Median over poses of measured by given lengths between targets; None without a pair of known targets."""
    ratios = []
    for rows, given in _groups(pose, target, body, least=2):
        a = np.linalg.norm(p_world[rows] - p_world[rows].mean(axis=0))
        b = np.linalg.norm(given - given.mean(axis=0))
        if b > 0:
            ratios.append(a / b)
    return float(np.median(ratios)) if ratios else None


def unit_fault(ratio: float | None) -> bool:
    """Whether a ratio of lengths says that the units differ."""
    return ratio is not None and not LEAST_RATIO < ratio < LARGEST_RATIO


def mirrored(pose: IntArray, target: IntArray, p_world: Array, body: Body) -> tuple[float, float] | None:
    """RMS miss (m) of the body in the points as they are and in their mirror image, if only the latter fits.

    None where the points fit, or where a plane body leaves it open. Two exchanged coordinates, one with the wrong sign
    and a left-handed system are the same mirror image up to a turn of the world.
    """
    squares, count = np.zeros(2), 0
    for rows, given in _groups(pose, target, body, least=4):
        for k, sides in enumerate((np.ones(3), np.array([1.0, 1.0, -1.0]))):
            try:
                a_T_b = fit_frame(p_world[rows] * sides, given)
            except DegenerateGeometry:
                break
            squares[k] += float(np.sum((p_world[rows] * sides - transform(a_T_b, given)) ** 2))
        else:
            count += len(rows)
    if not count:
        return None
    straight, mirror = np.sqrt(squares / count)
    return (float(straight), float(mirror)) if mirror < MIRRORED * straight else None


def _groups(pose: IntArray, target: IntArray, body: Body, least: int) -> list[tuple[IntArray, Array]]:
    """Rows of each pose with their coordinates on the body, where enough targets are known."""
    order = np.argsort(body.ids)
    at = np.clip(np.searchsorted(body.ids, target, sorter=order), 0, len(order) - 1)
    row = order[at]
    known = (body.ids[row] == target) & np.all(np.isfinite(body.points[row]), axis=1)
    rows = np.flatnonzero(known)
    rows = rows[np.argsort(pose[rows], kind="stable")]
    parts = np.split(rows, np.flatnonzero(np.diff(pose[rows])) + 1)
    return [(part, body.points[row[part]]) for part in parts if len(part) >= least]
