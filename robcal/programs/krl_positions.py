"""Positions in KUKA's robot language: aggregates, names, products by the geometric operator."""

import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from robcal.programs.constants import Current, Expression, Later, Names, Opaque, Ref, checked_frame
from robcal.programs.targets import Hint, Written, frame_edits, frame_of_numbers, numbers_of_frame
from robcal.programs.text import Edit, Number, Refusal, Token, number_edit
from robcal.transforms import Array

DIGITS = (4, 6)
"""Least decimals of mm and deg."""
PLACES = ("X", "Y", "Z", "A", "B", "C")
AXES = tuple(f"A{k}" for k in range(1, 7))
EXTERNAL = tuple(f"E{k}" for k in range(1, 7))
PRESENT = frozenset({"$AXIS_ACT", "$AXIS_ACT_MEAS", "$AXIS_INT", "$AXIS_RET", "$POS_ACT", "$POS_ACT_MES", "$POS_RET"})


@dataclass(frozen=True)
class Aggregate:
    """`{TYPE: name value, ...}` with its numbers and other words by name."""

    start: int
    stop: int
    numbers: dict[str, Number]
    words: dict[str, str]


def aggregate(items: Sequence[Token], at: int) -> Aggregate | None:
    """The aggregate whose bracket opens at a token; None if it holds more than constants."""
    numbers: dict[str, Number] = {}
    words: dict[str, str] = {}
    k = at + 1
    if k + 1 < len(items) and items[k].kind == "word" and items[k + 1].kind == ":":
        k += 2
    while k < len(items) and items[k].kind != "}":
        if items[k].kind == ",":
            k += 1
            continue
        name, k = items[k].upper, k + 1
        if k < len(items) and items[k].kind == "[":  # a string: POINT2[] " "
            while k < len(items) and items[k].kind != "]":
                k += 1
            k += 1
        sign = -1.0 if k < len(items) and items[k].kind == "-" else 1.0
        start = items[k].start if k < len(items) else 0
        k += k < len(items) and items[k].kind in "+-"
        if k >= len(items):
            return None
        value = items[k]
        if value.kind == "number":
            numbers[name] = Number(start, value.stop, sign * float(value.text))
        elif value.kind in ("word", "string"):
            words[name] = value.text
        else:
            return None
        k += 1
    if k >= len(items):
        return None
    return Aggregate(items[at].start, items[k].stop, numbers, words)


def length(items: Sequence[Token], at: int) -> int:
    """How many tokens the bracket that opens at a token spans."""
    depth = 0
    for k in range(at, len(items)):
        depth += (items[k].kind in "([{") - (items[k].kind in ")]}")
        if depth == 0:
            return k - at + 1
    return len(items) - at


def _operand(names: Names, k: int, items: Sequence[Token], at: int) -> tuple[Expression | Aggregate, int]:
    """What stands at a token, and the place of the token after it."""
    head = items[at]
    if head.kind == "{":
        found = aggregate(items, at)
        after = at + length(items, at)
        if found is None:
            return Opaque(k, head.start, "the position is not made of numbers alone"), after
        return found, after
    if head.kind != "word":
        return Opaque(k, head.start, "the target cannot be read"), at + 1
    if head.upper in PRESENT:
        return Current(), at + 1
    after = at + 1
    index = None
    if after < len(items) and items[after].kind == "[":
        span = length(items, after)
        inside = items[after + 1 : after + span - 1]
        index = inside[0].text if len(inside) == 1 and inside[0].kind == "number" else None
        after += span
    if after < len(items) and items[after].kind in ("(", "."):
        what = "a function finds the target" if items[after].kind == "(" else "the target is a part of a variable"
        return Opaque(k, head.start, f"{what} when the program runs, '{head.text}'"), len(items)
    return Ref(head.text, k, head.start, index), after


def expression(names: Names, k: int, items: Sequence[Token], at: int) -> tuple[Expression, int]:
    """A target: one operand, or several with the geometric operator between them."""
    parts: list[Expression | Aggregate] = []
    start = items[at].start
    while at < len(items):
        part, at = _operand(names, k, items, at)
        parts.append(part)
        if at >= len(items) or items[at].kind != ":":
            break
        at += 1
    if len(parts) == 1:
        only = parts[0]
        return (_literal(names, k, only) if isinstance(only, Aggregate) else only), at
    stop = items[at - 1].stop
    return Later(lambda: _shifted(names, k, parts, start, stop)), at


