"""KUKA's robot language: programs of a `.src` with its `.dat`.

Read are motions (PTP, LIN, CIRC, SPTP, SLIN, SCIRC, SPL, alone or in spline blocks), positions (POS, E6POS, FRAME, AXIS
and E6AXIS) as aggregates or by name, shifts of constants by the geometric operator, and what sets tool and base: $TOOL
and $BASE, BAS(#TOOL, n), FDAT_ACT of inline forms, WITH of splines (KUKA System Software 8, expert programming; KRL
reference). Frames by number that the program does not state are left open.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass, field

from robcal.programs.constants import Expression, Later, Names, Opaque, Use, checked_frame, program
from robcal.programs.flow import Active, Blocks, Flow, Step
from robcal.programs.krl_positions import PLACES, Aggregate, aggregate, expression, frame_of, length
from robcal.programs.targets import IDENTITY, FrameOf, Named, Program, Stated, Unclear, Written
from robcal.programs.text import MARK, Edit, Refusal, Source, Token, mark, tokens

POSITIONS = frozenset({"POS", "E6POS", "FRAME", "AXIS", "E6AXIS"})
MOTIONS = frozenset({"PTP", "LIN", "CIRC", "SPTP", "SLIN", "SCIRC", "SPL"})
RELATIVE = frozenset({"PTP_REL", "LIN_REL", "CIRC_REL", "SPTP_REL", "SLIN_REL", "SCIRC_REL", "SPL_REL"})
OWN_FRAMES = frozenset({"$NULLFRAME", "$WORLD", "$ROBROOT"})
BEFORE_NAMES = frozenset({"DECL", "GLOBAL", "CONST", "PUBLIC"})
ACTIVE = Named("active")


@dataclass
class _Reader:
    names: Names
    blocks: Blocks = field(default_factory=Blocks)
    moves: list[tuple[Expression, dict[str, FrameOf], int]] = field(default_factory=list)
    fdat: dict[str, Aggregate] = field(default_factory=dict)
    data: dict[str, FrameOf] = field(default_factory=dict)
    spline: dict[str, FrameOf] = field(default_factory=dict)


def read_krl(src: Source, dat: Source | None = None) -> Program:
    """The program of a `.src` and the `.dat` that belongs to it.

    Raises
    ------
    Refusal : something cannot be corrected right; the message names the line.
    """
    sources = (src,) if dat is None else (src, dat)
    reader = _Reader(Names(sources))
    statements = [(k, s) for k in range(len(sources))[::-1] for s in _statements(sources[k])]
    for k, statement in statements:
        _define(reader, k, statement)
    for k, statement in statements:
        if k == 0:
            _follow(reader, statement)
    flow = Flow({n: tuple(s) for n, s in reader.blocks.routines.items()}, Active(ACTIVE, ACTIVE))
    at = flow.walk(reader.blocks.entries())
    uses = []
    for index, (target, own, place) in enumerate(reader.moves):
        state = at.get(index, flow.start)
        if state.outer and "outer" not in own:
            target = Opaque(0, place, state.outer)
        uses.append(Use(target, own.get("tool", state.tool), own.get("base", state.base), 0, place))
    return program(reader.names, uses, [_mark(s) for s in sources])


def _mark(source: Source) -> Edit:
    """The mark stands after the header lines (&ACCESS ...), which have to come first."""
    header = re.match(r"(?:\xef\xbb\xbf)?(?:[ \t]*&[^\n]*\n)*", source.text)
    return mark(source.text, f"; {MARK}", header.end() if header else 0)


def _statements(source: Source) -> list[list[Token]]:
    """Statements of a file, one a line; a line that ends with a comma or inside brackets goes on in the next."""
    out: list[list[Token]] = [[]]
    depth = 0
    for token in tokens(source.text, ";", "\"'", r"[#$]?[A-Za-z_][\w$]*", ("==", "<>", "<=", ">=")):
        if token.kind == "end":
            if depth <= 0 and not (out[-1] and out[-1][-1].kind == ","):
                out.append([])
                depth = 0
            continue
        depth += (token.kind in "([{") - (token.kind in ")]}")
        out[-1].append(token)
    return [s for s in out if s and s[0].kind != "&"]


def _define(reader: _Reader, k: int, items: Sequence[Token]) -> None:
    """Declarations with values, and assignments."""
    at = 0
    while at < len(items) and items[at].upper in BEFORE_NAMES:
        at += 1
    if at + 1 < len(items) and items[at].kind == "word" and items[at + 1].kind == "word":
        kind, at = items[at].upper, at + 1
        if kind not in POSITIONS and kind != "FDAT":
            return
        while at < len(items):
            at = _define_one(reader, k, items, at) + 1
    elif at + 1 < len(items) and items[at].kind == "word" and items[at].upper not in MOTIONS:
        _define_one(reader, k, items, at)


def _define_one(reader: _Reader, k: int, items: Sequence[Token], at: int) -> int:
    """One `name[index].part = value`; returns the place of the token after it."""
    name, after = items[at], at + 1
    index = None
    if after < len(items) and items[after].kind == "[":
        span = length(items, after)
        inside = items[after + 1 : after + span - 1]
        index = inside[0].text if len(inside) == 1 and inside[0].kind == "number" else None
        after += span
    part = after < len(items) and items[after].kind == "."
    while after + 1 < len(items) and items[after].kind == ".":
        after += 2
    if after + 1 >= len(items) or items[after].kind != "=":
        return after
    after += 1
    key = name.upper
    data = aggregate(items, after) if items[after].kind == "{" else None
    if data is not None and {"TOOL_NO", "BASE_NO"} & set(data.numbers):
        reader.fdat[key] = data
        return after + length(items, after)
    if part:
        reader.names.change(key, k, name.start, f"'{name.text}' is changed by parts, which cannot be corrected")
        return len(items)
    value, after = expression(reader.names, k, items, after)
    if after < len(items) and items[after].kind != ",":
        value = Opaque(k, name.start, f"'{name.text}' is computed when the program runs")
    if key in ("TOOL_DATA", "BASE_DATA") and index is not None:
        reader.data[f"{key}[{index}]"] = _stated(
            reader, value, "is set more than once" if f"{key}[{index}]" in reader.data else ""
        )
    reader.names.define(key, value, index)
    return after


def _stated(reader: _Reader, value: Expression, unclear: str = "") -> FrameOf:
    """A tool or base from an expression of the program."""
    if unclear:
        return Unclear(unclear)
    try:
        return Stated.of(checked_frame(reader.names.single(value), reader.names))
    except Refusal as refusal:
        return Unclear(f"cannot be told: {refusal}")


def _numbered(reader: _Reader, what: str, number: float) -> FrameOf:
    """Tool or base by number: as the program states it, the null frame for 0, else by name only."""
    if int(number) == 0:
        return IDENTITY
    return reader.data.get(f"{what}_DATA[{int(number)}]", Named(str(int(number))))


def _of_fdat(reader: _Reader, name: str) -> dict[str, FrameOf]:
    """Tool and base of a motion's frame data; interpolation with a fixed tool has no base in the robot's."""
    data = reader.fdat.get(name.upper())
    if data is None:
        return {
            what: Unclear(f"is that of '{name}', whose numbers are not in this program") for what in ("tool", "base")
        }
    found: dict[str, FrameOf] = {}
    for what, key in (("tool", "TOOL_NO"), ("base", "BASE_NO")):
        if key in data.numbers:
            found[what] = _numbered(reader, what.upper(), data.numbers[key].value)
    if data.words.get("IPO_FRAME", "").upper() == "#TCP":
        found["tool"] = Unclear("is fixed and the robot holds the work piece (IPO_FRAME #TCP)")
    return found


def _frame_value(reader: _Reader, items: Sequence[Token], what: str) -> FrameOf:
    """What a program assigns to $TOOL or $BASE."""
    head = items[0] if items else None
    if head is None:
        return Unclear("cannot be read")
    if head.upper in OWN_FRAMES and len(items) == 1:
        return IDENTITY
    inner = [t for t in items[1:] if t.kind in ("word", "number")]
    if head.upper == f"{what}_DATA" and len(items) > 1 and items[1].kind == "[":
        if len(inner) == 1 and inner[0].kind == "number":
            return _numbered(reader, what, float(inner[0].text))
        if (
            len(inner) >= 2
            and inner[0].upper in reader.fdat
            and what.lower() in (of := _of_fdat(reader, inner[0].text))
        ):
            return of[what.lower()]
        return Unclear("has a number that is found when the program runs")
    if head.upper in ("STOOL", "STOOL2", "SBASE", "SBASE2") and inner:
        if inner[0].kind == "number":
            return _numbered(reader, what, float(inner[0].text))
        return _of_fdat(reader, inner[0].text).get(what.lower(), Unclear("cannot be read"))
    if head.upper == "EK":
        return Unclear("is coupled to an external kinematic")
    if head.kind == "{":
        found = aggregate(items, 0)
        if found is None or not all(n in found.numbers for n in PLACES):
            return Unclear("is stated in part only: write X, Y, Z, A, B, C out")
        if len(items) == length(items, 0):
            return Stated.of(frame_of(found))
    value, after = expression(reader.names, 0, items, 0)
    return _stated(reader, value, "" if after >= len(items) else "is computed when the program runs")


def _with(reader: _Reader, items: Sequence[Token]) -> dict[str, FrameOf]:
    """Tool and base of `WITH $TOOL = ..., $BASE = ...`."""
    found: dict[str, FrameOf] = {}
    for k, token in enumerate(items):
        if token.upper in ("$TOOL", "$BASE") and k + 1 < len(items) and items[k + 1].kind == "=":
            stop, depth = k + 2, 0
            while stop < len(items) and not (depth == 0 and items[stop].kind == ","):
                depth += (items[stop].kind in "([{") - (items[stop].kind in ")]}")
                stop += 1
            found[token.text[1:].lower()] = _frame_value(reader, items[k + 2 : stop], token.upper[1:])
        if token.upper == "$IPO_MODE" and k + 2 < len(items) and items[k + 2].upper == "#TCP":
            found["tool"] = Unclear("is fixed and the robot holds the work piece ($IPO_MODE #TCP)")
    return found


_OPEN = {"IF": "branch", "SWITCH": "branch", "FOR": "loop", "WHILE": "loop", "LOOP": "loop", "REPEAT": "loop"}
_CLOSE = frozenset({"ENDIF", "ENDSWITCH", "ENDFOR", "ENDWHILE", "ENDLOOP", "UNTIL"})


def _follow(reader: _Reader, items: Sequence[Token]) -> None:
    """A statement of the `.src` in the order of the text."""
    head, blocks = items[0].upper, reader.blocks
    if head == "GLOBAL" and len(items) > 1 and items[1].upper in ("DEF", "DEFFCT"):
        items, head = items[1:], items[1].upper
    if head in ("DEF", "DEFFCT"):
        name = items[1 if head == "DEF" else min(2, len(items) - 1)].upper if len(items) > 1 else ""
        blocks.routine(name)
    elif head in ("END", "ENDFCT"):
        blocks.end_routine()
    elif head in _OPEN:
        blocks.open(_OPEN[head])
    elif head in ("ELSE", "CASE", "DEFAULT"):
        blocks.next_block(last=head != "CASE")
    elif head in _CLOSE:
        blocks.close()
    elif head == "GOTO" and len(items) > 1:
        blocks.add(Step("jump", items[1].upper))
    elif len(items) == 2 and items[1].kind == ":":
        blocks.add(Step("label", head))
    elif head in ("SPLINE", "PTP_SPLINE"):
        reader.spline = _with(reader, items)
    elif head == "ENDSPLINE":
        reader.spline = {}
    elif head in RELATIVE:
        reason = f"{head} moves relative to where the robot happens to be and cannot be corrected"
        _add_move(reader, Opaque(0, items[0].start, reason), {}, items[0].start)
    elif head in MOTIONS and len(items) > 1:
        _motion(reader, items)
    else:
        _other(reader, items)


def _add_move(reader: _Reader, target: Expression, own: dict[str, FrameOf], place: int) -> None:
    reader.blocks.add(Step("move", index=len(reader.moves)))
    reader.moves.append((target, {**reader.spline, **own}, place))


def _motion(reader: _Reader, items: Sequence[Token]) -> None:
    """PTP, LIN, SPL target; CIRC auxiliary point, end point."""
    own, place = _with(reader, items), items[0].start
    target, after = expression(reader.names, 0, items, 1)
    _add_move(reader, target, own, place)
    if items[0].upper not in ("CIRC", "SCIRC"):
        return
    if after >= len(items) or items[after].kind != ",":
        _add_move(reader, Opaque(0, place, "a circle needs an auxiliary and an end point"), own, place)
        return
    target, after = expression(reader.names, 0, items, after + 1)
    _add_move(reader, target, own, place)
    if any(t.upper == "CA" for t in items[after:]):
        reason = "a circle that ends by its angle (CA) ends at no target of the program and cannot be corrected"
        _add_move(reader, Opaque(0, place, reason), own, place)


def _other(reader: _Reader, items: Sequence[Token]) -> None:
    """Assignments of tool and base, calls, and all that does not matter here."""
    head, blocks = items[0], reader.blocks
    second = items[1].kind if len(items) > 1 else ""
    if head.upper in ("$TOOL", "$BASE"):
        what = head.upper[1:]
        frame: FrameOf = Unclear("is changed by parts")
        if second == "=":
            frame = _frame_value(reader, items[2:], what)
        blocks.add(Step("set", tool=frame) if what == "TOOL" else Step("set", base=frame))
    elif head.upper == "$IPO_MODE" and len(items) > 2:
        fixed = items[2].upper != "#BASE"
        reason = "the tool is fixed and the robot holds the work piece ($IPO_MODE): this cannot be corrected"
        blocks.add(Step("set", outer=reason if fixed else ""))
    elif head.upper == "FDAT_ACT" and second == "=":
        found = aggregate(items, 2) if items[2].kind == "{" else None
        if found is not None:
            reader.fdat["{}"] = found
        of = _of_fdat(reader, "{}" if found is not None else items[2].text)
        blocks.add(Step("set", tool=of.get("tool"), base=of.get("base")))
    elif head.upper == "BAS" and second == "(" and len(items) > 2:
        _bas(reader, items)
    elif second == "(" and head.kind == "word":
        _call(reader, items)
    else:
        for k in range(1, len(items) - 1):  # TRIGGER ... DO routine(), INTERRUPT DECL ... DO routine()
            if items[k - 1].upper == "DO" and items[k + 1].kind == "(":
                blocks.add(Step("call", items[k].upper))


def _bas(reader: _Reader, items: Sequence[Token]) -> None:
    what, number = items[2].upper, next((t for t in items[3:] if t.kind in ("number", "word")), None)
    if what not in ("#TOOL", "#BASE", "#EX_BASE"):
        return
    frame: FrameOf = Unclear("has a number that is found when the program runs")
    if what == "#EX_BASE":
        frame = Unclear("is coupled to an external kinematic")
    elif number is not None and number.kind == "number":
        frame = _numbered(reader, what[1:], float(number.text))
    reader.blocks.add(Step("set", tool=frame) if what == "#TOOL" else Step("set", base=frame))


def _call(reader: _Reader, items: Sequence[Token]) -> None:
    """A routine; positions handed to it go where this text does not tell."""
    reader.blocks.add(Step("call", items[0].upper))
    names = reader.names
    for k, token in enumerate(items[2:], 2):
        values = [v for _, v in names.defined.get(token.upper, [])] if token.kind == "word" else []
        is_position = any(isinstance(v, Written | Later) for v in values) and items[k - 1].kind in ("(", ",")
        whole = k + 1 < len(items) and items[k + 1].kind in (",", ")", "[")
        if (is_position and whole) or token.kind == "{":
            reason = f"a position is handed to '{items[0].text}', which may move there or change it"
            _add_move(reader, Opaque(0, token.start, reason), {}, token.start)
            return
