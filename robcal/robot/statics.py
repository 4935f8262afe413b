"""Static moments of the weights along a chain, and their exact derivatives, as CasADi graphs.

The moment about a line through ``o`` with direction ``z`` of all weights behind it is ``m = z . ((P - M o) x g)`` with
``M`` the sum of masses behind and ``P`` their first moment: the static part of the recursion
of Luh, Walker and Paul (1980) with the weights summed first. Everything is written in base coordinates, so only one
gravity vector is needed.

The moment is the negative derivative of the potential energy by the angle, so its derivatives by the coordinates form a
symmetric matrix: with ``F_b`` the derivative of the first moment by coordinate b, and b not before a in the chain,
``dm_a / db = F_b . (g x z_a)`` for every rotation a, and ``dm_b / da`` the same. That structure lets a weighted sum
over all moments be differentiated in one sweep (:func:`moment_sweep`).
"""

from dataclasses import dataclass
from functools import lru_cache

import casadi as ca

from robcal.robot.model import RobotModel
from robcal.robot.terms import identifier

CROSS = ca.cross
_AXES = {"x": 0, "y": 1, "z": 2}


@dataclass(frozen=True)
class LocalFrame:
    """Graphs of one frame's own numbers: translation (3,), rotation (3, 3) and the line of pitch in the parent."""

    t: ca.SX
    R: ca.SX
    pitch_line: ca.SX


def local_frame(six: ca.SX) -> LocalFrame:
    """Frame of a pose x, y, z, roll, pitch, yaw: ``R = Rz(yaw) Ry(pitch) Rx(roll)``."""
    R, line = _rotation()(six[3:])
    return LocalFrame(six[:3], R, line)


@lru_cache(maxsize=1)
def _rotation() -> ca.Function:
    """Rotation and pitch line of (roll, pitch, yaw); a function once built is inlined faster than written again."""
    rpy = ca.SX.sym("rpy", 3)
    (cr, cp, cy), (sr, sp, sy) = ([f(rpy[k]) for k in range(3)] for f in (ca.cos, ca.sin))
    R = ca.vertcat(
        ca.horzcat(cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr),
        ca.horzcat(sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr),
        ca.horzcat(-sp, cp * sr, cp * cr),
    )
    return ca.Function("rotation", [rpy], [R, ca.vertcat(-sy, cy, 0)])


@dataclass(frozen=True)
class StaticChain:
    """The loaded chain in base coordinates.

    Attributes
    ----------
    origins : origin of each frame.
    parents : rotation of each frame's parent (so its columns are the directions of x, y, z).
    rotations : rotation of each frame.
    lines : directions of the lines of roll, pitch, yaw of each frame.
    masses, first : mass and first moment (kg m) of everything behind each frame, itself included.
    g : gravity in base coordinates.
    """

    origins: list[ca.SX]
    parents: list[ca.SX]
    rotations: list[ca.SX]
    lines: list[tuple[ca.SX, ca.SX, ca.SX]]
    masses: list[ca.SX]
    first: list[ca.SX]
    g: ca.SX


def static_chain(
    model: RobotModel, coordinates: list[ca.SX], g: ca.SX, load_mass: ca.SX, load_moment: ca.SX
) -> StaticChain:
    """Chain for the given coordinates (one (6,) graph a frame), load given by mass and first moment in the flange."""
    R, o = ca.SX.eye(3), ca.SX.zeros(3)
    origins, parents, rotations, lines = [], [], [], []
    for six in coordinates:
        local = local_frame(six)
        parents.append(R)
        o = o + ca.mtimes(R, local.t)
        yaw, pitch = R[:, 2], ca.mtimes(R, local.pitch_line)
        R = ca.mtimes(R, local.R)
        origins.append(o)
        rotations.append(R)
        lines.append((R[:, 0], pitch, yaw))
    mass, first = load_mass, load_mass * o + ca.mtimes(R, load_moment)  # load_moment is in flange coordinates
    masses, firsts = [], []
    for f, origin, rotation in zip(reversed(model.frames), reversed(origins), reversed(rotations), strict=True):
        if f.mass:
            mass = mass + f.mass
            first = first + f.mass * (origin + ca.mtimes(rotation, ca.DM(f.cog)))
        masses.append(mass)
        firsts.append(first)
    return StaticChain(origins, parents, rotations, lines, masses[::-1], firsts[::-1], g)


