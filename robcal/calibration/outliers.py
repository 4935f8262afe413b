"""How well single poses agree with an identification, and which of them contradict all others.

A blunder (a wrong row, a bumped target) stands out against the spread of all poses. What the model lacks spreads over
many poses and has long tails of its own: there the limit follows the tails, and where many poses are under suspicion
none is left out.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import special

from robcal.calibration.observations import Stack
from robcal.calibration.solution import Engine, Solution
from robcal.estimation.covariance import cofactor

Array = NDArray[np.float64]

LEVEL = 1e-3
"""Probability that the largest of all poses is called an outlier by chance."""
LARGEST_SHARE = 0.15
"""More suspicious poses than this share are no outliers but a misfit of the model: all are kept."""
FEWEST_POSES = 8
MARGIN = 1.5
TAIL = 1.3
"""Width of the upper half, against that of chi-square, above which the residuals have long tails."""


@dataclass(frozen=True)
class PoseStatistics:
    """How poses agree with a solution.

    Attributes
    ----------
    residuals : (n, D) whitened; for poses left out they are predictions.
    mean_square : (n,) studentised mean squares (near one); leverage, redundancy : (n,).
    """

    residuals: Array
    mean_square: Array
    leverage: Array
    redundancy: Array


def pose_statistics(solution: Solution, weights: Array, stack: Stack) -> PoseStatistics:
    """Statistics of the poses at a solution.

    For poses left out the residuals are predictions: their spread is I + A Q A', not I - A Q A'.
    """
    problem = solution.problem
    r, A = problem.unweighted().blocks(solution.state)
    J = A[stack.used] if np.all(weights == 1.0) and not problem.prior else problem.linearise(solution.state)[1]
    Q = cofactor(J)
    H = A @ Q @ np.swapaxes(A, 1, 2)
    sign = np.where(weights > 0, -1.0, 1.0)[:, None, None]
    spread = np.eye(H.shape[1]) + sign * H
    count = stack.used.sum(axis=1)
    # a pose that alone determines something has a singular spread: count only what it can contradict
    values, vectors = np.linalg.eigh(spread)
    projected = np.einsum("nji,nj->ni", vectors, r) ** 2
    good = values > 1e-6
    square = np.sum(np.where(good, projected / np.where(good, values, 1.0), 0.0), axis=1)
    freedom = np.maximum(np.sum(good, axis=1) - (H.shape[1] - count), 0)
    trace = np.trace(H, axis1=1, axis2=2)
    return PoseStatistics(
        r, square / np.maximum(freedom, 1), trace / np.maximum(count, 1), count - np.where(weights > 0, trace, 0.0)
    )


def find_outliers(
    engine: Engine, solution: Solution, groups: Sequence[NDArray[np.intp]] | None = None
) -> tuple[list[int], Array, Solution, PoseStatistics]:
    """Poses to leave out, weights (n,) of all, and the solution without them with its statistics.

    The suspects are taken out and all are looked at again, so that one gross error neither makes others look bad nor
    hides them. ``groups`` : rows of the poses that are compared with one another (those of one instrument).
    """
    stack = engine.stack
    everything = np.ones(stack.n)
    all_in = solution, pose_statistics(solution, everything, stack)
    count = stack.used.sum(axis=1)
    groups = [np.arange(stack.n)] if groups is None else groups
    suspects = _suspicious_by_group(all_in[1].mean_square, count, everything, groups)
    weights, current = everything, all_in
    for _ in range(4):
        if not suspects:
            return [], everything, *all_in
        weights = np.ones(stack.n)
        weights[suspects] = 0.0
        solution = engine.solve(solution.state, weights)
        current = solution, pose_statistics(solution, weights, stack)
        now = _suspicious_by_group(current[1].mean_square, count, weights, groups)
        if now == suspects:
            break
        suspects = now
    return np.flatnonzero(weights == 0).tolist(), weights, *current


def _suspicious_by_group(
    square: Array, count: NDArray[np.int64], weights: Array, groups: Sequence[NDArray[np.intp]]
) -> list[int]:
    """Suspects of all groups; none of a group in which many are under suspicion."""
    found: list[int] = []
    for rows in groups:
        some = suspicious(square[rows], count[rows], weights[rows])
        if len(some) <= max(1, LARGEST_SHARE * len(rows)):
            found += rows[some].tolist()
    return found


def suspicious(square: Array, count: NDArray[np.int64], weights: Array) -> list[int]:
    """Poses whose studentised mean square (n,) of ``count`` numbers stands out against those of weight above zero.

    The limit is that of a chi-square distribution scaled to the median, or, where the upper half spreads wider than
    such a distribution does, that of a log-normal one of the same upper quartile.
    """
    measured = count > 0
    inside = measured & (weights > 0)
    if inside.sum() < FEWEST_POSES:
        return []
    freedom = np.maximum(count, 1)
    relative = square / (special.chdtri(freedom, 0.5) / freedom)
    typical, upper = (max(float(v), 1e-300) for v in np.quantile(relative[inside], [0.5, 0.75]))
    level = LEVEL / inside.sum()
    plain = special.chdtri(freedom, level) / special.chdtri(freedom, 0.5) * MARGIN
    quartile = special.ndtri(0.75)
    expected = np.log(special.chdtri(freedom, 0.25) / special.chdtri(freedom, 0.5)) / quartile
    wide = np.exp(np.log(upper / typical) / quartile * -special.ndtri(level))
    limit = np.where(np.log(upper / typical) / quartile > TAIL * expected, np.maximum(plain, wide), plain)
    return np.flatnonzero(measured & (relative > limit * typical)).tolist()
