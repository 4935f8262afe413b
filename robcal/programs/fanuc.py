"""Fanuc's teach pendant programs in their text form (.LS).

Every position of the section /POS carries the numbers of its user frame and tool, so no state has to be followed. Read
are motions J, L, C, A, S to P[n], positions in Cartesian and joint representation of group 1, and UTOOL[n]=PR[m],
UFRAME[n]=PR[m] of registers whose six elements the program sets by constants (FANUC, R-30iB operator's manual). The
configuration string is kept, its numbers of turns are not needed for less than half a turn.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from robcal.programs.constants import Names, Opaque, Use, program
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
)
from robcal.programs.text import NUMBER, SHORT_MARK, Edit, Number, Source, mark, number_edit
from robcal.transforms import Array

DIGITS = (3, 3)
"""Decimals of mm and deg: what the controller keeps."""
PLACES = ("X", "Y", "Z", "W", "P", "R")
_STATEMENT = re.compile(r"^[ \t]*\d*[ \t]*:[ \t]*(?P<body>[^;]*);?", re.MULTILINE)
_MOTION = re.compile(r"[JLCAS][ \t]*(?=P\[|PR\[|@)")
_POSITION = re.compile(r"\b(PR|P)\[\s*([^\]:]*)(?::[^\]]*)?\]")
_REFUSED = (
    (r"\b(?:Tool_Offset|VOFFSET|Offset|Touch_Offset)\b", "an offset moves the target by numbers found at run time"),
    (r"\bINC\b", "an incremental move starts from where the robot happens to be"),
    (r"\b(?:COORD|RTCP)\b", "a coordinated move or remote tool is relative to another mechanism"),
    (r"\bPR\[", "a position register has no numbers in this program"),
    (r"\bTrack\b|\bVision\b", "the target moves with a sensor"),
)
_FIELD = re.compile(rf"\b(?P<name>[XYZWPR]|[JE]\d)\s*=\s*(?P<value>[+-]?\s*{NUMBER}|\*+)\s*(?P<unit>mm|deg)?")
_ELEMENT = re.compile(rf"\s*PR\[\s*(\d+)\s*,\s*(\d)\s*(?::[^\]]*)?\]\s*=\s*\(?\s*([+-]?\s*{NUMBER})?\s*\)?\s*$")
_ENTRY = re.compile(r"^[ \t]*P\[\s*(?P<number>\d+)\s*(?::[^\]]*)?\]\s*\{(?P<body>[^}]*)\}", re.MULTILINE)


@dataclass(frozen=True)
class _Sections:
    """Places of the instructions and of the positions in a text."""

    program: tuple[int, int]
    positions: tuple[int, int]


def read_fanuc(source: Source) -> Program:
    """The program of an .LS file.

    Raises
    ------
    Refusal : something cannot be corrected right; the message names the line.
    """
    sections = _sections(source)
    names = Names((source,))
    frames = _stated_frames(source, sections)
    uses, first = _motions(source, sections)
    found: list[tuple[int, Use]] = []
    for match in _ENTRY.finditer(source.text, *sections.positions):
        use = _position(source, match, frames, first.get(match["number"]))
        if use is not None:
            found.append(use)
            names.define(match["number"], use[1].target)
    missing = set(first) - {m["number"] for m in _ENTRY.finditer(source.text, *sections.positions)} - {""}
    for number in sorted(missing):
        uses.append(_refused(first[number], f"P[{number}] is not among the positions of the program"))
    uses += [use for _, use in sorted(found, key=lambda pair: pair[0])]
    return program(names, uses, [mark(source.text, f"    :  !{SHORT_MARK} ;", sections.program[0])])


def _sections(source: Source) -> _Sections:
    starts = {m[1]: m for m in re.finditer(r"^/(PROG|ATTR|APPL|MN|POS|END)\b[^\n]*\n?", source.text, re.MULTILINE)}
    if "MN" not in starts:
        raise source.refuse(0, "no section /MN: is it a program saved as text (.LS)?")
    end = len(source.text)
    pos = starts.get("POS")
    stop = pos.start() if pos else starts["END"].start() if "END" in starts else end
    after = (pos.end(), starts["END"].start() if "END" in starts else end) if pos else (end, end)
    return _Sections((starts["MN"].end(), stop), after)


def _refused(place: int, reason: str) -> Use:
    return Use(Opaque(0, place, f"{reason}: this cannot be corrected"), IDENTITY, IDENTITY, 0, place)


def _statements(source: Source, sections: _Sections) -> list[tuple[int, str]]:
    """Place and text of each instruction, continuation lines joined; remarks and disabled lines left out."""
    out = []
    for match in _STATEMENT.finditer(source.text, *sections.program):
        body = match["body"]
        if body.lstrip().startswith(("!", "//", "--eg:")):
            continue
        out.append((match.start("body"), re.sub(r"\"[^\"\n]*\"|'[^'\n]*'", '""', body)))
    return out


def _motions(source: Source, sections: _Sections) -> tuple[list[Use], dict[str, int]]:
    """What has to be refused, and the place of the first motion to each position ('' for any by register)."""
    uses: list[Use] = []
    first: dict[str, int] = {}
    for place, body in _statements(source, sections):
        motion = _MOTION.match(body)
        if motion is None:
            if re.match(r"\s*P\[[^\]]*\]\s*=", body):
                uses.append(_refused(place, "a position is changed while the program runs"))
            continue
        reason = next((reported for pattern, reported in _REFUSED if re.search(pattern, body)), None)
        if reason is not None:
            uses.append(_refused(place, reason))
            continue
        for kind, number in _POSITION.findall(body):
            if kind == "P":
                key = number.strip() if number.strip().isdigit() else ""
                first.setdefault(key, place)
    return uses, first


def _position(
    source: Source, match: re.Match[str], frames: dict[str, FrameOf], place: int | None
) -> tuple[int, Use] | None:
    """Group 1 of a position with the frames whose numbers it carries; None where it has no group 1."""
    text, number = source.text, match["number"]
    start = match.start("body")
    groups = list(re.finditer(r"\bGP(\d)\s*:", match["body"]))
    own = next((k for k, g in enumerate(groups) if g[1] == "1"), None)
    if own is None:
        return None
    begin = start + groups[own].end()
    stop = start + groups[own + 1].start() if own + 1 < len(groups) else match.end("body")
    at = match.start() if place is None else place
    fields: dict[str, Number] = {}
    for found in _FIELD.finditer(re.sub(r"'[^'\n]*'", lambda m: " " * len(m[0]), text[begin:stop])):
        if found["value"].startswith("*"):
            return at, _refused(begin + found.start(), f"P[{number}] is not taught")
        value = float(re.sub(r"\s", "", found["value"]))
        fields[found["name"]] = Number(begin + found.start("value"), begin + found.end("value"), value)
    literal = _literal(source, text[begin:stop], fields, match.start())
    if literal is None:
        return at, _refused(match.start(), f"P[{number}] has neither X, Y, Z, W, P, R nor J1 to J6")
    tool, base = (_frame(text[begin:stop], key, what, frames) for key, what in (("UT", "UTOOL"), ("UF", "UFRAME")))
    return at, Use(literal, tool, base, 0, at)


def _literal(source: Source, body: str, fields: dict[str, Number], start: int) -> Written | None:
    external = tuple(1e-3 * fields[f"E{k}"].value if f"E{k}" in fields else None for k in range(1, 4))
    if all(name in fields for name in PLACES):
        numbers = tuple(fields[name] for name in PLACES)
        T = frame_of_numbers(np.array([n.value for n in numbers]), "wpr")

        def write_frame(F: Array, before: Array, after: Array) -> list[Edit]:
            return frame_edits(source.text, numbers, F, "wpr", DIGITS, fixed=True)

        return Written(0, start, write_frame, T, external=external, hint=Hint(turns=_turns(body)))
    axes = [fields[f"J{k}"] for k in range(1, 10) if f"J{k}" in fields]
    if not axes:
        return None

    def write_axes(q: Array, before: Array, after: Array) -> list[Edit]:
        pairs = zip(axes, np.rad2deg(q), strict=False)
        return [number_edit(source.text, n, float(v), DIGITS[1], fixed=True) for n, v in pairs]

    return Written(0, start, write_axes, axes=np.deg2rad([n.value for n in axes]), external=external)


def _turns(body: str) -> dict[int, int]:
    """Turns of axes 1, 4, 6 in CONFIG : 'N U T, 0, 0, 0'."""
    found = re.search(r"CONFIG\s*:\s*'[^,']*,\s*(-?\d+)\s*,\s*(-?\d+)\s*,\s*(-?\d+)", body)
    return {} if found is None else dict(zip((0, 3, 5), (int(v) for v in found.groups()), strict=True))


def _frame(body: str, key: str, what: str, frames: dict[str, FrameOf]) -> FrameOf:
    found = re.search(rf"\b{key}\s*:\s*(\w+)", body)
    if found is None or not found[1].isdigit():
        return Unclear(f"is the one that is active when the program runs ({key} : {found[1] if found else '?'})")
    if int(found[1]) == 0:
        return IDENTITY
    return frames.get(f"{what}[{int(found[1])}]", Named(str(int(found[1]))))


def _stated_frames(source: Source, sections: _Sections) -> dict[str, FrameOf]:
    """Tools and user frames that the program sets from registers of constants."""
    elements: dict[str, dict[int, float | None]] = {}
    frames: dict[str, FrameOf] = {}
    for _, body in _statements(source, sections):
        element = _ELEMENT.match(body)
        if element is not None and element[3] is not None:
            own = elements.setdefault(element[1], {})
            own[int(element[2])] = float(re.sub(r"\s", "", element[3])) if int(element[2]) not in own else None
        elif (changed := re.match(r"\s*PR\[\s*(\d+)", body)) is not None and "=" in body:
            # an element set by something else; a whole register is a start that its elements then replace
            if "," in body.split("=")[0]:
                elements.setdefault(changed[1], {})[0] = None
            else:
                elements[changed[1]] = {}
        setting = re.match(r"\s*(UTOOL|UFRAME)\[\s*(\d+)\s*(?::[^\]]*)?\]\s*=\s*PR\[\s*(\d+)", body)
        if setting is not None:
            name = f"{setting[1]}[{int(setting[2])}]"
            frames[name] = _of_register(elements.get(setting[3], {}), name in frames)
    return frames


def _of_register(elements: dict[int, float | None], again: bool) -> FrameOf:
    values: Sequence[float | None] = [elements.get(k) for k in range(1, 7)]
    if again or 0 in elements or any(v is None for v in values):
        return Unclear("is set from a register whose six elements are no constants of the program")
    return Stated.of(frame_of_numbers(np.array([v for v in values if v is not None]), "wpr"))
