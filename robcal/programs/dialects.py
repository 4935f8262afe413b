"""The dialects by name and by the suffix of a program's file."""

import re
from collections.abc import Callable, Mapping

from robcal.errors import InvalidInput
from robcal.programs.fanuc import read_fanuc
from robcal.programs.krl import read_krl
from robcal.programs.rapid import read_rapid
from robcal.programs.targets import Program
from robcal.programs.text import NUMBER, SHORT_MARK, Source
from robcal.programs.urscript import read_urscript

READERS: Mapping[str, Callable[[Source], Program]] = {
    "krl": read_krl,
    "rapid": read_rapid,
    "urscript": read_urscript,
    "fanuc": read_fanuc,
}
LARGEST = 1e30
"""Numbers beyond are no target; their squares overflow."""
COMMENTS = {"krl": ";", "rapid": "!", "urscript": "#", "fanuc": "!"}
SUFFIXES = {
    ".src": "krl", ".mod": "rapid", ".modx": "rapid", ".sys": "rapid", ".sysx": "rapid", ".prg": "rapid",
    ".script": "urscript", ".ls": "fanuc",
}  # fmt: skip


def dialect_of(suffix: str, given: str | None = None) -> str:
    """The dialect that was given, or that of a suffix.

    Raises
    ------
    InvalidInput : neither is known.
    """
    if given is not None and given not in READERS:
        raise InvalidInput(f"there is no dialect '{given}': use {', '.join(READERS)}")
    found = given or SUFFIXES.get(suffix.lower())
    if found is None:
        raise InvalidInput(f"the suffix '{suffix}' tells no dialect: name it with --dialect {'|'.join(READERS)}")
    return found


def read_program(dialect: str, source: Source, data: Source | None = None) -> Program:
    """A program, with the data file that belongs to it in KRL.

    Raises
    ------
    Refusal : it is corrected already, or something in it cannot be corrected right; the message names the line.
    """
    for text in (source, data):
        if text is None:
            continue
        for number, line in enumerate(text.text.splitlines(), 1):
            comment = line.partition(COMMENTS[dialect])[2]
            if comment.strip().startswith(SHORT_MARK):
                raise text.refuse(
                    sum(len(part) for part in text.text.splitlines(keepends=True)[: number - 1]),
                    "the program is corrected already: correct the one that it was made from",
                )
        endless = next((m for m in re.finditer(NUMBER, text.text) if float(m[0]) > LARGEST), None)
        if endless is not None:
            raise text.refuse(endless.start(), f"the number {endless[0][:20]} is beyond all measure")
        if "\x00" in text.text:
            raise text.refuse(text.text.index("\x00"), "not a text in one byte a character: save it as ANSI or UTF-8")
    return read_krl(source, data) if dialect == "krl" else READERS[dialect](source)
