"""Collisions of a robot's links, as capsules, with simple bodies and with one another.

A capsule (all points within a radius of a segment) holds a link tightly enough to plan measuring poses, and its
distance to other capsules, balls, boxes and the floor is cheap. Source of the segment distance: Ericson, *Real-Time
Collision Detection* (2005), section 5.1.9.

Weakness: default capsules are guessed from the nominal geometry; where clearance matters, give the true ones.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from robcal.errors import InvalidInput
from robcal.robot.chain import Chain, chain_of, frame_positions
from robcal.robot.model import RobotModel
from robcal.transforms import Array, invert, transform

DEFAULT_RADIUS_RATIO = 0.06
"""Radius of a guessed link capsule as a share of the robot's reach."""

_ALWAYS_TOUCHING = 0.95
_SAMPLES = 9


@dataclass(frozen=True)
class Capsule:
    """All points within ``radius`` of the segment from ``start`` to ``end``, fixed in a frame of the chain.

    ``frame`` is the name of a frame of the model, 'base' for what stands still, or 'body' for what the flange carries
    (coordinates of the measuring body). Metres.
    """

    frame: str
    start: tuple[float, float, float]
    end: tuple[float, float, float]
    radius: float


@dataclass(frozen=True)
class Ball:
    """A ball in base coordinates."""

    centre: tuple[float, float, float]
    radius: float


@dataclass(frozen=True)
class Box:
    """A box: edge lengths ``size`` about the origin of ``base_T_box``."""

    base_T_box: Array
    size: tuple[float, float, float]


@dataclass(frozen=True)
class HalfSpace:
    """Everything with ``normal . p < offset`` in base coordinates is solid (a floor: normal (0, 0, 1), offset 0)."""

    normal: tuple[float, float, float]
    offset: float


Obstacle = Capsule | Ball | Box | HalfSpace


@dataclass(frozen=True)
class PlacedCapsules:
    """Capsules of n configurations in base coordinates: start, end (n, c, 3), radius (c,), link number (c,)."""

    start: Array
    end: Array
    radius: Array
    link: NDArray[np.int_]


def link_capsules(model: RobotModel, radius: float | None = None) -> tuple[Capsule, ...]:
    """Guessed capsules: one from each frame's origin to the next that is farther than its own radius.

    The column under the first joint stands still in the base; the last capsule ends a radius before the flange, where
    the measuring body begins.
    """
    lengths = [float(np.linalg.norm(f.xyz)) for f in model.frames]
    r = DEFAULT_RADIUS_RATIO * sum(lengths) if radius is None else float(radius)
    if not np.isfinite(r) or r <= 0:
        raise InvalidInput("link capsules need a positive, finite radius in m")
    out = []
    previous = "base"
    for number, f in enumerate(model.frames):
        if lengths[number] > r:
            end = np.array(f.xyz)
            if number == len(model.frames) - 1:
                end = end * max(0.0, 1.0 - r / lengths[number])
            out.append(Capsule(previous, (0.0, 0.0, 0.0), (float(end[0]), float(end[1]), float(end[2])), r))
        previous = f.name
    return tuple(out)


def place_capsules(
    model: RobotModel, q: Array, capsules: Sequence[Capsule], flange_T_body: Array | None = None
) -> PlacedCapsules:
    """Where the capsules of a robot are at joint values (n, N).

    Raises
    ------
    InvalidInput : a capsule names an unknown frame, or has no positive radius.
    """
    chain = chain_of(model)
    frames = frame_positions(chain, q)
    n = len(frames)
    names = {f.name: k for k, f in enumerate(model.frames)}
    starts, ends, radii, links = [], [], [], []
    for c in capsules:
        if not (np.isfinite(c.radius) and c.radius > 0):
            raise InvalidInput(f"the capsule on '{c.frame}' needs a positive, finite radius")
        T, link = _frame_of(c.frame, frames, names, chain, flange_T_body)
        starts.append(transform(T, np.array(c.start)))
        ends.append(transform(T, np.array(c.end)))
        radii.append(c.radius)
        links.append(link)
    shape = (n, len(capsules), 3)
    if not capsules:
        return PlacedCapsules(np.empty(shape), np.empty(shape), np.empty(0), np.empty(0, int))
    stacked = [np.stack([np.broadcast_to(p, (n, 3)) for p in points], axis=1) for points in (starts, ends)]
    return PlacedCapsules(stacked[0], stacked[1], np.array(radii), np.array(links))


