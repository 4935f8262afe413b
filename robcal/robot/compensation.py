"""What to command so that the real robot's tool comes where it is wanted.

The first-order command is one step of an iterative correction of the target (Veitschegger and Wu 1988, Robot
calibration and compensation). With the nominal inverse ``K^-1`` and the real forward model
``Kr`` (geometry, elasticity under the payload, all extra terms): ``Fh = Kr(K^-1(F))``, ``F* = F Fh^-1 F``, command
``K^-1(F*)``. It is exact if real and nominal robot differ by one constant frame on one side. The exact inverse repeats
the step on its own result, ``F* <- F* Fh^-1 F``, until the real model is at F; each round gains about the factor by
which the real robot differs from the nominal one (1e-3).

Frames: the controller believes ``world_T_tool = world_T_base K(q) flange_T_tool`` with the calibrated cell (base and
tool frames of the model, deviations included); ``F`` is a flange frame in that base.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from robcal.errors import InvalidInput
from robcal.robot.chain import Chain, chain_of, forward, forward_and_jacobian
from robcal.robot.hexapod import leg_commands, nominal_frames
from robcal.robot.inverse import (
    EXPLAINED,
    UNEXPLAINED,
    Selection,
    carried_arm,
    check_frames,
    explain_unreachable,
    follow,
    inverse_kinematics,
    select,
)
from robcal.robot.inverse_numeric import BoolArray, NumericSettings, refine
from robcal.robot.kernel import Kernel, PoseInputs
from robcal.robot.model import GEOMETRIC_KINDS, RobotModel
from robcal.transforms import Array, difference, frame_from_xyzrpy, invert, retract

Rows = NDArray[np.int_]
LEFT_OVER = 1e-6
"""m and rad; an exact command that leaves more than this is not handed out as one."""

LARGEST_STEP = 0.1
"""rad or m; a single joint step is no longer than this (near a singularity it would be without bound)."""

FLIP = 0.8
"""rad or m; a correction that moves a joint further has left the configuration (elbow or wrist flipped)."""

Method = Literal["exact", "first_order", "none"]


@dataclass(frozen=True)
class CompensationSettings:
    """Settings of the compensation.

    Attributes
    ----------
    method : 'exact' (iterated), 'first_order' (one step, as in a controller) or 'none' (nominal command).
    iterations : most steps of the exact inverse.
    tolerance : m and rad; largest component of the tool's remaining twist at which the iteration stops.
    as_path : True chooses each configuration near the one before it, False near ``near`` alone.
    """

    method: Method = "exact"
    iterations: int = 25
    tolerance: float = 1e-10
    as_path: bool = False


@dataclass(frozen=True)
class Compensation:
    """Commands for n wanted frames.

    Attributes
    ----------
    q : (n, N) joint values to command, rad or m; NaN where not reachable.
    F_star : (n, 4, 4) corrected target: the tool frame to command to a controller that believes the nominal robot, in
        the coordinates of the request (world or base); NaN where not reachable.
    remaining : (n, 6) twist (rho, omega) from the wanted tool frame to where the real model then is, tool coordinates.
    before : (n, 6) the same without compensation (the nominal command).
    reachable : (n,); reason : in words where not, None where reachable.
    converged : (n,) the remaining twist (position alone for fewer than six joints) is below ten times the tolerance.
    steps : number of corrections made.
    """

    q: Array
    F_star: Array
    remaining: Array
    before: Array
    reachable: BoolArray
    reason: tuple[str | None, ...] = field(repr=False)
    converged: BoolArray = field(repr=False)
    steps: int

    def require(self) -> "Compensation":
        """The same compensation.

        Raises
        ------
        InvalidInput : a frame is not reachable; the message names the first one and says why.
        """
        Selection(self.q, self.reachable, self.reason).require()
        return self


def cell_frames(kernel: Kernel) -> tuple[Array, Array]:
    """Calibrated world_T_base and flange_T_tool (4, 4), the model's deviations of base and tool included."""
    theta = dict(zip(kernel.names, kernel.theta0, strict=True))
    base = frame_from_xyzrpy([theta[f"base.{k}"] for k in GEOMETRIC_KINDS])
    tool = frame_from_xyzrpy([theta[f"tool.{k}"] for k in GEOMETRIC_KINDS])
    return kernel.world_T_base @ base, kernel.flange_T_tool @ tool


