"""Order of measuring poses with short travel, and approach directions that are balanced over joints.

Travel is the time of a synchronous joint movement, up to a factor: the largest joint change as a share of its range.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from robcal.robot.chain import Chain
from robcal.transforms import Array

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


def short_order(q: Array, ranges: Array, start: Array | None = None) -> NDArray[np.int_]:
    """Order (n,) of configurations with short travel: nearest neighbour from ``start``, then 2-opt exchanges.

    The path is open. Weakness: a local optimum; collisions on the way between poses are not checked.
    """
    n = len(q)
    if n < 3:
        return np.arange(n)
    D = travel(q, ranges)
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
