"""Which of many candidate poses to measure: equidistant in joint space, or by what they tell about the robot.

The information of a pose on the parameters is ``J' W J`` with J the twist of the tool per parameter and W the
information of the measured frame. Parameters have a prior of the size that is plausible for them, so that a design is
comparable before everything is determined (Bayesian D-optimality: Chaloner and Verdinelli 1995). Greedy addition and
exchange (Fedorov 1972) after that.

Order of measuring poses with short travel, and approach directions that are balanced over joints.

Travel is the time of a synchronous joint movement, up to a factor: the largest joint change as a share of its range.
"""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from robcal.robot.chain import Chain
from robcal.transforms import Array

Progress = Callable[[int, float], bool]
"""Called with the number of poses and the predicted error; False ends the addition."""


@dataclass(frozen=True)
class Design:
    """A problem of choice.

    Attributes
    ----------
    rows : (n, 6, p) whitened twist of the tool per parameter at each candidate (``W^(1/2) J``), scaled by the priors.
    checks : (m, 3, p) displacement of the tool's test points per (scaled) parameter where accuracy is wanted, m.
    """

    rows: Array
    checks: Array = field(repr=False)

    @property
    def n_parameters(self) -> int:
        """Number of parameters."""
        return int(self.rows.shape[2])


def spread(q: Array, ranges: Array, count: int, start: int = 0) -> NDArray[np.int_]:
    """Equidistant in joint space: each next candidate is the one farthest from all chosen (Gonzalez 1985).

    ``ranges`` (N,) weighs the joints.
    """
    scaled = q / ranges
    chosen = [start]
    distance = np.linalg.norm(scaled - scaled[start], axis=1)
    while len(chosen) < min(count, len(q)):
        following = int(np.argmax(distance))
        if distance[following] <= 0:
            break
        chosen.append(following)
        distance = np.minimum(distance, np.linalg.norm(scaled - scaled[following], axis=1))
    return np.array(chosen)


def covariance_of(design: Design, chosen: NDArray[np.int_] | list[int]) -> Array:
    """Covariance (p, p) of the scaled parameters after measuring the chosen candidates; the prior alone for none."""
    rows = design.rows[np.asarray(chosen, dtype=int)].reshape(-1, design.n_parameters)
    return np.linalg.inv(np.eye(design.n_parameters) + rows.T @ rows)


def predicted_errors(design: Design, covariance: Array) -> Array:
    """Predicted standard deviation (m,) of each test point's distance error: root of the trace of its covariance."""
    return np.sqrt(np.einsum("mip,pq,miq->m", design.checks, covariance, design.checks))


def choose_d_optimal(
    design: Design, count: int, *, progress: Progress | None = None, repeats: bool = False
) -> list[int]:
    """Greedy D-optimal choice: each next pose shrinks the parameters' volume most."""

    def score(covariance: Array) -> Array:
        return _volume_gain(design.rows, covariance)

    return _greedy(design, count, score, progress, repeats)


