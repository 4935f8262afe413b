"""The targets of a program corrected for a calibrated robot.

Cartesian targets become ``F*``, the frame to command to a controller that believes the nominal robot (Veitschegger and
Wu 1988, iterated); joint targets become the joint values that bring the real tool where the nominal robot would have
it. The configuration of a Cartesian target is the one it asks for; failing that, the one nearest to the target before
it, as controllers choose.

Frames: bases of programs are taken relative to the robot's base of the calibrated cell.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from robcal.programs.constants import several
from robcal.programs.targets import FrameOf, Hint, Program, Stated, Target, Unclear
from robcal.programs.text import Edit, Refusal, apply_edits
from robcal.robot.chain import Chain, chain_of, forward
from robcal.robot.compensation import Compensation, compensate
from robcal.robot.inverse import InverseSolutions, explain_unreachable, inverse_kinematics
from robcal.robot.kernel import Kernel
from robcal.transforms import Array, invert

ACTIVE = "active"
"""Name of a tool or base that the program nowhere mentions: the one that happens to be active."""


@dataclass(frozen=True)
class Corrected:
    """A corrected program.

    Attributes
    ----------
    texts : of its files. joints, frames : how many targets of each kind.
    before, remaining : (n, 6) twists of the real tool from where it should be, without and with the correction.
    notes : what was left as it is.
    """

    texts: tuple[str, ...]
    joints: int
    frames: int
    before: Array
    remaining: Array
    notes: tuple[str, ...]


@dataclass(frozen=True)
class GivenFrames:
    """Tools and bases (4, 4) by the name or number that programs use; ``robot_base``: others are the robot's base."""

    tools: Mapping[str, Array]
    bases: Mapping[str, Array]
    robot_base: bool = False


def correct(
    program: Program,
    kernel: Kernel,
    given: GivenFrames,
    *,
    payload: str | None = None,
    covariates: Mapping[str, float] | None = None,
    near: ArrayLike | None = None,
) -> Corrected:
    """The program with all its targets corrected.

    Parameters
    ----------
    kernel : the calibrated robot, deviations of base and tool folded into its references.
    payload : what the robot carries, by name. near : (N,) configuration before the first target.

    Raises
    ------
    Refusal : a tool or base is not known, or a target is out of reach; the message names the line.
    """
    if not program.targets:
        return Corrected(_marked(program, []), 0, 0, np.zeros((0, 6)), np.zeros((0, 6)), program.notes)
    chain = chain_of(kernel.model)
    tools, bases = _frames(program, given, chain.n_joints)
    wanted, q, notes = _believed(program, chain, tools, bases, near)
    edits: list[list[Edit]] = [[] for _ in program.sources]
    before, remaining = np.zeros((len(q), 6)), np.zeros((len(q), 6))
    rotary = ~_track(chain)
    for rows in _alike(tools):
        found = _compensated(kernel, tools[rows[0]], wanted[rows], q[rows], payload, covariates)
        _check(program, rows, found, chain, q)
        before[rows], remaining[rows] = found.before, found.remaining
        for k, row in enumerate(rows):
            literal = program.targets[row].literal
            axes = found.q[k, rotary]
            result = axes if literal.T is None else invert(bases[row]) @ found.F_star[k]
            edits[literal.source] += literal.write(result, q[row, rotary], axes)
    joints = sum(t.literal.T is None for t in program.targets)
    return Corrected(_marked(program, edits), joints, len(q) - joints, before, remaining, (*program.notes, *notes))


def _compensated(
    kernel: Kernel, tool: Array, wanted: Array, q: Array, payload: str | None, covariates: Mapping[str, float] | None
) -> Compensation:
    held = {name: np.full(len(q), value) for name, value in (covariates or {}).items()}
    with_tool = kernel.with_references(flange_T_tool=tool)
    return compensate(with_tool, wanted, payload=payload, covariates=held, near=q, frame="base")


def _alike(tools: Array) -> list[list[int]]:
    groups: dict[bytes, list[int]] = {}
    for row, tool in enumerate(tools):
        groups.setdefault(tool.tobytes(), []).append(row)
    return list(groups.values())


