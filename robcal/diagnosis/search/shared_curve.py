"""One curve for all joints that carry a copy of the same part: a pattern of turns and senses, refined together.

What the curves of single joints say of each other starts it; turns then follow with everything else by Gauss-Newton
steps. Joints that differ keep a curve of what they differ by, whose size the kept-out poses choose.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from robcal.diagnosis.core.fitting import Fit
from robcal.diagnosis.scan.statistics import orthonormal_basis
from robcal.diagnosis.scan.tangents import Tangents
from robcal.physics.angle_error_curve import Placed, shared_curve
from robcal.physics.cause import Array, RobotCause
from robcal.physics.site import Joint

ROUNDS = 4
TURNS, TABLE = 240, 1441
"""Turns that are tried, and points of the curve's table."""
ELSEWHERE = np.deg2rad(8.0)
"""Turns farther apart than this are different answers."""
SEATS = 4
"""Turns of a further joint that are tried on kept-out poses."""
STEP = 1e-4
"""rad, over which a curve is differentiated."""
LARGEST_TURN = 0.05
"""rad: largest step of a turn; the finest waves of a curve are a few times as long."""


def refined(
    placed: Sequence[Placed],
    make: Callable[[Sequence[Placed]], RobotCause],
    at: Tangents,
    solve: Callable[[Sequence[Array]], list[Array]],
    beside: Sequence[Array],
) -> tuple[Placed, ...]:
    """The pattern with turns that fit best, with the curve, the fitted parameters and the columns `beside`.

    Parameters
    ----------
    make : the cause of a pattern. solve : groups of columns (m, c) with a unit prior each to their amplitudes.
    """
    placed = tuple(placed)
    for _ in range(ROUNDS):
        cause = make(placed)
        sizes = cause.sizes(cause.grid[0])
        columns = at.columns(cause, cause.grid[0]) * sizes
        values = sizes * solve([columns, *beside])[0]
        slopes = np.stack([_slope(placed, k, make, at, values) for k in range(1, len(placed))], axis=1)
        steps = solve([columns, *beside, slopes * LARGEST_TURN])[-1] * LARGEST_TURN
        steps = np.clip(steps, -LARGEST_TURN, LARGEST_TURN)
        moved = [replace(p, shift=float(p.shift + d)) for p, d in zip(placed[1:], steps, strict=True)]
        placed = (placed[0], *moved)
        if float(np.max(np.abs(steps))) < STEP:
            break
    return placed


def seats(
    present: Fit,
    at: Tangents,
    cause: RobotCause,
    joint: Joint,
    common: Array,
    others: Sequence[Array],
    solve: Callable[[Fit, Sequence[Array]], list[Array]],
) -> tuple[Placed, ...]:
    """How the curve that other joints share may sit in one more joint: the turns and senses that explain most there.

    Parameters
    ----------
    cause, common : the shared curve and its scaled columns. others : scaled columns of all other curves but the
        joint's own.

    Weakness: none of them need be right; poses kept out have to choose.
    """
    columns = [common, *others]
    values = solve(present, columns)
    left = present.residual - np.sum([c @ v for c, v in zip(columns, values, strict=True)], axis=0)
    grid = np.linspace(0.0, 2.0 * np.pi, TABLE)
    own = cause.laws(cause.grid[0])[: len(values[0])]
    name, sizes = cause.covariates[0], cause.sizes(cause.grid[0])
    height = np.sum([s * v * b.value({name: grid}) for b, v, s in zip(own, values[0], sizes, strict=True)], axis=0)
    q, motion = at.variables[f"q{joint.number}"], at.motion[joint.frame, "q"]
    basis = orthonormal_basis(present.jacobian)
    turns = np.linspace(0.0, 2.0 * np.pi, TURNS, endpoint=False)
    gains = []
    for sense in (1, -1):
        for part in np.array_split(turns, 8):
            law = sense * np.interp((sense * q[:, None] + part) % (2.0 * np.pi), grid, height)
            trial = at.recording.given_common(motion[:, None] * law[at.row_pose])
            trial = trial - basis @ (basis.T @ trial)
            along = np.clip(left @ trial, 0.0, None)
            gains.append(along**2 / np.maximum(np.sum(trial**2, axis=0), 1e-300))
    gain = np.concatenate(gains)
    found: list[Placed] = []
    for k in np.argsort(-gain):
        seat = Placed(joint, 1 if k < TURNS else -1, float(turns[k % TURNS]))
        if all(seat.sense != other.sense or _apart(seat, other) > ELSEWHERE for other in found):
            found.append(seat)
        if len(found) == SEATS:
            break
    return tuple(found)


def _apart(one: Placed, other: Placed) -> float:
    return float(np.abs((one.shift - other.shift + np.pi) % (2.0 * np.pi) - np.pi))


def _slope(
    placed: tuple[Placed, ...], k: int, make: Callable[[Sequence[Placed]], RobotCause], at: Tangents, values: Array
) -> Array:
    """Derivative (m,) of what a curve with given amplitudes adds by the turn of one joint."""
    ends = [make((replace(placed[k], shift=placed[k].shift + side * STEP),)) for side in (1.0, -1.0)]
    ahead, behind = (at.columns(cause, cause.grid[0]) @ values for cause in ends)
    return np.asarray((ahead - behind) / (2.0 * STEP))


def maker(bumps: int, variables: Mapping[str, Array], count: int) -> Callable[[Sequence[Placed]], RobotCause]:
    """The cause of a pattern with so many bumps a turn; count : number of the robot's turning joints."""

    def make(placed: Sequence[Placed]) -> RobotCause:
        angles = variables[f"q{placed[0].joint.number}"]
        return shared_curve(placed, angles, bumps, len(placed) == count)

    return make