def _shifted(names: Names, k: int, parts: Sequence[Expression | Aggregate], start: int, stop: int) -> Written:
    """A product of constant frames, to be replaced by its corrected numbers (of the type FRAME, as the product is)."""
    T = np.eye(4)
    for part in parts:
        if isinstance(part, Current):
            raise names.refuse(k, start, "a move relative to where the robot happens to be cannot be corrected")
        if isinstance(part, Aggregate):
            if set(part.numbers) - {*PLACES, *EXTERNAL, "S", "T"} or not part.numbers:
                raise names.refuse(k, part.start, "a shift has to be a frame of numbers to be corrected")
            T = T @ frame_of(part)
        else:
            try:
                T = T @ checked_frame(names.single(part), names)
            except Refusal as refusal:
                raise Refusal(f"{refusal} (a shift by or of it in line {names.sources[k].line(start)})") from None

    def write(frame: Array, before: Array, after: Array) -> list[Edit]:
        numbers = numbers_of_frame(frame, numbers_of_frame(T, np.zeros(6), "abc"), "abc")
        pairs = zip(PLACES, numbers, strict=True)
        words = [f"{n} {v + 0.0:.{DIGITS[0 if i < 3 else 1]}f}" for i, (n, v) in enumerate(pairs)]
        return [Edit(start, stop, "{" + ", ".join(words) + "}")]

    return Written(k, start, write, T)


def frame_of(found: Aggregate) -> Array:
    values = [found.numbers[n].value if n in found.numbers else 0.0 for n in PLACES]
    return frame_of_numbers(np.array(values), "abc")


def _literal(names: Names, k: int, found: Aggregate) -> Expression:
    """A position given by its numbers."""
    text = names.sources[k].text
    numbers = found.numbers
    external = tuple(1e-3 * numbers[n].value if n in numbers else None for n in EXTERNAL)
    if all(n in numbers for n in AXES):
        fields = [numbers[n] for n in AXES]

        def write_axes(axes: Array, before: Array, after: Array) -> list[Edit]:
            pairs = zip(fields, np.rad2deg(axes), strict=False)
            return [number_edit(text, n, float(v), DIGITS[1]) for n, v in pairs]

        axes = np.deg2rad([n.value for n in fields])
        return Written(k, found.start, write_axes, axes=axes, external=external)
    if all(n in numbers for n in PLACES):
        fields = [numbers[n] for n in PLACES]
        bits = {n: _bits(found, n) for n in "ST"}
        turn = bits["T"]

        def write_frame(T: Array, before: Array, after: Array) -> list[Edit]:
            edits = frame_edits(text, tuple(fields), T, "abc", DIGITS)
            return edits + _status_edits(text, found, bits, before, after)

        hint = Hint(negative=None if turn is None else tuple(bool(turn >> i & 1) for i in range(6)))
        return Written(k, found.start, write_frame, frame_of(found), external=external, hint=hint)
    given = [n for n in (*PLACES, *AXES) if n in numbers]
    if not given:
        return Opaque(k, found.start, "the target gives external axes alone")
    return Opaque(
        k, found.start, f"the target gives {', '.join(given)} alone, the rest is where the robot happens to be"
    )


def _bits(found: Aggregate, name: str) -> int | None:
    if name in found.numbers:
        return int(found.numbers[name].value)
    binary = re.fullmatch(r"'B([01]+)'", found.words.get(name, ""), re.IGNORECASE)
    return int(binary[1], 2) if binary else None


def _status_edits(text: str, found: Aggregate, bits: dict[str, int | None], before: Array, after: Array) -> list[Edit]:
    """S and T where the correction takes an axis over zero: T has a bit for each negative axis, bit 2 of S for A5."""
    edits = []
    for name, old in bits.items():
        if old is None:
            continue
        new = old
        for axis, bit in enumerate(range(min(6, len(after)))) if name == "T" else [(4, 2)]:
            if axis < len(after) and (before[axis] < 0) != (after[axis] < 0) and abs(after[axis]) > 1e-9:
                is_negative, was = after[axis] < 0, bool(old >> bit & 1)
                flips = was != is_negative if name == "T" else True
                new ^= (1 << bit) if flips else 0
        if new != old:
            number = found.numbers.get(name)
            if number is not None:
                edits.append(Edit(number.start, number.stop, str(new)))
            else:
                written = found.words[name]
                start = text.index(written, found.start)
                edits.append(Edit(start, start + len(written), f"'{written[1]}{new:0{len(written) - 3}b}'"))
    return edits