def _frames(program: Program, given: GivenFrames, n_joints: int) -> tuple[Array, Array]:
    """Tool and base (n, 4, 4) of every target."""
    tools, bases = np.tile(np.eye(4), (2, len(program.targets), 1, 1))
    missing: dict[str, None] = {}
    refusals: list[Refusal] = []
    for row, target in enumerate(program.targets):
        is_joint = target.literal.T is None
        if not (is_joint and n_joints >= 6):  # a whole pose of the flange needs no tool
            _take(tools[row], "tool", target.tool, given.tools, None, target, missing, refusals)
        if not is_joint:
            free = np.eye(4) if given.robot_base else None
            _take(bases[row], "base", target.base, given.bases, free, target, missing, refusals)
    if refusals:
        raise several(refusals)
    if missing:
        raise Refusal(f"{program.sources[0].name}: " + "; ".join(missing) + "; nothing was written")
    return tools, bases


def _take(
    out: Array,
    what: str,
    frame: FrameOf,
    known: Mapping[str, Array],
    free: Array | None,
    target: Target,
    missing: dict[str, None],
    refusals: list[Refusal],
) -> None:
    if isinstance(frame, Stated):
        out[:] = frame.frame
    elif isinstance(frame, Unclear):
        refusals.append(Refusal(f"{target.file}, line {target.line}: the {what} {frame.reason}"))
    else:
        spelt = {name.upper(): T for name, T in known.items()}
        T = spelt.get(frame.name.upper(), free)
        if T is not None:
            out[:] = T
            return
        where = f"(line {target.line}): give it with --{what} {frame.name}=FILE"
        says = "sets none" if frame.name == ACTIVE else f"names {what} '{frame.name}' without its numbers"
        other = ", or --robot-base if that is the robot's own" if what == "base" else ""
        if not any(f"--{what} {frame.name}=" in sentence for sentence in missing):
            subject = f"the program {says}" if frame.name != ACTIVE else f"the program sets no {what}"
            missing[f"{subject} {where}{other}"] = None


def _believed(
    program: Program, chain: Chain, tools: Array, bases: Array, near: ArrayLike | None
) -> tuple[Array, Array, list[str]]:
    """Where the nominal robot's tool would be (n, 4, 4) in base coordinates, its joint values (n, N), and notes."""
    targets = program.targets
    q = np.full((len(targets), chain.n_joints), np.nan)
    wanted = np.empty((len(targets), 4, 4))
    for row, target in enumerate(targets):
        if target.literal.T is None:
            if np.any(chain.prismatic & ~_track(chain)):
                raise Refusal(
                    f"{target.file}, line {target.line}: joint targets of an arm with a sliding joint are refused, "
                    "Cartesian ones are corrected; nothing was written"
                )
            q[row] = _joint_values(target, chain, np.asarray(target.literal.axes))
            wanted[row] = forward(chain, q[row][None])[0] @ tools[row]
        else:
            wanted[row] = bases[row] @ target.literal.T
    known = np.flatnonzero(np.all(np.isfinite(q), axis=1))
    current = q[known[0]] if len(known) else near
    solutions = _solutions(targets, chain, tools, wanted, current)
    refusals, notes = [], []
    for row, target in enumerate(targets):
        if target.literal.T is not None:
            one = solutions[row]
            now = one.near[0] if current is None else np.asarray(current, dtype=float)
            if np.any(_track(chain)):
                now = _joint_values(target, chain, now[~_track(chain)])
                one = inverse_kinematics(chain, one.base_T_flange, now)
            found, fits = _configuration(one, target.literal.hint, now)
            if found is None:
                why = explain_unreachable(one, 0)
                refusals.append(Refusal(f"{target.file}, line {target.line}: the target is out of reach: {why}"))
                continue
            if not fits:
                notes.append(
                    f"{target.file}, line {target.line}: the configuration that the target states (turn, quadrants) is "
                    "none of this robot's for it: the one nearest to the target before it was taken"
                )
            q[row] = found
        current = q[row]
    if refusals:
        raise several(refusals)
    return wanted, q, notes


def _solutions(
    targets: Sequence[Target], chain: Chain, tools: Array, wanted: Array, near: ArrayLike | None
) -> dict[int, InverseSolutions]:
    """All configurations of every Cartesian target, by row."""
    rows = [row for row, target in enumerate(targets) if target.literal.T is not None]
    if not rows:
        return {}
    if chain.n_joints < 6:  # the tool belongs to the chain: position goes before orientation
        with_tool = {row: replace(chain, home=chain.home @ tools[row]) for row in rows}
        return {row: inverse_kinematics(with_tool[row], wanted[row][None], near) for row in rows}
    every = inverse_kinematics(chain, wanted[rows] @ invert(tools[rows]), near)
    parts = ("base_T_flange", "near", "q", "within_limits", "excess")
    return {
        row: replace(every, **{part: getattr(every, part)[k : k + 1] for part in parts}) for k, row in enumerate(rows)
    }


