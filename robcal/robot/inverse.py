"""Nominal inverse kinematics: all branches, joint limits, choice of a configuration, and why a frame is out of reach.

The inverse is that of the nominal geometry, as the controller has it; the real robot enters in
:mod:`robcal.robot.compensation`. Closed form where the joint lines allow it (:mod:`robcal.robot.structure`), numeric
otherwise; a chain that only adds a linear track under a closed-form arm keeps the track where ``near`` has it.
"""

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from robcal.errors import InvalidInput
from robcal.robot.chain import Chain, chain_of, check_joint_angles, forward, forward_and_jacobian, limit_excess
from robcal.robot.inverse_analytic import solve_parallel_arm, solve_spherical_wrist
from robcal.robot.inverse_numeric import BoolArray, NumericSettings, nearest_pose, search
from robcal.robot.model import RobotModel
from robcal.robot.structure import SphericalWrist, Structure, find_structure
from robcal.transforms import Array, difference

SINGULAR_CONDITION = 1e-4
"""Smallest over largest singular value of the Jacobian below which a configuration counts as singular."""

EXPLAINED = 25
"""So many unreachable frames of one request are explained one by one."""

UNEXPLAINED = "out of reach or beyond a joint limit"

_LIMIT_TOLERANCE = 1e-9


@dataclass(frozen=True)
class InverseSolutions:
    """Branches of the inverse of n frames.

    Attributes
    ----------
    chain : the chain they belong to.
    base_T_flange : (n, 4, 4) wanted frames.
    near : (n, N) configuration that turns (multiples of 2 pi) and choices refer to.
    q : (n, B, N) joint values in rad or m, NaN where a branch does not exist.
    within_limits : (n, B) exists and respects all limits.
    excess : (n, B, N) how far each joint is beyond its limits, signed; NaN where a branch does not exist.
    method : 'spherical wrist', 'parallel arm' or 'numeric', with 'on a track' where it applies.
    """

    chain: Chain
    base_T_flange: Array
    near: Array
    q: Array
    within_limits: BoolArray
    excess: Array
    method: str

    @property
    def count(self) -> NDArray[np.int_]:
        """Number of branches within limits, (n,)."""
        return np.sum(self.within_limits, axis=1)


@dataclass(frozen=True)
class Selection:
    """One configuration a frame: q (n, N), NaN where none; reachable (n,); reason (n) in words, None if reachable."""

    q: Array
    reachable: BoolArray
    reason: tuple[str | None, ...] = field(repr=False)

    def require(self, what: str = "frame") -> Array:
        """The joint values.

        Raises
        ------
        InvalidInput : some frame is not reachable; the message names the first one and says why.
        """
        bad = np.flatnonzero(~self.reachable)
        if len(bad):
            more = f" ({len(bad)} of {len(self.q)} are not reachable)" if len(bad) > 1 else ""
            raise InvalidInput(f"{what} {bad[0] + 1} is not reachable: {self.reason[bad[0]]}{more}")
        return self.q


def inverse_kinematics(
    model: RobotModel | Chain,
    base_T_flange: ArrayLike,
    near: ArrayLike | None = None,
    *,
    all_branches: bool = True,
    settings: NumericSettings | None = None,
) -> InverseSolutions:
    """All joint configurations that bring the nominal flange to frames (n, 4, 4) or (4, 4) in base coordinates.

    Parameters
    ----------
    near : (N,) or (n, N) configuration to stay close to: decides multiples of 2 pi, free joints in singular poses, the
        position of a track. Default: the middle of the limits.
    all_branches : a numeric search stops at the first solution within limits if False.

    Raises
    ------
    InvalidInput : frames that are not finite or not rigid; the message names the row.
    """
    chain = model if isinstance(model, Chain) else chain_of(model)
    frames = check_frames(base_T_flange)
    start = _start(chain, near, len(frames))
    if len(frames) == 0:
        return _finish(chain, frames, start, np.empty((0, 1, chain.n_joints)), "numeric")
    arm, first = carried_arm(chain)
    structure = find_structure(arm) if arm is not None else None
    if arm is not None and structure is not None:
        if first:
            return _on_track(chain, arm, structure, frames, start)
        method = "spherical wrist" if isinstance(structure, SphericalWrist) else "parallel arm"
        q = _polish(chain, frames, _closed_form(chain, structure, frames, start))
        return _finish(chain, frames, start, q, method)
    q = search(chain, frames, start, settings or NumericSettings(), all_branches=all_branches)
    return _finish(chain, frames, start, q, "numeric")


