"""Names of a program and what they stand for: which literals a motion's target can be.

Only what the text itself settles is resolved. A name that is computed, changed piece by piece, or comes from elsewhere
refuses the program with the line that says so.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from robcal.programs.targets import FrameOf, Program, Target, Unclear, Written
from robcal.programs.text import Edit, Refusal, Source
from robcal.transforms import Array

DEEPEST = 20


@dataclass(frozen=True)
class Ref:
    """A name, or an element of an array by its index (None: any element)."""

    name: str
    source: int
    place: int
    index: str | None = None


@dataclass(frozen=True)
class Opaque:
    """What the text does not settle, and why."""

    source: int
    place: int
    reason: str


@dataclass(frozen=True)
class Current:
    """The position in which the robot is: nothing to correct."""


@dataclass(frozen=True)
class Later:
    """An expression of constants, worked out when all definitions are known; may raise a Refusal."""

    make: Callable[[], Written]


Expression = Written | Ref | Opaque | Current | Later


@dataclass
class Names:
    """Definitions of a program's names, as spelt (``key`` maps spellings of one name to one)."""

    sources: Sequence[Source]
    key: Callable[[str], str] = str.upper
    defined: dict[str, list[tuple[str | None, Expression]]] = field(default_factory=dict)
    changed: dict[str, tuple[int, int, str]] = field(default_factory=dict)

    def define(self, name: str, value: Expression, index: str | None = None) -> None:
        """A declaration or an assignment."""
        self.defined.setdefault(self.key(name), []).append((index, value))

    def change(self, name: str, source: int, place: int, how: str) -> None:
        """Something that makes the name more than its literals."""
        self.changed.setdefault(self.key(name), (source, place, how))

    def refuse(self, source: int, place: int, sentence: str) -> Refusal:
        """The error that refuses the program for what stands at a place of a file."""
        return self.sources[source].refuse(place, sentence)

    def literals(self, expression: Expression, depth: int = 0) -> list[Written]:
        """All literals that an expression can be; none for the present position.

        Raises
        ------
        Refusal : it cannot be told from the text.
        """
        if isinstance(expression, Written):
            return [expression]
        if isinstance(expression, Current):
            return []
        if isinstance(expression, Later):
            return [expression.make()]
        if isinstance(expression, Opaque):
            raise self.refuse(expression.source, expression.place, expression.reason)
        name = self.key(expression.name)
        if name in self.changed:
            raise self.refuse(*self.changed[name])
        values = self.defined.get(name, [])
        if expression.index is not None and any(i == expression.index for i, _ in values):
            values = [(i, v) for i, v in values if i == expression.index]
        if not values or depth > DEEPEST:
            raise self.refuse(
                expression.source,
                expression.place,
                f"the target '{expression.name}' has no numbers in this program: write them here, where they can be "
                "corrected",
            )
        return [literal for _, value in values for literal in self.literals(value, depth + 1)]

    def single(self, expression: Expression) -> Written:
        """The one literal that an expression is.

        Raises
        ------
        Refusal : it is none, or one of several.
        """
        found = self.literals(expression)
        if len(found) == 1:
            return found[0]
        place = expression if isinstance(expression, Ref | Opaque) else None
        if place is None:
            raise Refusal(f"{self.sources[0].name}: an offset from a position that the program does not state")
        raise self.refuse(place.source, place.place, f"'{getattr(place, 'name', '')}' has several values here")


@dataclass(frozen=True)
class Use:
    """A motion to an expression, with the tool and base in force."""

    target: Expression
    tool: FrameOf
    base: FrameOf
    source: int
    place: int


def program(names: Names, uses: Sequence[Use], marks: Sequence[Edit], notes: Sequence[str] = ()) -> Program:
    """The program of all targets that its motions use, each once.

    Raises
    ------
    Refusal : a motion's target cannot be told from the text; its faults are all of them.
    """
    found: dict[tuple[int, int], Target] = {}
    refusals: list[Refusal] = []
    for use in uses:
        try:
            literals = names.literals(use.target)
        except Refusal as refusal:
            refusals.append(refusal)
            continue
        source = names.sources[use.source]
        for literal in literals:
            new = Target(literal, use.tool, use.base, source.name, source.line(use.place))
            old = found.setdefault((literal.source, literal.start), new)
            if (old.tool, old.base) != (new.tool, new.base):
                both = [_both(a, b, old, new) for a, b in ((old.tool, new.tool), (old.base, new.base))]
                found[literal.source, literal.start] = Target(literal, both[0], both[1], old.file, old.line)
    if refusals:
        raise several(refusals)
    return Program(tuple(names.sources), tuple(found.values()), tuple(marks), tuple(notes))


def several(refusals: Sequence[Refusal]) -> Refusal:
    """One refusal whose text is the first, with all of them as its faults."""
    told = list(dict.fromkeys(str(r) for r in refusals))
    return Refusal(f"{told[0]}; nothing was written", (f"{told[0]}; nothing was written", *told[1:]))


def _both(a: FrameOf, b: FrameOf, first: Target, second: Target) -> FrameOf:
    if a == b:
        return a
    return Unclear(f"is one in line {first.line} and another in line {second.line}, for the same target")


def checked_frame(literal: Written, names: Names) -> Array:
    """Frame of a literal that has to be Cartesian.

    Raises
    ------
    Refusal : it is a joint target.
    """
    if literal.T is None:
        raise names.refuse(literal.source, literal.start, "an offset from a joint target cannot be corrected")
    return literal.T
