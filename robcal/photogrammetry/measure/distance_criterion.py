"""The distance criterion of a measuring body: distances between measured targets against those of the body.

A pair is accepted if its distance deviates by less than a tolerance; of the targets in rejected pairs the smallest set
is eliminated that leaves none (a minimum vertex cover, Karp 1972). The tolerance comes from the covariance (4 sigma);
what recurs from pose to pose is separated from isolated errors first.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from robcal.photogrammetry.core.bodies import IntArray, pairs
from robcal.transforms import Array

_ALL_PAIRS_UP_TO = 24
_STRIDES = (1, 2, 3, 5, 8, 13, 21, 34)


@dataclass(frozen=True)
class PairTable:
    """Pairs of targets measured in the same pose, rows of the point table: ``first``, ``second`` (k,) point rows,
    ``pose`` (k,), ``a``, ``b`` (k,) body rows with a < b, ``distance`` (k,) m, ``variance`` (k,) m^2 of the distance
    from the points' covariance, ``direction`` (k, 3) unit vector in the world."""

    first: IntArray
    second: IntArray
    pose: IntArray
    a: IntArray
    b: IntArray
    distance: Array
    variance: Array
    direction: Array

    def __len__(self) -> int:
        return len(self.pose)


def make_pairs(pose: IntArray, row: IntArray, p_world: Array, covariance: Array) -> PairTable:
    """All pairs within each pose (with more than 24 targets a fixed selection of about eight per target).

    Parameters
    ----------
    pose : (m,) pose of each point; row : (m,) its row in the body; p_world (m, 3); covariance (m, 3, 3).
    """
    order = np.lexsort((row, pose))
    starts = np.flatnonzero(np.r_[True, np.diff(pose[order]) != 0])
    ends = np.r_[starts[1:], len(order)]
    first: list[IntArray] = []
    second: list[IntArray] = []
    cache: dict[int, IntArray] = {}
    for s, e in zip(starts, ends, strict=True):
        n = int(e - s)
        if n < 2:
            continue
        if n not in cache:
            cache[n] = _selection(n)
        first.append(order[s + cache[n][:, 0]])
        second.append(order[s + cache[n][:, 1]])
    i = np.concatenate(first) if first else np.empty(0, dtype=np.int64)
    j = np.concatenate(second) if second else np.empty(0, dtype=np.int64)
    d = p_world[j] - p_world[i]
    length = np.linalg.norm(d, axis=1)
    direction = d / np.maximum(length, 1e-300)[:, None]
    variance = np.einsum("ki,kij,kj->k", direction, covariance[i] + covariance[j], direction)
    return PairTable(i, j, pose[i], row[i], row[j], length, variance, direction)


def _selection(n: int) -> IntArray:
    if n <= _ALL_PAIRS_UP_TO:
        return pairs(n)
    chosen = {(min(i, (i + s) % n), max(i, (i + s) % n)) for i in range(n) for s in _STRIDES if s % n}
    return np.array(sorted(chosen), dtype=np.int64)


def body_pair_variance(points: Array, covariance: Array | None, a: IntArray, b: IntArray) -> Array:
    """(k,) variance of the body's own distances between rows a and b, from its full covariance (0 without one)."""
    if covariance is None:
        return np.zeros(len(a))
    d = points[b] - points[a]
    unit = d / np.maximum(np.linalg.norm(d, axis=1), 1e-300)[:, None]
    ia, ib = 3 * a[:, None] + np.arange(3), 3 * b[:, None] + np.arange(3)

    def block(i: IntArray, j: IntArray) -> Array:
        return covariance[i[:, :, None], j[:, None, :]]

    C = block(ia, ia) + block(ib, ib) - block(ia, ib) - block(ib, ia)
    return np.maximum(np.einsum("ki,kij,kj->k", unit, C, unit), 0.0)


def culprits(n: int, bad: Sequence[tuple[int, int]], badness: NDArray[np.float64], keep: int = 3) -> set[int] | None:
    """Smallest set of items that touches every bad pair; of several the one that takes away the most badness.

    Parameters
    ----------
    n : number of items; bad : violated pairs; badness (n, n) symmetric, squared normalised deviation of every pair.
    keep : at least so many items must stay.

    Returns
    -------
    The set, or None when more than ``n - keep`` items would have to go.
    """
    if not bad:
        return set()
    nodes = sorted({i for pair in bad for i in pair})
    budget = n - keep
    for size in range(1, min(budget, len(nodes)) + 1):
        if _number_of_subsets(len(nodes), size) > 20000:
            greedy = _greedy(bad)
            return greedy if len(greedy) <= budget else None
        best: tuple[float, set[int]] | None = None
        for chosen in combinations(nodes, size):
            removed = set(chosen)
            if any(i not in removed and j not in removed for i, j in bad):
                continue
            stay = [i for i in range(n) if i not in removed]
            left = float(np.nansum(badness[np.ix_(stay, stay)]))
            if best is None or left < best[0]:
                best = (left, removed)
        if best is not None:
            return best[1]
    return None


def _number_of_subsets(n: int, k: int) -> float:
    return float(np.prod([(n - i) / (i + 1) for i in range(k)]))


def _greedy(bad: Sequence[tuple[int, int]]) -> set[int]:
    left = list(bad)
    out: set[int] = set()
    while left:
        count: dict[int, int] = {}
        for pair in left:
            for i in pair:
                count[i] = count.get(i, 0) + 1
        worst = max(sorted(count), key=lambda i: count[i])
        out.add(worst)
        left = [pair for pair in left if worst not in pair]
    return out


def robust_scale(values: Array) -> float:
    """Standard deviation from the median of absolute values (zero mean assumed)."""
    return float(1.4826 * np.median(np.abs(values))) if len(values) else 0.0