def moments(model: RobotModel, chain: StaticChain) -> ca.SX:
    """Moments: base x, y, z; roll, pitch, yaw lines of every frame; forces along the sliding joints, in their order."""
    out = [CROSS(chain.first[0], chain.g)]
    for i in range(len(model.frames)):
        load = CROSS(chain.first[i] - chain.masses[i] * chain.origins[i], chain.g)
        out.extend(ca.dot(line, load) for line in chain.lines[i])
    for i, f in enumerate(model.frames):
        if f.prismatic and f.axis is not None:
            out.append(chain.masses[i] * ca.dot(chain.parents[i][:, _AXES[f.axis]], chain.g))
    return ca.vertcat(*out)


def moment_names(model: RobotModel) -> list[str]:
    """Names of the entries of :func:`moments` as expressions know them, forces of sliding joints last."""
    if model.is_hexapod:
        return []
    names = ["base_mx", "base_my", "base_mz"]
    names += [f"{identifier(f.name)}_m{k}" for f in model.frames for k in ("roll", "pitch", "yaw")]
    return names + [f"{identifier(f.name)}_force" for f in model.frames if f.prismatic and f.axis is not None]


@dataclass(frozen=True)
class MomentSweep:
    """Derivatives of ``W m`` with a weight matrix W (6, moments) held fixed.

    Attributes
    ----------
    by_coordinate : (6, 6 * frames) by x, y, z, roll, pitch, yaw of every frame.
    by_gravity : (6, 3) by the gravity vector in base coordinates.
    by_first : (6, 3) by a first moment added at the flange (base coordinates).
    by_mass : (6, 1) by a mass added at the flange's origin.
    """

    by_coordinate: ca.SX
    by_gravity: ca.SX
    by_first: ca.SX
    by_mass: ca.SX


def moment_sweep(model: RobotModel, chain: StaticChain, W: ca.SX) -> MomentSweep:
    """Differentiate a weighted sum of moments in one pass outwards and one inwards (module's text)."""
    n, g = len(model.frames), chain.g
    eye = ca.SX.eye(3)
    sliding = [i for i, f in enumerate(model.frames) if f.prismatic and f.axis is not None]
    # outwards: A = sum over the rotations met so far of W_a (g x z_a)'
    A, by_mass = ca.SX.zeros(6, 3), ca.SX.zeros(6, 1)
    V = ca.SX.zeros(6, 3)
    for k in range(3):
        w = W[:, k]
        A = A + ca.mtimes(w, CROSS(g, eye[:, k]).T)
        V = V + ca.mtimes(w, CROSS(eye[:, k], chain.first[0]).T)
    columns: list[ca.SX] = [ca.SX()] * (6 * n)
    turned: list[ca.SX] = [ca.SX()] * (3 * n)  # F_b of the rotations
    for i in range(n):
        for k in range(3):
            columns[6 * i + k] = ca.mtimes(A, chain.masses[i] * chain.parents[i][:, k])
        arm = chain.first[i] - chain.masses[i] * chain.origins[i]
        for k in (2, 1, 0):  # yaw turns outermost
            w, line = W[:, 3 + 3 * i + k], chain.lines[i][k]
            turned[3 * i + k] = CROSS(line, arm)
            across = CROSS(g, line)
            A = A + ca.mtimes(w, across.T)
            by_mass = by_mass - w * ca.dot(across, chain.origins[i])
            columns[6 * i + 3 + k] = ca.mtimes(A, turned[3 * i + k])
    by_first = A
    by_mass = by_mass + ca.mtimes(A, chain.origins[-1])
    # inwards: B = sum over what lies behind of W_a F_a'
    B = ca.SX.zeros(6, 3)
    for i in reversed(range(n)):
        for k in (0, 1, 2):
            columns[6 * i + 3 + k] = columns[6 * i + 3 + k] + ca.mtimes(B, CROSS(g, chain.lines[i][k]))
            B = B + ca.mtimes(W[:, 3 + 3 * i + k], turned[3 * i + k].T)
        if i in sliding:
            w = W[:, 3 + 3 * n + sliding.index(i)]
            along = chain.parents[i][:, _AXES[str(model.frames[i].axis)]]
            B = B + ca.mtimes(w, (chain.masses[i] * along).T)
            by_mass = by_mass + w * ca.dot(along, g)
    return MomentSweep(ca.horzcat(*columns), V + B, by_first, by_mass)