def choose_worst_case(
    design: Design, count: int, *, progress: Progress | None = None, repeats: bool = False
) -> list[int]:
    """Greedy choice by the tool: each next pose reduces the sum of the worst tenth of predicted variances most."""

    def score(covariance: Array) -> Array:
        errors = predicted_errors(design, covariance)
        worst = np.argsort(errors)[-max(1, len(errors) // 10) :]
        checks = design.checks[worst].reshape(-1, design.n_parameters)
        spread_rows = design.rows @ covariance  # (n, 6, p)
        inner = np.linalg.inv(spread_rows @ np.swapaxes(design.rows, 1, 2) + np.eye(6))
        cross = spread_rows @ checks.T  # (n, 6, checks)
        return np.einsum("nic,nij,njc->n", cross, inner, cross)

    return _greedy(design, count, score, progress, repeats)


def exchange(design: Design, chosen: list[int], *, passes: int = 2) -> list[int]:
    """Exchange poses for better ones by D-optimality while that gains; the number stays."""
    current = list(chosen)
    if len(current) < 2:
        return current
    for _ in range(passes):
        improved = False
        for place in range(len(current)):
            without = current[:place] + current[place + 1 :]
            covariance = covariance_of(design, without)
            gain = _volume_gain(design.rows, covariance)
            own = gain[current[place]]
            gain[without] = -np.inf
            best = int(np.argmax(gain))
            if gain[best] > own + 1e-9:
                current[place] = best
                improved = True
        if not improved:
            break
    return current


def _volume_gain(rows: Array, covariance: Array) -> Array:
    """Growth (n,) of the log determinant of the information by each candidate."""
    return np.asarray(np.linalg.slogdet(np.eye(6) + rows @ covariance @ np.swapaxes(rows, 1, 2))[1])


def _greedy(
    design: Design, count: int, score: Callable[[Array], Array], progress: Progress | None, repeats: bool
) -> list[int]:
    covariance = np.eye(design.n_parameters)
    chosen: list[int] = []
    for _ in range(min(count, len(design.rows)) if not repeats else count):
        values = score(covariance)
        if not repeats:
            values[chosen] = -np.inf
        best = int(np.argmax(values))
        chosen.append(best)
        # Woodbury: six rows more
        row = design.rows[best]
        half = covariance @ row.T
        covariance = covariance - half @ np.linalg.solve(np.eye(6) + row @ half, half.T)
        covariance = 0.5 * (covariance + covariance.T)
        if progress is not None and not progress(len(chosen), float(np.max(predicted_errors(design, covariance)))):
            break
    return chosen


APPROACH_STEP = (np.deg2rad(1.5), 5e-3)
"""rad and m; how far before a pose its approach begins where the travel itself does not come from that side."""

_PASSES = 30


@dataclass(frozen=True)
class Approaches:
    """How each joint comes to rest at each pose.

    Attributes
    ----------
    direction : (n, N) +1 or -1, the direction in which the joint last moved; 0 if it did not move at all.
    via : (n, N) configuration to drive through right before the pose, so that the directions come about.
    """

    direction: NDArray[np.int_]
    via: Array


def joint_ranges(chain: Chain, q: Array) -> Array:
    """Range of each joint (N,) for weighing: its limits, or the spread of q where unknown."""
    limits = chain.upper - chain.lower
    spread = np.max(q, axis=0) - np.min(q, axis=0)
    return np.maximum(np.where(np.isfinite(limits), limits, spread), 1e-6)


def travel(q: Array, ranges: Array) -> Array:
    """Travel (n, n) between configurations."""
    scaled = q / ranges
    return np.max(np.abs(scaled[:, None] - scaled[None]), axis=-1)


def short_order(q: Array, ranges: Array, start: Array | None = None, penalty: Array | None = None) -> NDArray[np.int_]:
    """Order (n,) of configurations with short travel: nearest neighbour from ``start``, then 2-opt exchanges.

    ``penalty`` (n, n) is added to the travel between two configurations, such as for a move that collides.
    The path is open. Weakness: a local optimum.
    """
    n = len(q)
    if n < 3:
        return np.arange(n)
    D = travel(q, ranges) + (0.0 if penalty is None else penalty)
    first = int(np.argmin(np.max(np.abs((q - start) / ranges), axis=1))) if start is not None else 0
    order = [first]
    left = set(range(n)) - {first}
    while left:
        here = order[-1]
        following = min(left, key=lambda k: (D[here, k], k))
        order.append(following)
        left.remove(following)
    path = np.array(order)
    for _ in range(_PASSES):
        improved = False
        for i in range(n - 2):
            # reverse path[i+1..j]: edges (i, i+1), (j, j+1) become (i, j), (i+1, j+1); the last one has no edge behind
            j = np.arange(i + 2, n)
            behind = np.where(j + 1 < n, D[path[j], path[np.minimum(j + 1, n - 1)]], 0.0)
            crossing = np.where(j + 1 < n, D[path[i + 1], path[np.minimum(j + 1, n - 1)]], 0.0)
            gain = D[path[i], path[i + 1]] + behind - D[path[i], path[j]] - crossing
            best = int(np.argmax(gain))
            if gain[best] > 1e-12:
                path[i + 1 : j[best] + 1] = path[i + 1 : j[best] + 1][::-1].copy()
                improved = True
        if not improved:
            break
    return path


def path_length(q: Array, ranges: Array) -> float:
    """Travel along the given order."""
    return float(np.sum(np.max(np.abs(np.diff(q, axis=0) / ranges), axis=1))) if len(q) > 1 else 0.0


def balanced_approaches(chain: Chain, q: Array, rng: np.random.Generator) -> Approaches:
    """Approach directions for poses in the order of driving: as often from either side, for every joint.

    A joint comes from where the travel brings it; where one side prevails, the poses with the shortest moves are
    led to the other side by a short step (``via``), if the limits allow it. A joint at rest gets a side as well.
    """
    count = q.shape[1]
    step = np.where(chain.prismatic, APPROACH_STEP[1], APPROACH_STEP[0])
    moves = np.vstack([np.zeros((1, count)), np.diff(q, axis=0)])
    natural = np.where(np.abs(moves) > 1e-6, np.sign(moves), 0).astype(int)
    direction = natural.copy()
    # from +1 the joint comes from below: that place must be within the limits
    from_below, from_above = q - step >= chain.lower, q + step <= chain.upper
    for k in range(count):
        allowed = {1: from_below[:, k], -1: from_above[:, k]}
        still = np.flatnonzero(direction[:, k] == 0)
        for i in rng.permutation(still):
            side = -1 if np.sum(direction[:, k]) > 0 else 1
            side = side if allowed[side][i] else -side
            direction[i, k] = side if allowed[side][i] else 0
        surplus = int(np.sum(direction[:, k]))
        side = int(np.sign(surplus))
        by_length = np.argsort(np.abs(moves[:, k]), kind="stable")
        candidates = [i for i in by_length if direction[i, k] == side and allowed.get(-side, from_below[:, k])[i]]
        for i in candidates[: abs(surplus) // 2]:
            direction[i, k] = -side
    via = np.where(direction != natural, q - direction * step, q)
    return Approaches(direction, via)