def compensate(
    robot: RobotModel | Kernel,
    wanted: ArrayLike,
    *,
    payload: Sequence[str | None] | str | None = None,
    covariates: Mapping[str, ArrayLike] | None = None,
    near: ArrayLike | None = None,
    frame: Literal["world", "base"] = "world",
    settings: CompensationSettings | None = None,
) -> Compensation:
    """Joint values (and corrected targets) that bring the real tool to the wanted frames.

    Parameters
    ----------
    robot : calibrated robot (parameters filled) or a kernel of it.
    wanted : (n, 4, 4) tool frames in the measuring system's coordinates, or in base coordinates with ``frame='base'``.
    payload : name per frame, one for all, or None.
    covariates : columns (n,) that the model's terms need; approach directions default to 0.
    near : (N,) or (n, N) configuration to stay near to; default the middle of the limits.

    Raises
    ------
    InvalidInput : frames that are not rigid, unknown payload, missing covariate. Frames out of reach are no error:
        they are marked, with the reason (call ``require()`` to insist).
    """
    options = settings or CompensationSettings()
    kernel = robot if isinstance(robot, Kernel) else Kernel(robot)
    if options.iterations < 1 or options.tolerance <= 0:
        raise InvalidInput("compensation needs at least one iteration and a positive tolerance")
    if frame not in ("world", "base"):
        raise InvalidInput(f"frames can be given in 'world' or 'base' coordinates, not '{frame}'")
    world_T_base, flange_T_tool = cell_frames(kernel)
    if kernel.model.is_hexapod:
        every = kernel.poses(np.zeros((len(check_frames(wanted)), 6)), payload, covariates)
        return _leg_lengths(kernel, check_frames(wanted), every, frame, options)
    nominal = chain_of(kernel.model)
    # the tool belongs to the chain: arms of fewer than six joints give the tool's position precedence, not the flange's
    chain = replace(nominal, home=nominal.home @ flange_T_tool)
    given = check_frames(wanted)
    target = given if frame == "world" else world_T_base @ given
    F = invert(world_T_base) @ target
    solutions = inverse_kinematics(chain, F, near, all_branches=False)
    path = options.as_path and len(F) > 0
    chosen = follow(solutions, solutions.near[0], explain=False) if path else select(solutions, explain=False)
    every = kernel.poses(np.where(chosen.reachable[:, None], chosen.q, solutions.near), payload, covariates)
    task = _Task(kernel, chain, every, target, world_T_base, options)
    state = _State(chosen.q.copy(), list(chosen.reason), np.full((len(F), 6), np.nan))
    rows = np.flatnonzero(chosen.reachable)
    state.remaining[rows] = task.twist(rows, chosen.q[rows])
    before = state.remaining.copy()
    steps = _iterate(task, state, rows)
    if options.method == "exact":
        _search_on(task, state)
    reachable = np.all(np.isfinite(state.q), axis=1)
    # the nearest pose costs a search, so reasons are found last and only for so many
    unexplained = [i for i in np.flatnonzero(~reachable) if state.reason[i] is None]
    for k, i in enumerate(unexplained):
        state.reason[i] = explain_unreachable(solutions, int(i)) if k < EXPLAINED else UNEXPLAINED
    F_star = np.full_like(F, np.nan)
    if np.any(reachable):
        # the command's own target: where the nominal robot's tool is with these joint values
        tool = forward(chain, state.q[reachable])
        F_star[reachable] = tool if frame == "base" else world_T_base @ tool
    state.remaining[~reachable] = np.nan
    with np.errstate(invalid="ignore"):
        converged = _size(chain, state.remaining) <= 10.0 * options.tolerance
    return Compensation(state.q, F_star, state.remaining, before, reachable, tuple(state.reason), converged, steps)


