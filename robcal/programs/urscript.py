"""Universal Robots' URScript.

Read are movej, movel, movep, movec, servoj, servoc with poses p[x, y, z, rx, ry, rz] and joint angles [q0 ... q5] by
their numbers or by name, pose_trans, pose_inv and get_inverse_kin of constants, and set_tcp (Universal Robots, script
manual). Poses are in the robot's base; angles and rotation vectors in radians.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from robcal.programs.constants import Current, Expression, Later, Names, Opaque, Ref, Use, checked_frame, program
from robcal.programs.flow import Active, Blocks, Flow, Step
from robcal.programs.targets import (
    IDENTITY,
    FrameOf,
    Hint,
    Named,
    Program,
    Stated,
    Unclear,
    Written,
    frame_edits,
    frame_of_numbers,
    numbers_of_frame,
)
from robcal.programs.text import MARK, Edit, Number, Refusal, Source, Token, constant, mark, number_edit, split, tokens
from robcal.transforms import Array, invert

DIGITS = (7, 7)
"""Least decimals of m and rad."""
MOTIONS = {"movej": 1, "movel": 1, "movep": 1, "movec": 2, "servoj": 1, "servoc": 1}
"""Function -> how many of its first arguments are targets."""
GUIDED = {
    "speedj": "moves at a speed and to no target",
    "speedl": "moves at a speed and to no target",
    "force_mode": "moves as a force demands",
    "path_offset_set": "shifts the targets while the program runs",
    "path_offset_enable": "shifts the targets while the program runs",
    "track_conveyor_linear": "moves all targets with a conveyor",
    "track_conveyor_circular": "moves all targets with a conveyor",
    "set_conveyor_tick_count": "moves all targets with a conveyor",
}
PRESENT = frozenset({
    "get_actual_joint_positions", "get_target_joint_positions", "get_actual_tcp_pose", "get_target_tcp_pose",
})  # fmt: skip
TAKE_POSES = frozenset({
    "pose_trans", "pose_inv", "pose_add", "pose_sub", "pose_dist", "point_dist", "interpolate_pose", "get_inverse_kin",
    "get_inverse_kin_has_solution", "get_forward_kin", "is_within_safety_limits", "wrench_trans", "textmsg", "popup",
    "to_str", "socket_send_string", "assert", "varmsg",
})  # fmt: skip
"""Functions of the language that take poses and move nothing."""
FUNCTIONS = {"d2r": math.radians, "r2d": math.degrees}


@dataclass
class _Reader:
    names: Names
    text: str
    blocks: Blocks = field(default_factory=Blocks)
    moves: list[tuple[Expression, int]] = field(default_factory=list)
    functions: set[str] = field(default_factory=set)
    open: list[str] = field(default_factory=list)


def read_urscript(source: Source) -> Program:
    """The program of a script.

    Raises
    ------
    Refusal : something cannot be corrected right; the message names the line.
    """
    reader = _Reader(Names((source,), key=str), source.text)
    statements = _statements(source.text)
    reader.functions = {s[1].text for s in statements if s[0].text in ("def", "sec") and len(s) > 1}
    for items in statements:
        _define(reader, items)
    reader.blocks.routine("")
    for items in statements:
        _follow(reader, items)
    entries = _entries(reader)
    flow = Flow({n: tuple(s) for n, s in reader.blocks.routines.items()}, Active(Named("active"), IDENTITY))
    at = flow.walk(entries)
    uses = [
        Use(target, at.get(k, flow.start).tool, IDENTITY, 0, place) for k, (target, place) in enumerate(reader.moves)
    ]
    bom = 3 if source.text.startswith("\xef\xbb\xbf") else 0
    return program(reader.names, uses, [mark(source.text, f"# {MARK}", bom)])


def _entries(reader: _Reader) -> list[str]:
    """The statements outside of functions come first and then, with what they set, functions that nothing calls."""
    outside = reader.blocks.routines[""]
    for name in reader.blocks.routines:
        if name and name not in reader.blocks.called:
            outside.append(Step("call", name))
    return [""]


def _statements(text: str) -> list[list[Token]]:
    """Statements, one a line, or over several where a bracket is open."""
    out: list[list[Token]] = [[]]
    depth = 0
    for token in tokens(text, "#", "\"'", r"[A-Za-z_]\w*", ("==", "!=", "<=", ">=")):
        if token.kind in ("end", ";") and depth <= 0:
            out.append([])
            depth = 0
        elif token.kind != "end":
            depth += (token.kind in "([{") - (token.kind in ")]}")
            out[-1].append(token)
    return [s for s in out if s]


def _six(items: Sequence[Token]) -> list[Number] | None:
    """The six constants of a bracket [...]; None if they are not constants."""
    parts = [constant(part, FUNCTIONS) for part in split(items[1:-1], ",")]
    return [p for p in parts if p is not None] if len(parts) == 6 and all(p is not None for p in parts) else None


def _expression(reader: _Reader, items: Sequence[Token]) -> Expression:
    """A pose or joint angles."""
    if not items:
        return Opaque(0, 0, "a target is missing")
    head, start = items[0], items[0].start
    second = items[1].kind if len(items) > 1 else ""
    if head.kind == "[" and items[-1].kind == "]":
        numbers = _six(items)
        if numbers is None:
            return Opaque(0, start, "the joint angles are not six constants")
        return _axes(reader, numbers, start)
    if head.text == "p" and second == "[" and items[-1].kind == "]":
        numbers = _six(items[1:])
        if numbers is None:
            return Opaque(0, start, "the pose is not made of six constants")
        return _pose(reader, numbers, start)
    if head.kind != "word":
        return Opaque(0, start, "the target cannot be read")
    if len(items) == 1:
        return Ref(head.text, 0, start)
    if second == "[" and items[-1].kind == "]":
        inside = items[2:-1]
        fixed = len(inside) == 1 and inside[0].kind == "number"
        return Ref(head.text, 0, start, inside[0].text if fixed else None)
    if second == "(" and items[-1].kind == ")":
        return _function(reader, head, items)
    return Opaque(0, start, f"the target is computed when the program runs, '{head.text}'")


def _function(reader: _Reader, head: Token, items: Sequence[Token]) -> Expression:
    arguments = split(items[2:-1], ",")
    if head.text in PRESENT:
        return Current()
    if head.text == "get_inverse_kin" and arguments[0]:
        pose = _expression(reader, _unnamed(arguments[0]))
        near = _expression(reader, _unnamed(arguments[1])) if len(arguments) > 1 and arguments[1] else None
        return pose if near is None else Later(lambda: _hinted(reader, pose, near))
    if head.text in ("pose_trans", "pose_inv"):
        return Later(lambda: _product(reader, items))
    return Opaque(0, head.start, f"a function finds the target when the program runs, '{head.text}'")


def _hinted(reader: _Reader, pose: Expression, near: Expression) -> Written:
    """A pose with joint angles near which it is meant."""
    found = reader.names.single(pose)
    try:
        axes = reader.names.single(near).axes
    except Refusal:
        return found  # found when the program runs: as near as the target before it
    return found if axes is None else replace(found, hint=Hint(near=tuple(float(v) for v in axes)))


def _product(reader: _Reader, items: Sequence[Token]) -> Written:
    """pose_trans(a, b) of constants, to be replaced by its corrected numbers."""
    T = _constant_frame(reader, items)
    start, stop = items[0].start, items[-1].stop

    def write(F: Array, before: Array, after: Array) -> list[Edit]:
        old = numbers_of_frame(T, np.zeros(6), "rotation_vector", 1.0)
        values = numbers_of_frame(F, old, "rotation_vector", 1.0)
        return [Edit(start, stop, "p[" + ", ".join(f"{v + 0.0:.{DIGITS[0]}f}" for v in values) + "]")]

    return Written(0, start, write, T)


def _constant_frame(reader: _Reader, items: Sequence[Token]) -> Array:
    head = items[0]
    if head.text in ("pose_trans", "pose_inv") and len(items) > 3 and items[-1].kind == ")":
        parts = [_constant_frame(reader, _unnamed(part)) for part in split(items[2:-1], ",") if part]
        if len(parts) == (2 if head.text == "pose_trans" else 1):
            return parts[0] @ parts[1] if len(parts) == 2 else invert(parts[0])
        raise reader.names.refuse(0, head.start, f"{head.text} has not the arguments that it needs")
    value = _expression(reader, items)
    if isinstance(value, Current):
        raise reader.names.refuse(0, head.start, "a move relative to where the robot happens to be cannot be corrected")
    if isinstance(value, Opaque):
        raise reader.names.refuse(0, head.start, "a shift by variables cannot be corrected")
    return checked_frame(reader.names.single(value), reader.names)


def _pose(reader: _Reader, numbers: Sequence[Number], start: int) -> Written:
    T = frame_of_numbers(np.array([n.value for n in numbers]), "rotation_vector", 1.0)

    def write(F: Array, before: Array, after: Array) -> list[Edit]:
        return frame_edits(reader.text, tuple(numbers), F, "rotation_vector", DIGITS, 1.0)

    return Written(0, start, write, T)


def _axes(reader: _Reader, numbers: Sequence[Number], start: int) -> Written:
    def write(axes: Array, before: Array, after: Array) -> list[Edit]:
        return [number_edit(reader.text, n, float(v), DIGITS[1]) for n, v in zip(numbers, axes, strict=False)]

    return Written(0, start, write, axes=np.array([n.value for n in numbers]))


def _unnamed(items: Sequence[Token]) -> Sequence[Token]:
    """An argument without its name (`pose = ...`)."""
    return items[2:] if len(items) > 2 and items[0].kind == "word" and items[1].kind == "=" else items


def _define(reader: _Reader, items: Sequence[Token]) -> None:
    """`global name = value` and `name[k] = value`."""
    while items and items[0].text in ("global", "local"):
        items = items[1:]
    if len(items) < 3 or items[0].kind != "word":
        return
    name = items[0]
    if items[1].kind == "[":
        closing = next((k for k, t in enumerate(items) if t.kind == "]"), 0)
        if closing and closing + 1 < len(items) and items[closing + 1].kind == "=":
            how = f"'{name.text}' is changed by parts, which cannot be corrected"
            reader.names.change(name.text, 0, name.start, how)
        return
    if items[1].kind != "=":
        return
    value = items[2:]
    if value[0].kind == "[" and value[-1].kind == "]":
        parts = split(value[1:-1], ",")
        if all(part and part[0].text in ("p", "[") for part in parts):  # a list of poses or of joint angles
            for k, part in enumerate(parts):
                reader.names.define(name.text, _expression(reader, part), str(k))
            return
    reader.names.define(name.text, _expression(reader, value))


def _follow(reader: _Reader, items: Sequence[Token]) -> None:
    """A statement in the order of the text."""
    head, blocks = items[0].text, reader.blocks
    if head in ("def", "thread", "sec") and len(items) > 1:
        blocks.routine(items[1].text)
        reader.open.append("routine")
    elif head in ("if", "while"):
        blocks.open("branch" if head == "if" else "loop")
        reader.open.append(head)
    elif head in ("elif", "else"):
        blocks.next_block(last=head == "else")
    elif head == "end":
        kind = reader.open.pop() if reader.open else ""
        if kind == "routine":
            blocks.end_routine()
        elif kind:
            blocks.close()
    elif head == "run" and len(items) > 1:
        blocks.add(Step("call", items[1].text))
    else:
        _calls(reader, items)


def _calls(reader: _Reader, items: Sequence[Token]) -> None:
    """Every function called in a statement."""
    for k, token in enumerate(items[:-1]):
        if token.kind != "word" or items[k + 1].kind != "(":
            continue
        stop, depth = k + 1, 0
        while stop < len(items):
            depth += (items[stop].kind in "([{") - (items[stop].kind in ")]}")
            stop += 1
            if depth == 0:
                break
        arguments = split(items[k + 2 : stop - 1], ",")
        if token.text in MOTIONS:
            _motion(reader, token, arguments)
        elif token.text in GUIDED:
            _move(
                reader, Opaque(0, token.start, f"{token.text} {GUIDED[token.text]}, which cannot be corrected"), token
            )
        elif token.text == "set_tcp" and arguments[0]:
            reader.blocks.add(Step("set", tool=_tool(reader, _unnamed(arguments[0]))))
        elif token.text in reader.functions:
            _handed_over(reader, token, arguments)
            reader.blocks.add(Step("call", token.text))
        elif k == 0 and token.text not in TAKE_POSES:  # a function of another file, whose answer nobody wants
            _handed_over(reader, token, [a for a in arguments if a and _is_pose(reader, a)])


def _move(reader: _Reader, target: Expression, token: Token) -> None:
    reader.blocks.add(Step("move", index=len(reader.moves)))
    reader.moves.append((target, token.start))


def _motion(reader: _Reader, token: Token, arguments: Sequence[Sequence[Token]]) -> None:
    count = MOTIONS[token.text]
    if len(arguments) < count or not all(arguments[:count]):
        _move(reader, Opaque(0, token.start, f"{token.text} has too few arguments to be read"), token)
        return
    for argument in arguments[:count]:
        _move(reader, _expression(reader, _unnamed(argument)), token)


def _tool(reader: _Reader, items: Sequence[Token]) -> FrameOf:
    try:
        return Stated.of(_constant_frame(reader, items))
    except Refusal as refusal:
        return Unclear(f"cannot be told: {refusal}")


def _is_pose(reader: _Reader, argument: Sequence[Token]) -> bool:
    """Whether an argument is a pose p[...], or the name of one."""
    argument = _unnamed(argument)
    named = reader.names.defined.get(argument[0].text, []) if len(argument) == 1 else []
    values = [v for _, v in named] or [_expression(reader, argument)]
    return any(isinstance(v, Later) or (isinstance(v, Written) and v.T is not None) for v in values)


def _handed_over(reader: _Reader, token: Token, arguments: Sequence[Sequence[Token]]) -> None:
    """Targets handed to a function go where this text does not tell."""
    for argument in arguments:
        value = _expression(reader, _unnamed(argument)) if argument else None
        known = isinstance(value, Ref) and any(
            isinstance(v, Written | Later) for _, v in reader.names.defined.get(value.name, [])
        )
        if known or isinstance(value, Written | Later):
            reason = f"a target is handed to '{token.text}', which moves there by another name"
            _move(reader, Opaque(0, token.start, reason), token)
            return