def select(solutions: InverseSolutions, near: ArrayLike | None = None, *, explain: bool = True) -> Selection:
    """For every frame the branch within limits that is nearest to ``near`` (default: that of the search)."""
    chain = solutions.chain
    start = solutions.near if near is None else _start(chain, near, len(solutions.q))
    q, excess = _turn_near(chain, solutions.q, start[:, None])
    allowed = _respects(q, excess)
    distance = np.where(allowed, np.sum((q - start[:, None]) ** 2, axis=-1), np.inf)
    best = np.argmin(distance, axis=1)
    rows = np.arange(len(q))
    reachable = np.isfinite(distance[rows, best])
    chosen = np.where(reachable[:, None], q[rows, best], np.nan)
    reasons: list[str | None] = [None] * len(q)
    if explain:
        for k, i in enumerate(np.flatnonzero(~reachable)):
            # the nearest pose costs a search: enough of them is enough
            reasons[i] = explain_unreachable(solutions, int(i)) if k < EXPLAINED else UNEXPLAINED
    return Selection(chosen, reachable, tuple(reasons))


def follow(solutions: InverseSolutions, start: ArrayLike, *, explain: bool = True) -> Selection:
    """Like :func:`select`, each frame near the configuration chosen for the frame before it (a path)."""
    chain = solutions.chain
    current = check_joint_angles(chain, start)[0]
    chosen, reachable, reasons = [], [], []
    for i in range(len(solutions.q)):
        one = replace(
            solutions,
            base_T_flange=solutions.base_T_flange[i : i + 1],
            near=current[None],
            q=solutions.q[i : i + 1],
            within_limits=solutions.within_limits[i : i + 1],
            excess=solutions.excess[i : i + 1],
        )
        step = select(one, explain=explain)
        chosen.append(step.q[0])
        reachable.append(bool(step.reachable[0]))
        reasons.append(step.reason[0])
        if step.reachable[0]:
            current = step.q[0]
    return Selection(np.array(chosen).reshape(-1, chain.n_joints), np.array(reachable, bool), tuple(reasons))


def explain_unreachable(solutions: InverseSolutions, row: int) -> str:
    """Why a frame has no solution within limits: the limits that forbid it, or how near the robot can come."""
    chain = solutions.chain
    exists = np.all(np.isfinite(solutions.q[row]), axis=-1)
    if np.any(exists):
        branches = np.flatnonzero(exists)
        worst = np.max(np.abs(solutions.excess[row, branches]), axis=1)
        k = branches[int(np.argmin(worst))]
        parts = []
        for j in np.flatnonzero(np.abs(solutions.excess[row, k]) > _LIMIT_TOLERANCE):
            amount = solutions.excess[row, k, j]
            text = f"{1e3 * abs(amount):.2f} mm" if chain.prismatic[j] else f"{np.rad2deg(abs(amount)):.2f} deg"
            side = "above its upper" if amount > 0 else "below its lower"
            parts.append(f"{chain.names[j]} would be {text} {side} limit")
        return "joint limits: in the most favourable configuration " + " and ".join(parts)
    _, twist = nearest_pose(chain, solutions.base_T_flange[row], solutions.near[row], NumericSettings(iterations=60))
    return (
        "outside the workspace: within its limits the robot comes no nearer than "
        f"{1e3 * np.linalg.norm(twist[:3]):.2f} mm and {np.rad2deg(np.linalg.norm(twist[3:])):.3f} deg"
    )


