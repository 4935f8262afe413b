"""ABB's RAPID: modules with robtargets and jointtargets.

Every motion names its tool and work object itself, so no state has to be followed. Read are the motions of
:data:`MOTIONS` (ABB, Technical reference manual, RAPID instructions, functions and data types), targets as aggregates,
by name or in arrays, and Offs and RelTool with constants, which are replaced by their corrected targets.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from robcal.programs.constants import Expression, Later, Names, Opaque, Ref, Use, checked_frame, program
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
    quarter,
)
from robcal.programs.text import MARK, Edit, Number, Source, Token, constant, mark, number_edit, split, tokens
from robcal.transforms import Array, frame, frame_from_xyzrpy

DIGITS = (4, 8)
"""Least decimals of mm and of quaternions."""
AXIS_DIGITS = 6
MOTIONS: Mapping[str, tuple[tuple[int, ...], int]] = {
    **dict.fromkeys(("MOVEJ", "MOVEL", "MOVEABSJ", "MOVELSYNC", "MOVEJSYNC", "MOVELDO", "MOVEJDO"), ((0,), 3)),
    **dict.fromkeys(("MOVELAO", "MOVEJAO", "MOVELGO", "MOVEJGO"), ((0,), 3)),
    **dict.fromkeys(("MOVEC", "MOVECSYNC", "MOVECDO", "MOVECAO", "MOVECGO"), ((0, 1), 4)),
    **dict.fromkeys(("TRIGGL", "TRIGGJ", "TRIGGABSJ"), ((0,), 4)),
    "TRIGGC": ((0, 1), 5),
    **dict.fromkeys(("SEARCHL",), ((2,), 4)),
    "SEARCHC": ((2, 3), 5),
    **dict.fromkeys(("ARCMOVEJ", "ARCMOVEL", "ARCMOVEABSJ"), ((0,), 3)),
    "ARCMOVEC": ((0, 1), 4),
    **dict.fromkeys(("ARCL", "ARCLSTART", "ARCLEND", "SPOTL", "SPOTJ", "PAINTL", "DISPL"), ((0,), -1)),
    **dict.fromkeys(("ARCC", "ARCCSTART", "ARCCEND", "PAINTC", "DISPC"), ((0, 1), -1)),
}
"""Instruction -> which of its arguments are targets, which one is the tool."""
DISPLACING = {
    **dict.fromkeys(("PDISPON", "PDISPSET"), "a program displacement moves all targets that follow"),
    **dict.fromkeys(("EOFFSON", "EOFFSSET"), "an offset of the external axes moves all targets that follow"),
    "CORRCON": "a path correction moves all targets that follow",
}
DATA = frozenset({"ROBTARGET", "JOINTTARGET", "TOOLDATA", "WOBJDATA"})
HARMLESS = ("CONST", "PERS", "VAR", "LOCAL", "TASK", "RETURN", "MOVEEXTJ", "TPWRITE")
"""What begins statements that bring no tool anywhere, whatever targets they name."""
FREE = 8.9e9
"""Values of external axes from here on mean that the axis is not in use (9E9)."""

Tree = Number | str | list["Tree"]


@dataclass
class _Reader:
    names: Names
    text: str
    uses: list[Use] = field(default_factory=list)
    frames: dict[str, list[FrameOf]] = field(default_factory=dict)


def read_rapid(source: Source) -> Program:
    """The program of a module.

    Raises
    ------
    Refusal : something cannot be corrected right; the message names the line.
    """
    reader = _Reader(Names((source,)), source.text)
    statements = _statements(source.text)
    for items in statements:
        _define(reader, items)
    for items in statements:
        _follow(reader, items)
    return program(reader.names, reader.uses, [_mark(source.text)])


def _mark(text: str) -> Edit:
    """The mark stands at the top, after the header of versions (%%% ... %%%) where there is one."""
    place = 3 if text.startswith("\xef\xbb\xbf") else 0
    if text[place:].lstrip().startswith("%%%"):
        end = text.find("%%%", text.index("%%%") + 3)
        newline = text.find("\n", end)
        place = newline + 1 if end > 0 and newline > 0 else place
    return mark(text, f"! {MARK}", place)


def _statements(text: str) -> list[list[Token]]:
    """Statements, which end with semicolons; heads of blocks (IF ... THEN) stay before what follows."""
    out: list[list[Token]] = [[]]
    for token in tokens(text, "!", '"', r"[A-Za-z_]\w*", (":=", "<>", "<=", ">=")):
        if token.kind == ";":
            out.append([])
        elif token.kind != "end":
            out[-1].append(token)
    return [s for s in out if s]


def _tree(items: Sequence[Token]) -> Tree | None:
    """Nested aggregates of constants; None if anything is not constant."""
    if items and items[0].kind == "[" and items[-1].kind == "]":
        parts = [_tree(part) for part in split(items[1:-1], ",")]
        return None if any(part is None for part in parts) else [p for p in parts if p is not None]
    if len(items) == 1 and items[0].kind in ("word", "string"):
        return items[0].text
    return constant(items)


def _is(tree: Tree | None, *lengths: int) -> bool:
    """Whether a tree is a list of lists of numbers of these lengths."""
    if not isinstance(tree, list) or len(tree) != len(lengths):
        return False
    return all(
        isinstance(part, list) and len(part) == n and all(isinstance(v, Number) for v in part)
        for part, n in zip(tree, lengths, strict=True)
    )


def _numbers(tree: Tree) -> list[Number]:
    return [v for v in tree if isinstance(v, Number)] if isinstance(tree, list) else []


def _values(tree: Tree) -> Array:
    return np.array([n.value for n in _numbers(tree)])


def _external(tree: Tree) -> tuple[float | None, ...]:
    return tuple(None if abs(n.value) >= FREE else 1e-3 * n.value for n in _numbers(tree))


def _pose(tree: Tree | None) -> Array | None:
    """Frame of a RAPID pose [[x, y, z], [q1, q2, q3, q4]]."""
    if not _is(tree, 3, 4) or not isinstance(tree, list) or np.linalg.norm(_values(tree[1])) < 0.5:
        return None
    return frame_of_numbers(np.concatenate([_values(tree[0]), _values(tree[1])]), "quaternion")


def _aggregate(reader: _Reader, items: Sequence[Token]) -> Expression:
    """A robtarget or jointtarget by its numbers."""
    tree, start = _tree(items), items[0].start
    if isinstance(tree, list) and _is(tree, 6, 6):
        numbers = _numbers(tree[0])

        def write_axes(axes: Array, before: Array, after: Array) -> list[Edit]:
            pairs = zip(numbers, np.rad2deg(axes), strict=False)
            return [number_edit(reader.text, n, float(v), AXIS_DIGITS) for n, v in pairs]

        return Written(0, start, write_axes, axes=np.deg2rad(_values(tree[0])), external=_external(tree[1]))
    if isinstance(tree, list) and _is(tree, 3, 4, 4, 6):
        T = _pose(tree[:2])
        if T is None:
            return Opaque(0, start, "the orientation is no quaternion of length 1")
        place = (*_numbers(tree[0]), *_numbers(tree[1]))
        configuration = _numbers(tree[2])

        def write_frame(T: Array, before: Array, after: Array) -> list[Edit]:
            edits = frame_edits(reader.text, place, T, "quaternion", DIGITS)
            values = _quarters(configuration, before, after)
            pairs = zip(configuration, values, strict=True)
            return edits + [Edit(n.start, n.stop, str(v)) for n, v in pairs if v != int(n.value)]

        quarters = {axis: int(configuration[k].value) for k, axis in enumerate((0, 3, 5))}
        return Written(0, start, write_frame, T, external=_external(tree[3]), hint=Hint(quarters=quarters))
    return Opaque(0, start, "the target is not made of numbers alone (or not of as many as a target has)")


def _quarters(configuration: Sequence[Number], before: Array, after: Array) -> list[int]:
    """confdata (cf1, cf4, cf6, cfx) where the correction takes axis 1, 4 or 6 into another quarter."""
    values = [int(n.value) for n in configuration]
    for k, axis in enumerate((0, 3, 5)):
        if axis < len(after):
            values[k] += quarter(after[axis]) - quarter(before[axis])
    return values


def _target(reader: _Reader, items: Sequence[Token]) -> Expression:
    """A target of a motion, or the value of an assignment."""
    head = items[0]
    if head.kind == "[":
        return _aggregate(reader, items)
    if head.kind != "word":
        return Opaque(0, head.start, f"the target '{head.text}' is not in the text: save the module with its numbers")
    if len(items) == 1:
        return Ref(head.text, 0, head.start)
    if items[1].kind == "{" and items[-1].kind == "}":
        inside = items[2:-1]
        fixed = len(inside) == 1 and inside[0].kind == "number"
        return Ref(head.text, 0, head.start, inside[0].text if fixed else None)
    if items[1].kind == "(" and head.upper in ("OFFS", "RELTOOL") and items[-1].kind == ")":
        return Later(lambda: _offset(reader, head, items))
    how = "a function finds the target" if items[1].kind == "(" else "the target is computed"
    return Opaque(0, head.start, f"{how} when the program runs, '{head.text}'")


def _offset(reader: _Reader, head: Token, items: Sequence[Token]) -> Written:
    """Offs(p, x, y, z) in the work object, RelTool(p, x, y, z \\Rx \\Ry \\Rz) in the tool, of constants."""
    names = reader.names
    arguments = [_options(part) for part in split(items[2:-1], ",")]
    moves = [constant(part) for part, _ in arguments[1:4]]
    turns = {name: constant(value) for _, options in arguments for name, value in options.items()}
    if len(moves) != 3 or any(m is None for m in moves) or any(t is None for t in turns.values()):
        raise names.refuse(0, head.start, f"{head.text} shifts by variables, which cannot be corrected")
    shift = 1e-3 * np.array([m.value for m in moves if m is not None])
    point = names.single(_target(reader, arguments[0][0]))
    T = checked_frame(point, names)
    if head.upper == "OFFS":
        T = T.copy()
        T[:3, 3] += shift
    else:
        T = T @ frame(np.eye(3), shift)
        for k, axis in enumerate(("RX", "RY", "RZ")):
            angle = np.zeros(6)
            found = turns.get(axis)
            angle[3 + k] = np.deg2rad(found.value) if found is not None else 0.0
            T = T @ frame_from_xyzrpy(angle)
    rest = _rest_of(reader, point)

    def write(F: Array, before: Array, after: Array) -> list[Edit]:
        values = numbers_of_frame(F, numbers_of_frame(T, np.zeros(7), "quaternion"), "quaternion")
        place = ",".join(f"{v + 0.0:.{DIGITS[0]}f}" for v in values[:3])
        turn = ",".join(f"{v + 0.0:.{DIGITS[1]}f}" for v in values[3:])
        return [Edit(head.start, items[-1].stop, f"[[{place}],[{turn}],{rest}]")]

    return Written(0, head.start, write, T, external=point.external)


def _rest_of(reader: _Reader, point: Written) -> str:
    """Configuration and external axes of a target as they stand in the text."""
    if reader.text[point.start] != "[":
        raise reader.names.refuse(0, point.start, "an offset from an offset: write it as one")
    depth, inside = 0, []
    for token in tokens(reader.text[point.start :], "!", '"', r"[A-Za-z_]\w*", (":=",)):
        depth += (token.kind in "([{") - (token.kind in ")]}")
        if depth == 0:  # the bracket that closes the target: what follows is not looked at
            break
        if token.start > 0 and token.kind != "end":
            inside.append(token)
    parts = split(inside, ",")[2:]
    return ",".join(reader.text[point.start + p[0].start : point.start + p[-1].stop] for p in parts)


def _options(items: Sequence[Token]) -> tuple[list[Token], dict[str, list[Token]]]:
    """An argument without its optional ones (\\Name or \\Name:=value), and these."""
    depth, place = 0, len(items)
    for k, token in enumerate(items):
        depth += (token.kind in "([{") - (token.kind in ")]}")
        if token.kind == "\\" and depth == 0:
            place = k
            break
    options: dict[str, list[Token]] = {}
    for part in split(items[place:], "\\"):
        if part and part[0].kind == "word":
            options[part[0].upper] = list(part[2:]) if len(part) > 1 and part[1].kind == ":=" else []
    return list(items[:place]), options


def _define(reader: _Reader, items: Sequence[Token]) -> None:
    """A declaration of data, or an assignment."""
    equals = _equals(items)
    for k, token in enumerate(items[:equals]):
        if token.upper in DATA and k + 1 < len(items) and items[k + 1].kind == "word":
            _declare(reader, token.upper, items[k + 1 :])
            return
    if equals == len(items):
        return
    start = equals - 1
    index = None
    if start > 0 and items[start].kind == "}":
        inside = items[_opening(items, start) + 1 : start]
        index = inside[0].text if len(inside) == 1 and inside[0].kind == "number" else None
        start = _opening(items, start) - 1
    part = False
    while start >= 2 and items[start - 1].kind == ".":
        part, start = True, start - 2
        if items[start].kind == "}":
            start = _opening(items, start) - 1
    name = items[max(start, 0)]
    if part:
        reader.names.change(name.text, 0, name.start, f"'{name.text}' is changed by parts, which cannot be corrected")
    else:
        reader.names.define(name.text, _target(reader, items[equals + 1 :]), index)
    reader.frames.setdefault(name.upper, []).append(Unclear(f"'{name.text}' is changed while the program runs"))


def _equals(items: Sequence[Token]) -> int:
    """Place of the := of an assignment (not of an optional argument); the length if there is none."""
    depth = 0
    for k, token in enumerate(items):
        depth += (token.kind in "([") - (token.kind in ")]")
        if token.kind == ":=" and depth == 0 and not (k >= 2 and items[k - 2].kind == "\\"):
            return k
    return len(items)


def _opening(items: Sequence[Token], closing: int) -> int:
    k = closing
    while k > 0 and items[k].kind != "{":
        k -= 1
    return k


def _declare(reader: _Reader, kind: str, items: Sequence[Token]) -> None:
    """`name{n} := value` after the type."""
    name, equals = items[0], _equals(items)
    value = items[equals + 1 :]
    if not value:
        return
    if kind in ("TOOLDATA", "WOBJDATA"):
        reader.frames.setdefault(name.upper, []).append(_data_frame(kind, _tree(value)))
    elif items[1].kind == "{" and value[0].kind == "[":
        for k, part in enumerate(split(value[1:-1], ",")):
            reader.names.define(name.text, _target(reader, part), str(k + 1))
    else:
        reader.names.define(name.text, _target(reader, value))


def _data_frame(kind: str, tree: Tree | None) -> FrameOf:
    """Frame of tooldata [robhold, tframe, tload] or wobjdata [robhold, ufprog, ufmec, uframe, oframe]."""
    if not isinstance(tree, list) or len(tree) < (3 if kind == "TOOLDATA" else 5):
        return Unclear("is not made of numbers alone")
    held = str(tree[0]).upper() == "TRUE"
    if kind == "TOOLDATA":
        T = _pose(tree[1])
        if not held:
            return Unclear("is fixed and the robot holds the work piece (robhold FALSE)")
        return Stated.of(T) if T is not None else Unclear("has no quaternion of length 1")
    user, of_object = _pose(tree[3]), _pose(tree[4])
    if held or str(tree[1]).upper() != "TRUE":
        return Unclear("is held by the robot or moved by a mechanical unit (robhold, ufprog)")
    if user is None or of_object is None:
        return Unclear("has no quaternion of length 1")
    return Stated.of(user @ of_object)


def _frame(reader: _Reader, items: Sequence[Token], own: str) -> FrameOf:
    """Tool or work object of a motion."""
    if len(items) != 1 or items[0].kind != "word":
        return Unclear("is found when the program runs")
    if items[0].upper == own:
        return IDENTITY
    found = reader.frames.get(items[0].upper, [])
    if not found:
        return Named(items[0].text)
    return found[0] if len(found) == 1 else found[1]


def _follow(reader: _Reader, items: Sequence[Token]) -> None:
    """Motions, and what displaces or takes over targets."""
    for k, token in enumerate(items):
        if token.kind != "word":
            continue
        before = items[k - 1].kind if k else ""
        if before in ("\\", ".", ":=", "(", ","):
            continue
        if token.upper in MOTIONS:
            _motion(reader, token, items[k + 1 :])
            return
        if token.upper in DISPLACING:
            _refuse(reader, token, f"{DISPLACING[token.upper]} ({token.text}): this cannot be corrected")
            return
    _handed_over(reader, items)


def _refuse(reader: _Reader, token: Token, reason: str) -> None:
    reader.uses.append(Use(Opaque(0, token.start, reason), IDENTITY, IDENTITY, 0, token.start))


def _motion(reader: _Reader, head: Token, items: Sequence[Token]) -> None:
    pairs = [_options(part) for part in split(items, ",")]
    options = {name: value for _, found in pairs for name, value in found.items()}
    arguments = [argument for argument, _ in pairs if argument]
    targets, tool_at = MOTIONS[head.upper]
    if len(arguments) <= max(*targets, tool_at):
        _refuse(reader, head, f"{head.text} has too few arguments to be read")
        return
    if "CORR" in options:
        _refuse(reader, head, f"a path correction moves the targets of {head.text} \\Corr: this cannot be corrected")
        return
    tool = _frame(reader, arguments[tool_at], "TOOL0")
    base = _frame(reader, options["WOBJ"], "WOBJ0") if "WOBJ" in options else IDENTITY
    for k in targets:
        reader.uses.append(Use(_target(reader, arguments[k]), tool, base, 0, head.start))
    if head.upper in ("SEARCHL", "SEARCHC"):
        found = arguments[1][0]
        reader.names.change(found.text, 0, found.start, f"'{found.text}' is found by a search while the program runs")


def _balanced(items: Sequence[Token]) -> bool:
    return sum((t.kind in "([{") - (t.kind in ")]}") for t in items) == 0


def _handed_over(reader: _Reader, items: Sequence[Token]) -> None:
    """Targets that are handed to a routine go where this text does not tell."""
    if _equals(items) < len(items) or len(items) < 2:
        return
    if any(t.upper in HARMLESS for t in items if t.kind == "word"):
        return
    for k, token in enumerate(items[1:], 1):
        if token.kind == "[" and items[k - 1].kind in ("word", ",", "("):
            stop = next((j for j in range(k + 1, len(items) + 1) if _balanced(items[k:j])), k + 1)
            if isinstance(_aggregate(reader, items[k:stop]), Written):
                _refuse(reader, token, f"a target is handed to '{items[k - 1].text}' or the like, which may move there")
                return
        values = [v for _, v in reader.names.defined.get(token.upper, [])] if token.kind == "word" else []
        alone = items[k - 1].kind in ("word", ",") and (k + 1 == len(items) or items[k + 1].kind in (",", "{", "\\"))
        if alone and any(isinstance(v, Written | Later) for v in values):
            _refuse(reader, token, f"the target '{token.text}' is handed to '{items[k - 1].text}' or the like, which "
                    "may move there")  # fmt: skip
            return
