"""Targets that carry each other's number in some poses: found from lengths on the body, pose by pose."""

from collections import defaultdict
from dataclasses import replace
from itertools import combinations

import numpy as np

from robcal.photogrammetry.core.bodies import Body, IntArray
from robcal.photogrammetry.measure.measured_points import Exchange, MeasuredPoints
from robcal.transforms import Array

LEAST_DEVIATION = 1e-3
"""Metres: deviations of lengths below this are no matter of numbers."""
LEFT_OVER = 0.1
"""Share of the deviation that may remain once the numbers are exchanged."""
FEWEST_TARGETS = 4
"""With three targets an exchange of two and one target off its place look alike."""


def find_exchanges(points: MeasuredPoints, body: Body) -> tuple[Exchange, ...]:
    """Pairs of targets whose numbers are exchanged in fewer than half of the poses that show both.

    Each pose is judged by its own lengths alone, by medians, so that one gross error beside hides nothing. Numbers that
    are exchanged in most poses are a fault of the body's file, which the diagnosis tells.

    Weakness: an exchange that leaves all lengths as they are (a symmetric body) does not show; nor does one in poses
    with fewer than four known targets.
    """
    at = body.index(points.target)
    usable = (at >= 0) & body.known[at]
    found: dict[tuple[int, int], list[tuple[int, float, float]]] = defaultdict(list)
    for pose in np.unique(points.pose[usable]):
        rows = np.flatnonzero(usable & (points.pose == pose))
        if len(rows) < FEWEST_TARGETS:
            continue
        for i, j, before, after in _in_pose(points.p_world[rows], body.points[at[rows]]):
            a, b = sorted((int(points.target[rows[i]]), int(points.target[rows[j]])))
            found[a, b].append((int(pose), before, after))

    def shown(pair: tuple[int, int]) -> int:
        """Number of poses that show both targets."""
        poses = [points.pose[usable & (points.target == t)] for t in pair]
        return len(np.intersect1d(*poses))

    exchanges = []
    for pair, hits in sorted(found.items()):
        poses = tuple(pose for pose, _, _ in hits)
        if 2 * len(poses) < shown(pair):
            exchanges.append(Exchange(pair, poses, *(float(np.median([hit[k] for hit in hits])) for k in (1, 2))))
    return tuple(exchanges)


def exchanged_back(points: MeasuredPoints, exchanges: tuple[Exchange, ...]) -> MeasuredPoints:
    """The points with the right numbers, in the order in which they were recorded, and what was exchanged."""
    target: IntArray = points.target.copy()
    for exchange in exchanges:
        inside = np.isin(points.pose, exchange.poses)
        first, second = (inside & (points.target == t) for t in exchange.targets)
        target[first], target[second] = exchange.targets[1], exchange.targets[0]
    return replace(points, target=target, exchanges=exchanges)


def _in_pose(measured: Array, body: Array) -> list[tuple[int, int, float, float]]:
    """Rows (i, j) of a pose that are exchanged, with the median deviation (m) of their lengths before and after."""
    n = len(body)
    length = np.linalg.norm(measured[:, None] - measured[None], axis=2)
    expected = np.linalg.norm(body[:, None] - body[None], axis=2)
    off = np.abs(length - expected)
    off[np.arange(n), np.arange(n)] = np.nan
    suspects = np.flatnonzero(np.nanmedian(off, axis=1) > LEAST_DEVIATION)
    trials = []
    for i, j in combinations(suspects.tolist(), 2):
        others = np.setdiff1d(np.arange(n), [i, j])
        before = float(np.median(off[[i, j]][:, others]))
        swapped = np.abs(length[[i, j]][:, others] - expected[[j, i]][:, others])
        after = float(np.median(swapped))
        if before > LEAST_DEVIATION and after < LEFT_OVER * before:
            trials.append((after, before, i, j))
    reported: list[tuple[int, int, float, float]] = []
    taken: set[int] = set()
    for after, before, i, j in sorted(trials):
        if not {i, j} & taken:
            taken |= {i, j}
            reported.append((i, j, before, after))
    return reported
