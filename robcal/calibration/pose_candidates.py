"""Candidate configurations: within limits, free of collisions, and with the body in view of the cameras.

Random joint values alone seldom show a plate to two cameras. So half of the tries start from the other end: a place the
robot reaches, the body's face turned towards the cameras, and all branches of the inverse kinematics.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from robcal.calibration.collision import (
    Capsule,
    Obstacle,
    PlacedCapsules,
    link_pairs,
    obstacle_clearance,
    place_capsules,
    self_clearance,
)
from robcal.calibration.visibility import Viewpoint, VisibilityRules, measurable, seen_targets, target_normals
from robcal.errors import InvalidInput
from robcal.photogrammetry.core.bodies import Body
from robcal.robot.chain import Chain, chain_of, forward
from robcal.robot.inverse import inverse_kinematics
from robcal.robot.model import RobotModel
from robcal.transforms import Array, exp_so3, frame, invert, transform

HOPELESS = 60_000
"""Without a single admissible configuration among so many, the search ends."""

_BATCH = 4000


@dataclass(frozen=True)
class Cell:
    """What stands around the robot and what it carries.

    Attributes
    ----------
    world_T_base, flange_T_body : (4, 4) approximate cell frames, centimetres suffice.
    body, viewpoints, rules : the measuring body and the cameras that must see it; no viewpoints: no visibility check
        (a tracker with a probe, a draw-wire).
    capsules : of the robot's links and of what it carries; obstacles in base coordinates.
    clearance : m kept between them.
    """

    world_T_base: Array
    flange_T_body: Array
    body: Body | None = None
    viewpoints: tuple[Viewpoint, ...] = ()
    rules: VisibilityRules = field(default_factory=VisibilityRules)
    capsules: tuple[Capsule, ...] = ()
    obstacles: tuple[Obstacle, ...] = ()
    clearance: float = 0.02


@dataclass(frozen=True)
class Candidates:
    """Configurations that can be measured.

    Attributes
    ----------
    q : (n, N); world_T_body (n, 4, 4) nominal; seen (n, cameras, t), with no cameras (n, 0, 0).
    tried : number of configurations examined; rejected : how many failed by which check (first one that failed).
    """

    q: Array
    world_T_body: Array
    seen: NDArray[np.bool_]
    tried: int
    rejected: dict[str, int] = field(default_factory=dict)


def find_candidates(
    model: RobotModel, cell: Cell, count: int, rng: np.random.Generator, *, margin: float = 0.02, most: int = 200_000
) -> Candidates:
    """Up to ``count`` admissible configurations.

    Parameters
    ----------
    margin : share of each joint's range kept away from its limits.
    most : configurations to try before giving up.

    Raises
    ------
    InvalidInput : none of the configurations tried is admissible; the message says which check fails how often.
    """
    chain = chain_of(model)
    low, high = sampling_limits(chain, margin)
    capsules = place_capsules(model, rng.uniform(low, high, (500, chain.n_joints)), cell.capsules, cell.flange_T_body)
    pairs = link_pairs(capsules)
    kept: list[tuple[Array, Array, NDArray[np.bool_]]] = []
    rejected = {"limits or reach": 0, "collision": 0, "visibility": 0}
    tried = found = 0
    aimed = bool(cell.viewpoints) and chain.n_joints >= 6
    turn = 0
    while found < count and tried < (most if found else min(most, HOPELESS)):
        turn += 1
        if aimed and turn % 2 == 0:
            q, missed = _aimed(chain, cell, low, high, rng)
            rejected["limits or reach"] += missed
            tried += missed + len(q)
        else:
            q = rng.uniform(low, high, (_BATCH, chain.n_joints))
            tried += len(q)
        good, T, seen, placed_rejected = _admissible(model, chain, cell, q, pairs)
        for reason, number in placed_rejected.items():
            rejected[reason] += number
        kept.append((q[good], T, seen))
        found += len(T)
    if not found:
        most_common = max(rejected, key=lambda key: rejected[key])
        raise InvalidInput(
            f"none of {tried} configurations can be measured; most fail by {most_common} ({rejected}): check the "
            "cell's frames, the cameras' positions, the side of the body that carries the targets, and the link radii"
        )
    q, T, seen = (np.concatenate([part[k] for part in kept])[:count] for k in range(3))
    return Candidates(q, T, seen, tried, rejected)


def check_poses(model: RobotModel, cell: Cell, q: Array) -> NDArray[np.bool_]:
    """Which of the given configurations (n, N) are free of collisions and measurable."""
    chain = chain_of(model)
    rng = np.random.default_rng(0)
    low, high = sampling_limits(chain, 0.0)
    sample = place_capsules(model, rng.uniform(low, high, (500, chain.n_joints)), cell.capsules, cell.flange_T_body)
    good, *_ = _admissible(model, chain, cell, np.asarray(q, dtype=float), link_pairs(sample))
    inside = np.all((q >= chain.lower) & (q <= chain.upper), axis=1)
    return good & inside


def sampling_limits(chain: Chain, margin: float) -> tuple[Array, Array]:
    """Limits for sampling: a margin off the joint limits, at most one turn either way, one metre where unknown."""
    half = np.where(chain.prismatic, 1.0, np.pi)
    low = np.where(np.isfinite(chain.lower), chain.lower, -half)
    high = np.where(np.isfinite(chain.upper), chain.upper, half)
    gap = margin * (high - low)
    low, high = low + gap, high - gap
    rotary = ~chain.prismatic
    # more than a turn tells nothing new and costs time; cables wind up
    low, high = np.where(rotary, np.maximum(low, -np.pi), low), np.where(rotary, np.minimum(high, np.pi), high)
    if np.any(low > high):
        raise InvalidInput("the joint limits and their margin leave no room for poses")
    return low, high


def _admissible(
    model: RobotModel, chain: Chain, cell: Cell, q: Array, pairs: Sequence[tuple[int, int]]
) -> tuple[NDArray[np.bool_], Array, NDArray[np.bool_], dict[str, int]]:
    """Mask of the good ones, and frames and seen targets of those."""
    placed = place_capsules(model, q, cell.capsules, cell.flange_T_body)
    free = np.minimum(obstacle_clearance(placed, cell.obstacles), self_clearance(placed, pairs)) > cell.clearance
    rows = np.flatnonzero(free)
    T = cell.world_T_base @ forward(chain, q[rows]) @ cell.flange_T_body if len(rows) else np.empty((0, 4, 4))
    rejected = {"collision": int(len(q) - len(rows))}
    if not cell.viewpoints or cell.body is None:
        return free, T, np.zeros((len(rows), 0, 0), bool), rejected
    # the plain view first: most candidates fail there, and occlusion costs more
    seen = seen_targets(T, cell.body, cell.viewpoints, cell.rules)
    plain = measurable(seen, cell.rules)
    rows, T, seen = rows[plain], T[plain], seen[plain]
    if len(rows) and len(placed.radius):
        here = PlacedCapsules(placed.start[rows], placed.end[rows], placed.radius, placed.link)
        seen = seen_targets(T, cell.body, cell.viewpoints, cell.rules, here, cell.world_T_base)
        clear = measurable(seen, cell.rules)
        rows, T, seen = rows[clear], T[clear], seen[clear]
    rejected["visibility"] = int(np.sum(free) - len(rows))
    good = np.zeros(len(q), bool)
    good[rows] = True
    return good, T, seen, rejected


def _aimed(chain: Chain, cell: Cell, low: Array, high: Array, rng: np.random.Generator) -> tuple[Array, int]:
    """Configurations that hold the body's face towards the cameras, and how many tries had no such configuration."""
    body = cell.body
    if body is None:
        return np.empty((0, chain.n_joints)), 0
    n = _BATCH // 8
    middle = np.mean(body.points[body.known], axis=0)
    normal = np.mean(target_normals(body, cell.rules.facing)[body.known], axis=0)
    if np.linalg.norm(normal) < 0.1:
        normal = np.array(cell.rules.facing)  # a closed body (a sphere) shows every side
    normal = normal / np.linalg.norm(normal)
    # a place: where a random configuration holds the body
    sample = cell.world_T_base @ forward(chain, rng.uniform(low, high, (n, chain.n_joints))) @ cell.flange_T_body
    p_world = transform(sample, middle)
    eyes = np.array([v.world_T_camera[:3, 3] for v in cell.viewpoints])
    shares = rng.dirichlet(np.ones(len(eyes)), n)
    towards = shares @ eyes - p_world
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    # the body's normal towards a mixture of the cameras, tilted at random, turned at random about itself
    spin = exp_so3(rng.uniform(-np.pi, np.pi, (n, 1)) * normal)
    tilt = exp_so3(rng.normal(size=(n, 3)) * 0.4 * cell.rules.incidence)
    R = tilt @ _turn_onto(normal, towards) @ spin
    world_T_body = frame(R, p_world - np.einsum("nij,j->ni", R, middle))
    base_T_flange = invert(cell.world_T_base) @ world_T_body @ invert(cell.flange_T_body)
    near = rng.uniform(low, high, (n, chain.n_joints))
    solutions = inverse_kinematics(chain, base_T_flange, near, all_branches=False)
    inside = np.all((solutions.q >= low) & (solutions.q <= high), axis=-1)
    rows, branches = np.nonzero(inside)
    return solutions.q[rows, branches], int(n - np.sum(np.any(inside, axis=1)))


def _turn_onto(a: Array, b: Array) -> Array:
    """Rotations (n, 3, 3) that turn the direction a (3,) onto directions b (n, 3) the short way."""
    axis = np.cross(a, b)
    sine, cosine = np.linalg.norm(axis, axis=1), b @ a
    fallback = np.cross(a, np.eye(3)[np.argmin(np.abs(a))])
    fallback = fallback / np.linalg.norm(fallback)
    unit = np.where((sine > 1e-9)[:, None], axis / np.maximum(sine, 1e-12)[:, None], fallback)
    return exp_so3(unit * np.arctan2(sine, cosine)[:, None])
