"""Poses of a sensor in the hand that looks squarely at the targets of a sphere at rest.

The sensor stands at a fixed distance over a target, its z axis along the inner normal, so that every target is measured
under the same angles; the turn about that axis is free. Turns and branches of the inverse kinematics are chosen so that
the poses cover joint space, all targets about equally often.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from robcal.calibration.collision import (
    Ball,
    Capsule,
    Obstacle,
    PlacedCapsules,
    link_pairs,
    obstacle_clearance,
    place_capsules,
    segment_distance,
    self_clearance,
)
from robcal.calibration.pose_candidates import sampling_limits
from robcal.calibration.pose_choice import joint_ranges, path_length, short_order
from robcal.errors import InvalidInput
from robcal.photogrammetry.core.bodies import Body, fit_sphere
from robcal.robot.chain import Chain, chain_of, forward
from robcal.robot.compensation import compensate
from robcal.robot.inverse import inverse_kinematics
from robcal.robot.model import RobotModel
from robcal.transforms import Array, frame, invert

TURNS = 36
"""Turns about the line of sight that are tried for each target."""
UPRIGHT = 0.1
"""Length of a normal across x below which the axis of the turn's zero is taken from y instead."""
BLOCKED = 1e3
"""Travel that a move through an obstacle counts as."""
_STEPS = 8
_CONE = 6

Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]


@dataclass(frozen=True)
class SensorRequest:
    """What is wanted of the sensor.

    Attributes
    ----------
    model : the robot; where it has parameters, the poses are those of the real robot, else of the nominal one.
    body : the sphere with its targets; base_T_body, flange_T_sensor (4, 4) as well as they are known.
    distance : m from the sensor's origin to the target. cone : rad, half the opening of the sensor's view, which must
        be free of links and obstacles.
    count, verify : poses to identify with, and further ones to verify with.
    capsules, obstacles, clearance : as in :class:`robcal.calibration.pose_candidates.Cell`; the sphere is added.
    margin : share of the joint ranges to keep off the limits. start : (N,) configuration from which the robot sets out.
    """

    model: RobotModel
    body: Body
    base_T_body: Array
    flange_T_sensor: Array
    distance: float
    cone: float = 0.0
    count: int = 80
    verify: int = 0
    payload: str | None = None
    capsules: tuple[Capsule, ...] = ()
    obstacles: tuple[Obstacle, ...] = ()
    clearance: float = 0.02
    margin: float = 0.02
    start: Array | None = None


@dataclass(frozen=True)
class SensorPlan:
    """Poses in the order of driving.

    Attributes
    ----------
    q : (n, N) rad or m; target : (n,) ids; turn : (n,) rad about the line of sight; verify : (n,).
    unreachable : why no pose looks at a target, by id.
    blocked : rows whose straight move in joint space from the pose before collides.
    travel : sum of the moves as shares of the joint ranges.
    """

    q: Array
    target: Ints
    turn: Array
    verify: Bools
    unreachable: Mapping[int, str]
    blocked: tuple[int, ...]
    travel: float


@dataclass(frozen=True)
class _Candidates:
    """Configurations that can be measured: q (c, N), row of the target, turn, and the sensor's frame in the body."""

    q: Array
    target: Ints
    turn: Array
    body_T_sensor: Array = field(repr=False)


def square_frames(points: Array, normals: Array, distance: float, turns: Array) -> Array:
    """Frames (t, k, 4, 4) of the sensor in the body: over points (t, 3) along unit normals (t, 3), turned by (k,)."""
    n1, n2, n3 = normals.T
    zero = np.zeros_like(n1)
    across = np.hypot(n2, n3)
    x = np.where((across > UPRIGHT)[:, None], np.stack([zero, -n3, n2], 1), np.stack([n3, zero, -n1], 1))
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    R = np.stack([x, np.cross(-normals, x), -normals], axis=-1)
    c, s, nil, one = np.cos(turns), np.sin(turns), np.zeros_like(turns), np.ones_like(turns)
    spin = np.stack([c, -s, nil, s, c, nil, nil, nil, one], axis=-1).reshape(-1, 3, 3)
    places = (points + distance * normals)[:, None]
    return frame(R[:, None] @ spin, np.broadcast_to(places, (len(points), len(turns), 3)))