def _leg_lengths(
    kernel: Kernel, wanted: Array, every: PoseInputs, frame: str, options: CompensationSettings
) -> Compensation:
    """Commands for a Stewart platform: its inverse is closed, with its deviations as without ('none')."""
    world_T_base, flange_T_tool = cell_frames(kernel)
    target = wanted if frame == "world" else world_T_base @ wanted
    platform = invert(world_T_base) @ target @ invert(flange_T_tool)
    found = leg_commands(kernel.model, platform, calibrated=options.method != "none")
    plain = leg_commands(kernel.model, platform, calibrated=False)
    remaining, before, F_star = np.full((len(wanted), 6), np.nan), np.full((len(wanted), 6), np.nan), wanted + np.nan

    def twist(q: Array, rows: Rows) -> Array:
        return difference(target[rows], kernel.frames(kernel.theta0, every.subset(rows).with_q(q[rows])))

    rows, nominal = np.flatnonzero(found.reachable), np.flatnonzero(plain.reachable)
    remaining[rows], before[nominal] = twist(found.q, rows), twist(plain.q, nominal)
    if len(rows):
        tool = nominal_frames(kernel.model, found.q[rows]) @ flange_T_tool
        F_star[rows] = tool if frame == "base" else world_T_base @ tool
    with np.errstate(invalid="ignore"):
        converged = np.max(np.abs(remaining), axis=1, initial=0.0) <= 10.0 * options.tolerance
    return Compensation(found.q, F_star, remaining, before, found.reachable, found.reason, converged, 1)


@dataclass
class _State:
    q: Array
    reason: list[str | None]
    remaining: Array


@dataclass(frozen=True)
class _Task:
    """What is wanted: the tool of the real robot at ``target`` (n, 4, 4) in the world, by a nominal ``chain``."""

    kernel: Kernel
    chain: Chain
    every: PoseInputs
    target: Array
    world_T_base: Array
    options: CompensationSettings

    def twist(self, rows: Rows, q: Array) -> Array:
        """(k, 6) from the wanted frames of some rows to the real tool at joint values (k, N)."""
        moved = self.every.subset(rows).with_q(q)
        return difference(self.target[rows], self.kernel.frames(self.kernel.theta0, moved))


def _iterate(task: _Task, state: _State, rows: Rows) -> int:
    """Correct the rows until they gain nothing any more, in place; number of corrections."""
    chain, options = task.chain, task.options
    most = {"exact": options.iterations, "first_order": 1, "none": 0}[options.method]
    size = _size(chain, state.remaining)
    quick = np.full(len(state.q), options.method == "exact" or chain.n_joints < 6)
    steps = 0
    while steps < most and len(rows):
        steps += 1
        # joint steps while they gain much; near singularities the closed form of the corrected target
        stepped = _joint_step(chain, state, rows[quick[rows]])
        rest = np.setdiff1d(rows, stepped, assume_unique=True)
        quick[rest] = False
        moved = _correct(task, state, rest)
        rows = np.concatenate([stepped, rest[moved]])
        state.remaining[rows] = task.twist(rows, state.q[rows])
        new = _size(chain, state.remaining[rows])
        # a loop that gains nothing ends
        going = (new > options.tolerance) & ((new < 0.9 * size[rows]) | (steps < 3))
        quick[rows] &= (new < 0.25 * size[rows]) | (chain.n_joints < 6)
        size[rows] = np.minimum(size[rows], new)
        rows = rows[going]
    return steps


def _size(chain: Chain, twist: Array) -> Array:
    """Largest component of twists (n, 6); of their positions alone where orientation cannot be followed."""
    return np.max(np.abs(twist[:, :3] if chain.n_joints < 6 else twist), axis=1, initial=0.0)


def _joint_step(chain: Chain, state: _State, rows: Rows) -> Rows:
    """Joint step of the nominal robot that takes the real tool to the target; returns the rows that it moved.

    For fewer than six joints position goes before orientation: the target's unreachable part must not pile up in F*.
    A track under an arm stays where it is.
    """
    if not len(rows):
        return rows
    q = state.q[rows]
    _, J = forward_and_jacobian(chain, q)
    held = carried_arm(chain)[1]
    weight = NumericSettings().weight(chain)
    Jw = weight[:, None] * J[:, :, held:]
    normal = np.swapaxes(Jw, 1, 2) @ Jw + 1e-14 * np.eye(Jw.shape[2])
    # remaining is where the real tool is, seen from the target; the way back is seen from the real tool
    back = difference(retract(np.eye(4), state.remaining[rows]), np.eye(4))
    gradient = np.einsum("nij,ni->nj", Jw, weight * back)
    step = np.zeros_like(q)
    step[:, held:] = np.linalg.solve(normal, gradient[..., None])[..., 0]
    largest = np.max(np.abs(step), axis=1, keepdims=True)
    new = q + step * np.minimum(1.0, LARGEST_STEP / np.maximum(largest, 1e-300))
    good = np.all((new >= chain.lower - 1e-9) & (new <= chain.upper + 1e-9), axis=1)
    state.q[rows[good]] = new[good]
    return rows[good]