def conditioning(model: RobotModel | Chain, q: ArrayLike, length: float = 0.3) -> Array:
    """Smallest over largest singular value of the Jacobian (n,), metres with radians taken at ``length``.

    Below :data:`SINGULAR_CONDITION` the configuration is singular: some direction costs unbounded joint motion.
    """
    chain = model if isinstance(model, Chain) else chain_of(model)
    _, J = forward_and_jacobian(chain, q)
    values = np.linalg.svd(np.array([1.0] * 3 + [length] * 3)[:, None] * J, compute_uv=False)
    return np.asarray(values[:, -1] / values[:, 0])


def check_frames(frames: ArrayLike) -> Array:
    """Frames as (n, 4, 4) floats.

    Raises
    ------
    InvalidInput : wrong shape, not finite or not a rotation; the message names the row.
    """
    T = np.asarray(frames, dtype=float)
    T = T[None] if T.ndim == 2 else T
    if T.ndim != 3 or T.shape[1:] != (4, 4):
        raise InvalidInput(f"frames must be 4x4 matrices, got an array of shape {np.shape(frames)}")
    bad = np.flatnonzero(~np.all(np.isfinite(T), axis=(1, 2)))
    if len(bad):
        raise InvalidInput(f"frame {bad[0] + 1} holds numbers that are not finite; remove or repair the row")
    R = T[:, :3, :3]
    skewness = np.max(np.abs(np.swapaxes(R, 1, 2) @ R - np.eye(3)), axis=(1, 2), initial=0.0)
    bad = np.flatnonzero((skewness > 1e-6) | (np.linalg.det(R) < 0))
    if len(bad):
        raise InvalidInput(f"frame {bad[0] + 1} is not a rigid frame: its rotation part is no rotation matrix")
    return T


def _start(chain: Chain, near: ArrayLike | None, n: int) -> Array:
    if near is None:
        bounded = np.isfinite(chain.lower) & np.isfinite(chain.upper)
        middle = np.where(bounded, 0.5 * (np.where(bounded, chain.lower, 0) + np.where(bounded, chain.upper, 0)), 0.0)
        return np.broadcast_to(np.clip(middle, chain.lower, chain.upper), (n, chain.n_joints)).copy()
    values = check_joint_angles(chain, near)
    if len(values) not in (1, n):
        raise InvalidInput(f"{len(values)} start configurations were given for {n} frames; give one, or one a frame")
    return np.broadcast_to(values, (n, chain.n_joints)).copy()


def _closed_form(chain: Chain, structure: Structure, frames: Array, near: Array) -> Array:
    if isinstance(structure, SphericalWrist):
        return solve_spherical_wrist(chain, structure, frames, near)
    if structure is None:
        raise InvalidInput("the chain has no closed-form inverse")
    return solve_parallel_arm(chain, structure, frames, near)


def _polish(chain: Chain, frames: Array, q: Array) -> Array:
    """Newton steps where the chain departs from the closed form's structure; branches that don't hold become NaN."""
    n, branches, _ = q.shape
    out = q.copy()
    rows, cols = np.nonzero(np.all(np.isfinite(q), axis=-1))
    values, wanted = q[rows, cols], frames[rows]
    error = np.zeros(len(values))
    poor = np.arange(len(values))
    for _ in range(6):
        if not len(poor):
            break
        r = difference(forward(chain, values[poor]), wanted[poor])
        error[poor] = np.max(np.abs(r), axis=1)
        bad = error[poor] > 1e-11
        poor, r = poor[bad], r[bad]
        if len(poor):
            # small singular values are cut: in a singular pose the closed form's own choice of the free joint is kept
            _, J = forward_and_jacobian(chain, values[poor])
            values[poor] += np.einsum("nij,nj->ni", np.linalg.pinv(J, rcond=1e-6), r)
    if len(poor):
        error[poor] = np.max(np.abs(difference(forward(chain, values[poor]), wanted[poor])), axis=1)
    values[error > 1e-8] = np.nan
    out[rows, cols] = values
    # branches that have become one
    for b in range(1, branches):
        for a in range(b):
            gap = np.max(np.abs(np.sin(0.5 * (out[:, b] - out[:, a]))), axis=-1)
            out[:, b][gap < 1e-9] = np.nan
    return out.reshape(n, branches, -1)


