"""Texts of programs: tokens with their places, numbers replaced in their own width, edits that leave all else alone.

Programs are handled as one character a byte (Latin-1), so that whatever encoding comments and strings have, what is not
replaced is written back as it was read.
"""

import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

from robcal.errors import InvalidInput


@dataclass(frozen=True)
class Source:
    """A file of a program: its name for messages, and its text, one character a byte."""

    name: str
    text: str

    def line(self, place: int) -> int:
        """Line (from 1) of a place in the text."""
        return self.text.count("\n", 0, place) + 1

    def refuse(self, place: int, sentence: str) -> "Refusal":
        """The error that refuses the program for what stands at a place."""
        return Refusal(f"{self.name}, line {self.line(place)}: {sentence}")


class Refusal(InvalidInput):
    """A program that cannot be corrected as a whole; the message names the line and why."""


@dataclass(frozen=True)
class Token:
    """A piece of a program: kind 'word', 'number', 'string', 'end' (of a statement) or the symbol itself."""

    kind: str
    text: str
    start: int

    @property
    def stop(self) -> int:
        """Place after its last character."""
        return self.start + len(self.text)

    @property
    def upper(self) -> str:
        """Its text in capital letters (most controllers do not tell them apart)."""
        return self.text.upper()


MARK = "corrected by robcal for the calibrated robot: do not correct again"
"""In a comment at the top of every corrected file."""
SHORT_MARK = "corrected by robcal"
"""What every mark begins with, and all of it where remarks are short."""

NUMBER = r"(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?"


def tokens(text: str, comment: str, strings: str, word: str, symbols: Sequence[str] = ()) -> Iterator[Token]:
    """Tokens, one after the other, of a text without its comments and blanks; the end of each line is a token 'end'.

    Parameters
    ----------
    comment : character that begins a comment up to the end of the line.
    strings : characters that quote strings.
    word : regular expression of names. symbols : symbols of several characters.
    """
    quoted = "|".join(f"{q}[^{q}\n]*{q}?" for q in strings)
    several = "|".join(re.escape(s) for s in symbols) or r"(?!)"
    pattern = re.compile(
        rf"(?P<blank>[ \t\r\f\v]+|{re.escape(comment)}[^\n]*)|(?P<end>\n)|(?P<string>{quoted})|(?P<word>{word})"
        rf"|(?P<number>{NUMBER})|(?P<symbol>{several}|.)"
    )
    for match in pattern.finditer(text):
        kind = str(match.lastgroup)
        if kind != "blank":
            yield Token(match[0] if kind == "symbol" else kind, match[0], match.start())


def split(items: Sequence[Token], separator: str) -> list[list[Token]]:
    """Tokens split at a separator that stands outside of brackets."""
    parts: list[list[Token]] = [[]]
    depth = 0
    for token in items:
        depth += (token.kind in "([{") - (token.kind in ")]}")
        if token.kind == separator and depth == 0:
            parts.append([])
        else:
            parts[-1].append(token)
    return parts


@dataclass(frozen=True)
class Number:
    """A number as it stands in a text, sign included (or a constant expression that is one)."""

    start: int
    stop: int
    value: float

    def within(self, text: str) -> str:
        """How it is written."""
        return text[self.start : self.stop]


@dataclass(frozen=True)
class Edit:
    """What is to stand in a text instead of what stands between two places."""

    start: int
    stop: int
    text: str


def apply_edits(text: str, edits: Iterable[Edit]) -> str:
    """The text with its edits, which must not overlap."""
    out, place = [], 0
    for edit in sorted(edits, key=lambda e: e.start):
        if edit.start < place:
            raise ValueError("edits of a program overlap")
        out += [text[place : edit.start], edit.text]
        place = edit.stop
    return "".join([*out, text[place:]])


def constant(items: Sequence[Token], functions: Mapping[str, Callable[[float], float]] | None = None) -> Number | None:
    """The number that a constant expression (+ - * /, brackets, the given functions) is; None if it is not constant."""
    if not items:
        return None
    value, rest = _sum(list(items), functions or {})
    return None if value is None or rest else Number(items[0].start, items[-1].stop, value)


def _sum(items: list[Token], functions: Mapping[str, Callable[[float], float]]) -> tuple[float | None, list[Token]]:
    value, items = _product(items, functions)
    while items and items[0].kind in "+-" and value is not None:
        other, rest = _product(items[1:], functions)
        value = None if other is None else value + other if items[0].kind == "+" else value - other
        items = rest
    return value, items


def _product(items: list[Token], functions: Mapping[str, Callable[[float], float]]) -> tuple[float | None, list[Token]]:
    value, items = _factor(items, functions)
    while items and items[0].kind in "*/" and value is not None:
        other, rest = _factor(items[1:], functions)
        if other is None or (items[0].kind == "/" and other == 0):
            return None, rest
        value = value * other if items[0].kind == "*" else value / other
        items = rest
    return value, items


def _factor(items: list[Token], functions: Mapping[str, Callable[[float], float]]) -> tuple[float | None, list[Token]]:
    if not items:
        return None, items
    head, rest = items[0], items[1:]
    if head.kind in "+-":
        value, rest = _factor(rest, functions)
        return (None if value is None else -value if head.kind == "-" else value), rest
    if head.kind == "number":
        return float(head.text), rest
    function = functions.get(head.text) if head.kind == "word" else None
    if head.kind == "(" or (function is not None and rest and rest[0].kind == "("):
        value, rest = _sum(rest if head.kind == "(" else rest[1:], functions)
        if value is None or not rest or rest[0].kind != ")":
            return None, rest
        return (value if function is None else function(value)), rest[1:]
    return None, items


def mark(text: str, comment: str, place: int) -> Edit:
    """The comment line that marks a corrected file, in its own way of ending lines, before the line at a place."""
    newline = "\r\n" if "\r\n" in text else "\n"
    return Edit(place, place, f"{comment}{newline}")


def number_edit(text: str, old: Number, value: float, digits: int, fixed: bool = False) -> Edit:
    """Edit that writes a number with at least so many decimals as before and ``digits`` (exactly so many if fixed).

    In a column (two blanks or more before it) the new number ends where the old one ended, as long as one blank is
    left; so tables stay tables.
    """
    written = old.within(text)
    plain = re.fullmatch(r"[+-]?\s*\d*\.?(\d*)", written)
    decimals = digits if fixed or plain is None else max(len(plain[1]), digits)
    new = f"{round(value, decimals) + 0.0:.{decimals}f}"
    if written.startswith("+") and not new.startswith("-"):
        new = "+" + new
    start = old.start
    blanks = len(text[:start]) - len(text[:start].rstrip(" "))
    if blanks >= 2:
        grown = len(new) - len(written)
        start -= min(max(grown, 0), blanks - 1)
        new = " " * max(-grown, 0) + new
    return Edit(start, old.stop, new)