def sensor_poses(request: SensorRequest) -> SensorPlan:
    """Poses that look squarely at the targets of a sphere.

    Raises
    ------
    InvalidInput : targets that are on no sphere, or no target can be looked at.
    """
    if request.count < 1 or request.verify < 0 or request.distance <= 0 or not 0 <= request.cone < np.pi / 3:
        raise InvalidInput("poses of a sensor need a count and a distance above zero and a cone below 60 degrees")
    chain = chain_of(request.model)
    known = np.flatnonzero(request.body.known)
    points = request.body.points[known]
    centre, radius = fit_sphere(points, request.body.name)
    normals = (points - centre) / np.linalg.norm(points - centre, axis=1, keepdims=True)
    cell = _Surroundings(request, centre, radius, chain)
    found, reasons = _candidates(request, chain, cell, points, normals)
    unreachable = {int(request.body.ids[known[k]]): reason for k, reason in reasons.items()}
    if not len(found.q):
        raise InvalidInput(
            f"no target of body '{request.body.name}' can be looked at (target {next(iter(unreachable.items()))[0]}: "
            f"{next(iter(unreachable.values()))}): check base_T_body, flange_T_sensor, the distance and the link radii"
        )
    ranges = joint_ranges(chain, found.q)
    chosen = _spread_over_targets(found, ranges, request.count + request.verify)
    verify = np.zeros(len(found.q), dtype=bool)
    verify[_verifying(len(chosen), request.verify, chosen)] = True
    q, rows = _as_the_real_robot(request, found, chosen)
    blocked = cell.blocked_moves(q)
    order = short_order(q, ranges, request.start, np.where(blocked, BLOCKED, 0.0))
    rows, q, at = rows[order], q[order], np.flatnonzero(blocked[order[:-1], order[1:]]) + 1
    return SensorPlan(
        q,
        request.body.ids[known[found.target[rows]]],
        found.turn[rows],
        verify[rows],
        unreachable,
        tuple(at.tolist()),
        path_length(q, ranges),
    )


class _Surroundings:
    """Collisions and the sensor's free view at configurations of one request."""

    def __init__(self, request: SensorRequest, centre: Array, radius: float, chain: Chain) -> None:
        self.request, self.chain = request, chain
        at = request.base_T_body[:3, :3] @ centre + request.base_T_body[:3, 3]
        self.obstacles = (*request.obstacles, Ball((float(at[0]), float(at[1]), float(at[2])), radius))
        low, high = sampling_limits(chain, request.margin)
        some = np.random.default_rng(0).uniform(low, high, (500, chain.n_joints))
        self.pairs = link_pairs(self._placed(some))

    def _placed(self, q: Array) -> PlacedCapsules:
        return place_capsules(self.request.model, q, self.request.capsules, self.request.flange_T_sensor)

    def free(self, q: Array) -> Bools:
        """Which configurations (n, N) keep the clearance."""
        placed = self._placed(q)
        gap = np.minimum(obstacle_clearance(placed, self.obstacles), self_clearance(placed, self.pairs))
        return np.asarray(gap > self.request.clearance)

    def in_view(self, q: Array) -> Bools:
        """Where no link and no obstacle stands in the sensor's cone; what moves with the flange is left out."""
        base_T_sensor = forward(self.chain, q) @ self.request.flange_T_sensor
        depth = np.linspace(0.0, self.request.distance, _CONE)
        on_axis = base_T_sensor[:, None, :3, 3] + depth[:, None] * base_T_sensor[:, None, :3, 2]
        radii = depth * np.tan(self.request.cone)
        cone = PlacedCapsules(on_axis, on_axis, radii, np.full(_CONE, len(self.chain.axes)))
        clear = obstacle_clearance(cone, self.request.obstacles) > 0
        placed = self._placed(q)
        for k in np.flatnonzero(placed.link < len(self.chain.axes) - 1):
            start, end = placed.start[:, k, None], placed.end[:, k, None]
            gap = segment_distance(on_axis, on_axis, start, end) - placed.radius[k] - radii
            clear &= np.all(gap > 0, axis=1)
        return np.asarray(clear)

    def blocked_moves(self, q: Array) -> Bools:
        """(n, n) true where the straight move in joint space between two configurations collides."""
        n = len(q)
        i, j = np.triu_indices(n, 1)
        out = np.zeros((n, n), dtype=bool)
        if not len(i):
            return out
        shares = np.linspace(0.0, 1.0, _STEPS + 2)[1:-1, None, None]
        between = q[i] + shares * (q[j] - q[i])
        free = self.free(between.reshape(-1, q.shape[1])).reshape(_STEPS, -1)
        out[i, j] = out[j, i] = ~np.all(free, axis=0)
        return out