def _turn_near(chain: Chain, q: Array, near: Array) -> tuple[Array, Array]:
    """Rotary joints moved by whole turns: nearest to ``near`` among those within limits; and what is left beyond."""
    turn = 2.0 * np.pi
    rotary = ~chain.prismatic
    best = np.where(rotary, q - turn * np.round((q - near) / turn), q)
    high, low = best - chain.upper - _LIMIT_TOLERANCE, chain.lower - _LIMIT_TOLERANCE - best
    turns = np.where(rotary & (high > 0), -np.ceil(high / turn), np.where(rotary & (low > 0), np.ceil(low / turn), 0.0))
    moved = best + turn * turns
    excess = limit_excess(chain, moved)
    other = limit_excess(chain, best)
    stay = np.abs(other) < np.abs(excess)
    return np.where(stay, best, moved), np.where(stay, other, excess)


def _respects(q: Array, excess: Array) -> BoolArray:
    return np.all(np.isfinite(q), axis=-1) & np.all(np.abs(np.nan_to_num(excess)) <= _LIMIT_TOLERANCE, axis=-1)


def _finish(chain: Chain, frames: Array, near: Array, q: Array, method: str) -> InverseSolutions:
    turned, excess = _turn_near(chain, q, near[:, None])
    return InverseSolutions(chain, frames, near, turned, _respects(turned, excess), excess, method)


def carried_arm(chain: Chain) -> tuple[Chain | None, int]:
    """The arm that may have a closed form, and the index of its first joint: the chain itself, or what a track carries.

    The track (a sliding first joint under six rotary ones) is taken at zero; None where the chain is of another kind.
    """
    if chain.coupling is not None:
        return None, 0
    if chain.n_joints != 7 or not chain.prismatic[0] or bool(np.any(chain.prismatic[1:])):
        return (chain, 0) if chain.n_joints == 6 else (None, 0)
    arm = Chain(
        chain.names[1:],
        chain.prismatic[1:],
        chain.axes[1:],
        chain.points[1:],
        chain.home,
        chain.frames_home,
        np.maximum(chain.moved_by - 1, -1),
        chain.lower[1:],
        chain.upper[1:],
    )
    return arm, 1


def _on_track(chain: Chain, arm: Chain, structure: Structure, frames: Array, near: Array) -> InverseSolutions:
    """The arm's branches with the track where ``near`` has it; failing that, at the nearest place where one exists."""
    q = _at_track(chain, arm, structure, frames, near, near[:, 0])
    result = _finish(chain, frames, near, q, "")
    rows = np.flatnonzero(result.count == 0)
    low, high = chain.lower[0], chain.upper[0]
    if len(rows) and np.isfinite(low) and np.isfinite(high) and high > low:
        places = np.linspace(low, high, 81)
        order = np.argsort(np.abs(places[None] - near[rows, :1]), axis=1)
        for k in range(len(places)):
            if not len(rows):
                break
            place = places[order[:, k]]
            trial = _at_track(chain, arm, structure, frames[rows], near[rows], place)
            works = _finish(chain, frames[rows], near[rows], trial, "").count > 0
            q[rows[works]] = trial[works]
            rows, order = rows[~works], order[~works]
    kind = "spherical wrist" if isinstance(structure, SphericalWrist) else "parallel arm"
    return _finish(chain, frames, near, q, f"{kind} on a track")


def _at_track(chain: Chain, arm: Chain, structure: Structure, frames: Array, near: Array, place: Array) -> Array:
    shifted = frames.copy()
    shifted[:, :3, 3] -= place[:, None] * chain.axes[0]
    q = _polish(arm, shifted, _closed_form(arm, structure, shifted, near[:, 1:]))
    track = np.broadcast_to(place[:, None, None], (*q.shape[:2], 1))
    return np.concatenate([np.where(np.isnan(q[..., :1]), np.nan, track), q], axis=-1)