def _correct(task: _Task, state: _State, rows: Rows) -> BoolArray:
    """``F* <- F* Fh^-1 F`` with ``F* = K(q)`` and its joint values, in place; False where that is out of reach."""
    if not len(rows):
        return np.zeros(0, bool)
    q, chain, kernel = state.q[rows], task.chain, task.kernel
    if chain.n_joints < 6:
        for i in rows:
            state.reason[i] = "the correction leads beyond a joint limit or out of the workspace"
        state.q[rows] = np.nan
        return np.zeros(len(rows), bool)
    base_T_world = invert(task.world_T_base)
    Fh = base_T_world @ kernel.frames(kernel.theta0, task.every.subset(rows).with_q(q))
    F_star = forward(chain, q) @ invert(Fh) @ (base_T_world @ task.target[rows])
    chosen = select(inverse_kinematics(chain, F_star, q, all_branches=False), explain=False)
    with np.errstate(invalid="ignore"):
        flipped = chosen.reachable & (np.max(np.abs(chosen.q - q), axis=1) > FLIP)
    moved = chosen.reachable & ~flipped
    state.q[rows] = np.where(moved[:, None], chosen.q, np.nan)
    for k in np.flatnonzero(~moved):
        state.reason[rows[k]] = (
            "the corrected target is not reachable in this configuration (singular or fully stretched)"
            if flipped[k]
            else "the nominal robot reaches the frame, but not its corrected target (limits or workspace)"
        )
    return moved


def _search_on(task: _Task, state: _State) -> None:
    """Rows that the correction did not solve, on the real model itself: damped least squares within the limits.

    Near a singularity or the edge of the workspace F* may be out of the nominal robot's reach and F yet within the
    real one's.
    """
    kernel, chain, options = task.kernel, task.chain, task.options
    with np.errstate(invalid="ignore"):
        solved = _size(chain, state.remaining) <= options.tolerance
    rows = np.flatnonzero(~(solved & np.all(np.isfinite(state.q), axis=1)))
    if not len(rows):
        return
    poses = task.every.subset(rows)
    known = np.isfinite(state.q[rows])
    start = np.where(known, state.q[rows], poses.q)

    def at(q: Array, which: Rows) -> tuple[Array, Array]:
        moved = poses.subset(which).with_q(q)
        return kernel.frames(kernel.theta0, moved), kernel.joint_jacobian(kernel.theta0, moved)

    settings = NumericSettings(tolerance=options.tolerance)
    q, _ = refine(chain, task.target[rows], start, settings, within_limits=True, evaluate=at)
    twist = task.twist(rows, q)
    reached = settings.reached(chain, 0.1 * twist) if chain.n_joints >= 6 else settings.reached(chain, twist)
    had = np.all(known, axis=1)
    with np.errstate(invalid="ignore"):
        better = reached | (had & (_size(chain, twist) < _size(chain, state.remaining[rows])))
    for k in np.flatnonzero(better):
        state.q[rows[k]], state.remaining[rows[k]] = q[k], twist[k]
        state.reason[rows[k]] = None
    for i in rows[_size(chain, np.nan_to_num(state.remaining[rows])) > LEFT_OVER]:
        distance, angle = (float(np.linalg.norm(part)) for part in (state.remaining[i, :3], state.remaining[i, 3:]))
        state.reason[i] = (
            "the nominal robot reaches the frame, the real one near it comes no nearer than "
            f"{1e3 * distance:.3f} mm and {np.rad2deg(angle):.4f} deg within its limits"
        )
        state.q[i] = np.nan