def _configuration(one: InverseSolutions, hint: Hint, current: Array) -> tuple[Array | None, bool]:
    """The joint values (N,) that a target asks for, or the nearest ones, and whether they are what it asks for."""
    chain = one.chain
    near = current.copy()
    rotary = np.flatnonzero(~_track(chain))
    if hint.near is not None and len(hint.near) == len(rotary):
        near[rotary] = hint.near
    best: tuple[tuple[int, float], Array] | None = None
    nearest: tuple[float, Array] | None = None
    for branch in one.q[0][np.all(np.isfinite(one.q[0]), axis=-1)]:
        turned = branch + 2 * np.pi * np.arange(-2, 3)[:, None] * ~chain.prismatic
        allowed = (turned >= chain.lower - 1e-9) & (turned <= chain.upper + 1e-9)
        if not np.all(np.any(allowed, axis=0)):
            continue
        way = np.where(allowed, np.abs(turned - near), np.inf)
        plain = turned[np.argmin(way, axis=0), np.arange(chain.n_joints)]
        bad = np.zeros_like(way)
        for axis, joint in enumerate(rotary):
            bad[:, joint] = [hint.misses(axis, angle) for angle in turned[:, joint]]
        asked = turned[np.argmin(way + 1e3 * bad, axis=0), np.arange(chain.n_joints)]
        misses = sum(hint.misses(axis, asked[joint]) for axis, joint in enumerate(rotary))
        for_asked = (int(misses), float(np.sum((asked - near) ** 2)))
        if best is None or for_asked < best[0]:
            best = for_asked, asked
        distance = float(np.sum((plain - near) ** 2))
        if nearest is None or distance < nearest[0]:
            nearest = distance, plain
    if best is None or nearest is None:
        return None, False
    return (best[1], True) if best[0][0] == 0 else (nearest[1], False)


def _track(chain: Chain) -> NDArray[np.bool_]:
    """Sliding joints under the arm (N,), which controllers call external axes."""
    return np.asarray(np.logical_and.accumulate(chain.prismatic))


def _joint_values(target: Target, chain: Chain, axes: Array) -> Array:
    """Joint values (N,) of rotary axes and of the external ones that are joints of the robot."""
    rotary, sliding = np.flatnonzero(~_track(chain)), np.flatnonzero(_track(chain))
    literal = target.literal
    track = [value for value in literal.external[: len(sliding)] if value is not None]
    if len(axes) < len(rotary) or len(track) < len(sliding):
        raise Refusal(
            f"{target.file}, line {target.line}: the target gives {len(axes)} axes and {len(track)} external ones, the "
            f"robot has {len(rotary)} and {len(sliding)}: is it a program of this robot?"
        )
    q = np.empty(chain.n_joints)
    q[rotary], q[sliding] = axes[: len(rotary)], track
    return q


def _check(program: Program, rows: Sequence[int], found: Compensation, chain: Chain, q: Array) -> None:
    """Refuse what cannot be reached, and tracks that would have to move."""
    refusals = []
    for k, row in enumerate(rows):
        target = program.targets[row]
        where = f"{target.file}, line {target.line}"
        if not found.reachable[k]:
            refusals.append(Refusal(f"{where}: the corrected target is out of reach: {found.reason[k]}"))
        elif not found.converged[k]:
            refusals.append(Refusal(f"{where}: the target is met only approximately (near a singular pose?)"))
        elif np.max(np.abs((found.q[k] - q[row])[_track(chain)]), initial=0.0) > 1e-9:
            refusals.append(Refusal(f"{where}: the target is out of reach with the external axis where it is"))
    if refusals:
        raise several(refusals)


def _marked(program: Program, edits: Sequence[Sequence[Edit]]) -> tuple[str, ...]:
    """Texts of the files with their edits and, where something was corrected, the line that marks them."""
    texts = []
    for k, source in enumerate(program.sources):
        own = list(edits[k]) if edits else []
        marked = own or k == 0
        texts.append(apply_edits(source.text, [program.marks[k], *own] if marked else []))
    return tuple(texts)