def _candidates(
    request: SensorRequest, chain: Chain, cell: _Surroundings, points: Array, normals: Array
) -> tuple[_Candidates, dict[int, str]]:
    """Configurations for all targets and turns, and why some targets have none."""
    turns = np.arange(TURNS) * 2.0 * np.pi / TURNS - np.pi
    frames = square_frames(points, normals, request.distance, turns)
    flange = request.base_T_body @ frames @ invert(request.flange_T_sensor)
    solutions = inverse_kinematics(chain, flange.reshape(-1, 4, 4))
    low, high = sampling_limits(chain, request.margin)
    with np.errstate(invalid="ignore"):
        inside = np.all((solutions.q >= low) & (solutions.q <= high), axis=-1)
    row, branch = np.nonzero(inside)
    q = solutions.q[row, branch]
    stages = {"out of reach or beyond a joint limit": np.ones(len(q), dtype=bool)}
    stages["the robot would collide"] = cell.free(q) if len(q) else np.zeros(0, dtype=bool)
    stages["a link or obstacle stands in the sensor's cone"] = cell.in_view(q) if len(q) else np.zeros(0, dtype=bool)
    left, of = np.ones(len(q), dtype=bool), row // TURNS
    reasons: dict[int, str] = {}
    for reason, passed in stages.items():
        left = left & passed
        for k in np.setdiff1d(np.arange(len(points)), of[left]):
            reasons.setdefault(int(k), reason)
    kept = row[left]
    return _Candidates(q[left], of[left], turns[kept % TURNS], frames.reshape(-1, 4, 4)[kept]), reasons


def _spread_over_targets(found: _Candidates, ranges: Array, count: int) -> Ints:
    """Candidates far from each other in joint space, all targets about equally often (after Gonzalez 1985)."""
    scaled = found.q / ranges
    chosen = [int(np.argmin(np.linalg.norm(scaled - np.median(scaled, axis=0), axis=1)))]
    distance = np.linalg.norm(scaled - scaled[chosen[0]], axis=1)
    uses = np.zeros(int(found.target.max()) + 1, dtype=int)
    uses[found.target[chosen[0]]] = 1
    while len(chosen) < min(count, len(found.q)):
        distance[chosen] = -1.0
        left = distance >= 0
        rarest = left & (uses[found.target] == uses[found.target[left]].min())
        following = int(np.argmax(np.where(rarest, distance, -1.0)))
        chosen.append(following)
        uses[found.target[following]] += 1
        distance = np.minimum(distance, np.linalg.norm(scaled - scaled[following], axis=1))
    return np.array(chosen, dtype=np.int64)


def _verifying(number: int, verify: int, chosen: Ints) -> Ints:
    """Every so many of the chosen, so that they are spread as the others are."""
    at = np.linspace(0, number - 1, min(verify, number) + 2)[1:-1].round().astype(int)
    return chosen[np.unique(at)] if verify else chosen[:0]


def _as_the_real_robot(request: SensorRequest, found: _Candidates, chosen: Ints) -> tuple[Array, Ints]:
    """Joint values with which the calibrated robot stands square, and the candidates that can be held so."""
    q = found.q[chosen]
    model = request.model
    if not model.parameters and not model.terms:
        return q, chosen
    placed = RobotModel(
        model.name,
        model.frames,
        model.gravity,
        model.gravity_frame,
        model.parameters,
        model.terms,
        model.payloads,
        invert(request.base_T_body),
        request.flange_T_sensor,
    )
    done = compensate(placed, found.body_T_sensor[chosen], payload=request.payload, near=q)
    return done.q[done.reachable], chosen[done.reachable]