def _frame_of(
    name: str, frames: Array, names: dict[str, int], chain: Chain, flange_T_body: Array | None
) -> tuple[Array, int]:
    if name == "base":
        return np.eye(4), -1
    if name == "body":
        T = frames[:, -1] if flange_T_body is None else frames[:, -1] @ flange_T_body
        return T, len(chain.axes)
    if name not in names:
        raise InvalidInput(f"a capsule is fixed to '{name}', but the robot's frames are {', '.join(names)}, base, body")
    return frames[:, names[name]], int(chain.moved_by[names[name]])


def segment_distance(p0: Array, p1: Array, q0: Array, q1: Array) -> Array:
    """Distances between segments p0-p1 and q0-q1, broadcast over leading axes."""
    u, v, w = p1 - p0, q1 - q0, p0 - q0
    a, b, c = np.sum(u * u, -1), np.sum(u * v, -1), np.sum(v * v, -1)
    d, e = np.sum(u * w, -1), np.sum(v * w, -1)
    tiny = 1e-18
    det = a * c - b * b
    s = np.where(det > tiny, np.clip((b * e - c * d) / np.where(det > tiny, det, 1.0), 0.0, 1.0), 0.0)
    t = np.where(c > tiny, (b * s + e) / np.where(c > tiny, c, 1.0), 0.0)
    clipped = np.clip(t, 0.0, 1.0)
    s = np.where(a > tiny, np.clip((b * clipped - d) / np.where(a > tiny, a, 1.0), 0.0, 1.0), 0.0)
    gap = w + s[..., None] * u - clipped[..., None] * v
    return np.sqrt(np.sum(gap * gap, axis=-1))


def obstacle_clearance(placed: PlacedCapsules, obstacles: Sequence[Obstacle]) -> Array:
    """Smallest clearance (n,) of moving capsules to the obstacles; negative inside, infinite without obstacles.

    Weakness: boxes are measured at nine points along each capsule.
    """
    n = len(placed.start)
    best = np.full(n, np.inf)
    moving = placed.link >= 0
    if not np.any(moving):
        return best
    start, end, radius = placed.start[:, moving], placed.end[:, moving], placed.radius[moving]
    for o in obstacles:
        if isinstance(o, HalfSpace):
            normal = np.array(o.normal, dtype=float)
            normal = normal / np.linalg.norm(normal)
            gap = np.minimum(start @ normal, end @ normal) - o.offset
        elif isinstance(o, Ball):
            centre = np.broadcast_to(np.array(o.centre, dtype=float), start.shape)
            gap = segment_distance(start, end, centre, centre) - o.radius
        elif isinstance(o, Capsule):
            ends = [np.broadcast_to(np.array(p, dtype=float), start.shape) for p in (o.start, o.end)]
            gap = segment_distance(start, end, ends[0], ends[1]) - o.radius
        else:
            gap = _box_distance(start, end, o)
        best = np.minimum(best, np.min(gap - radius, axis=1))
    return best


def _box_distance(start: Array, end: Array, box: Box) -> Array:
    at = np.linspace(0.0, 1.0, _SAMPLES)[:, None]
    points = start[..., None, :] + at * (end - start)[..., None, :]
    outside = np.abs(transform(invert(box.base_T_box), points)) - 0.5 * np.array(box.size)
    distance = np.linalg.norm(np.maximum(outside, 0.0), axis=-1) + np.minimum(np.max(outside, axis=-1), 0.0)
    return np.min(distance, axis=-1)


def link_pairs(placed: PlacedCapsules) -> list[tuple[int, int]]:
    """Pairs of capsules that can meaningfully collide, judged on many configurations.

    Neighbours along the chain overlap by construction, and so may others with generous radii: pairs that touch in
    nearly all configurations are left out (as in MoveIt's collision matrix).
    """
    pairs = []
    for i in range(len(placed.radius)):
        for j in range(i + 1, len(placed.radius)):
            if abs(int(placed.link[i]) - int(placed.link[j])) <= 1 or j == i + 1:
                continue
            touching = _pair_gap(placed, i, j) < 0
            if len(touching) == 0 or np.mean(touching) < _ALWAYS_TOUCHING:
                pairs.append((i, j))
    return pairs


def self_clearance(placed: PlacedCapsules, pairs: Sequence[tuple[int, int]]) -> Array:
    """Smallest clearance (n,) between the given pairs of capsules."""
    best = np.full(len(placed.start), np.inf)
    for i, j in pairs:
        best = np.minimum(best, _pair_gap(placed, i, j))
    return best


def _pair_gap(placed: PlacedCapsules, i: int, j: int) -> Array:
    distance = segment_distance(placed.start[:, i], placed.end[:, i], placed.start[:, j], placed.end[:, j])
    return distance - placed.radius[i] - placed.radius[j]
