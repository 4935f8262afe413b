"""Joint angles as controllers write them: KUKA, ABB and Universal Robots.

KUKA: ``DECL E6AXIS XP1={A1 ...,A2 ...}`` of a ``.dat``, ``PTP {A1 ...}`` of a ``.src``, ``$AXIS_ACT`` in a log (deg;
point XP1 is called P1, as in the program). ABB: ``jointtarget p1:=[[...],[...]]`` and ``MoveAbsJ [[...],[...]]`` (deg,
mm). Universal Robots: ``movej([...])`` and ``name_q=[...]`` of a script (rad), and recordings of the real-time data
exchange, ``timestamp actual_q_0 ... actual_q_5`` (rad), of which every standstill is a pose.
"""

import math
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from robcal.errors import InvalidInput
from robcal.files.foreign_tables import TableMap, read_mapped_table
from robcal.files.storage import read_bytes
from robcal.files.tables import Table
from robcal.robot.model import RobotModel
from robcal.transforms import Array

SUFFIXES = frozenset({".dat", ".src", ".mod", ".sys", ".prg", ".script", ".urscript", ".log", ".txt"})
MAX_BYTES = 400_000_000
NO_AXIS = 8.9e9
"""ABB's 9E9: this external axis does not exist."""
STILL, SHORTEST = math.radians(0.002), 0.5
"""A robot stands while no joint leaves a band of so many rad, for so many seconds at least."""
DENSE = 0.25
"""Rows closer in time (s) than this are a recording of motion, not one row for each pose."""

# possessive (++, *+) and anchored at the beginning of a word, so that no text takes longer than its length
_NUMBER = r"[-+]?+(?:\d++\.?+\d*+|\.\d++)(?:[eE][-+]?+\d++)?+"
_KUKA = re.compile(
    r"(?:(?<![\w$])(?P<name>[$\w]++)\s*+(?:\[\s*+\d*+\s*+\])?+\s*+=\s*+)?+"
    r"\{\s*+(?:E6AXIS\s*+:|AXIS\s*+:)?+\s*+(?P<axes>A1\s++[^{}]*+)\}",
    re.IGNORECASE,
)
_KUKA_AXIS = re.compile(rf"\b([AE])([1-6])\s++({_NUMBER})", re.IGNORECASE)
_LIST = rf"\[\s*+({_NUMBER}(?:\s*+,\s*+{_NUMBER})*+)\s*+\]"
_ABB = re.compile(
    rf"(?:jointtarget\s++(?P<name>\w++)\s*+:=|MoveAbsJ)\s*+\[\s*+{_LIST}\s*+,\s*+{_LIST}\s*+\]", re.IGNORECASE
)
_UR = re.compile(
    rf"(?:(?<!\w)(?P<name>\w++)\s*+=\s*+|movej\s*+\(\s*+|^[ \t]*+(?P<label>[\w.]*+)[ \t:=,]*+){_LIST}",
    re.IGNORECASE | re.M,
)


@dataclass(frozen=True)
class _Found:
    """A pose of a log: line, name (None: none is given), joint values (deg, mm)."""

    line: int
    name: str | None
    values: tuple[float, ...]


def is_joint_log(path: Path) -> bool:
    """Whether a file is a joint log of a controller rather than a table."""
    if path.suffix.lower() in SUFFIXES - {".txt", ".log"}:
        return True
    if path.suffix.lower() not in (".csv", ".txt", ".log", ".tsv") or not path.is_file():
        return False
    head = read_bytes(path, MAX_BYTES)[:20_000].decode("utf-8", errors="replace")
    return (
        _is_rtde(head)
        or any(pattern.search(head) for pattern in (_KUKA, _ABB))
        or (path.suffix.lower() != ".csv" and _UR.search(head) is not None)
    )


def read_controller_log(path: Path) -> Table:
    """The poses of a controller's file as a table ``pose, q1_deg, ...``; rows are lines of the file.

    External axes follow the robot's own, in mm or deg as the controller counts them.

    Raises
    ------
    InvalidInput : no joint angles in it, rows of different length, a point that stands twice.
    """
    text = read_bytes(path, MAX_BYTES).decode("utf-8-sig", errors="replace")
    if _is_rtde(text[:20_000]):
        return _rtde(path, text)
    found = _kuka(text) or _abb(text) or _ur(text)
    if not found:
        raise InvalidInput(
            f"{path}: no joint angles found: KUKA's {{A1 ..., A2 ...}}, ABB's jointtarget or MoveAbsJ, or Universal "
            "Robots' movej([...]) are read; Cartesian targets are none"
        )
    width = len(found[0].values)
    odd = next((pose for pose in found if len(pose.values) != width), None)
    if odd is not None:
        raise InvalidInput(f"{path}, row {odd.line}: {len(odd.values)} joints where the first pose has {width}")
    return _table(path, found)


def _table(path: Path, found: list[_Found]) -> Table:
    names = [pose.name or str(k) for k, pose in enumerate(found, start=1)]
    columns = {"pose": tuple(names)}
    for k in range(len(found[0].values)):
        columns[f"q{k + 1}_deg"] = tuple(repr(pose.values[k]) for pose in found)
    return Table(path, columns, np.array([pose.line for pose in found], dtype=np.int64))


def _lines(text: str, pattern: re.Pattern[str]) -> Iterator[tuple[int, re.Match[str]]]:
    line, at = 1, 0
    for match in pattern.finditer(text):
        line += text.count("\n", at, match.start())
        at = match.start()
        yield line, match


def _kuka(text: str) -> list[_Found]:
    found = []
    for line, match in _lines(_without_comments(text, ";"), _KUKA):
        axes = {f"{a.upper()}{k}": float(v) for a, k, v in _KUKA_AXIS.findall(match["axes"])}
        names = [f"A{k}" for k in range(1, 7) if f"A{k}" in axes]
        names += [f"E{k}" for k in range(1, 7) if axes.get(f"E{k}", 0.0) != 0.0]
        name = match["name"]
        if name is not None:
            name = (
                None if name.startswith("$") else name[1:] if name.upper().startswith("X") and len(name) > 1 else name
            )
        found.append(_Found(line, name, tuple(axes[n] for n in names)))
    width = max((len(pose.values) for pose in found), default=0)
    return [_Found(p.line, p.name, p.values + (0.0,) * (width - len(p.values))) for p in found]


def _abb(text: str) -> list[_Found]:
    found = []
    for line, match in _lines(_without_comments(text, "!"), _ABB):
        own, external = ([float(v) for v in group.split(",")] for group in match.groups()[1:3])
        found.append(_Found(line, match["name"], (*own, *(v for v in external if abs(v) < NO_AXIS))))
    return found


def _ur(text: str) -> list[_Found]:
    found = []
    for line, match in _lines(_without_comments(text, "#"), _UR):
        values = [math.degrees(float(v)) for v in match.groups()[-1].split(",")]
        before = match[0].split("[")[0]
        if len(values) == 6 and not before.rstrip().endswith("p"):
            name = (match["name"] or match["label"] or "").removesuffix("_q")
            found.append(_Found(line, name or None, tuple(values)))
    return found


def _without_comments(text: str, mark: str) -> str:
    """The text with comments cut off; lines stay where they are."""
    return "\n".join(line.split(mark, 1)[0] if mark in line else line for line in text.splitlines())


def _is_rtde(head: str) -> bool:
    first = head.lstrip().split("\n", 1)[0]
    return "actual_q_0" in first or "target_q_0" in first


def _rtde(path: Path, text: str) -> Table:
    first = text.lstrip().split("\n", 1)[0]
    sep = next((mark for mark in (",", ";", "\t") if mark in first), "space")
    table = read_mapped_table(path, TableMap(sep=sep))
    kind = "actual" if "actual_q_0" in table.columns else "target"
    q = np.degrees(np.column_stack([table.numbers(f"{kind}_q_{k}") for k in range(6)]))
    if not len(q):
        raise InvalidInput(f"{path}: lists no joint angles")
    time = table.numbers("timestamp") if "timestamp" in table.columns else None
    if time is None or len(time) < 3 or float(np.median(np.diff(time))) > DENSE:
        found = [_Found(int(row), None, tuple(map(float, values))) for row, values in zip(table.rows, q, strict=True)]
        return _table(path, found)
    rests = standstills(time, np.radians(q))
    if not rests:
        raise InvalidInput(f"{path}: the robot never stands still for {SHORTEST:g} s: record the poses at rest")
    found = [_Found(int(table.rows[a]), None, tuple(map(float, q[a:b].mean(axis=0)))) for a, b in rests]
    made = _table(path, found)
    seconds = tuple(repr(float(time[a:b].mean())) for a, b in rests)
    return Table(path, {**made.columns, "time_s": seconds}, made.rows)


def standstills(time: Array, q: Array) -> list[tuple[int, int]]:
    """Rows (first, behind the last) during which a robot stood: joints (n, N) in rad within a band, time (n,) in s."""
    found: list[tuple[int, int]] = []
    begin = 0
    low = high = q[0]
    for i in range(1, len(q) + 1):
        if i < len(q):
            lower, upper = np.minimum(low, q[i]), np.maximum(high, q[i])
            if np.max(upper - lower) <= STILL:
                low, high = lower, upper
                continue
        if time[i - 1] - time[begin] >= SHORTEST:
            found.append((begin, i))
        if i < len(q):
            begin, low, high = i, q[i], q[i]
    return found


def log_of_robot(table: Table, robot: RobotModel | None) -> Table:
    """The log with the columns of a robot's joints; external axes that it does not have are left out.

    Raises
    ------
    InvalidInput : fewer joints than the robot has, or motion of an axis that the robot file does not know.
    """
    if robot is None:
        return table
    joints = [name for name in table.columns if name.startswith("q")]
    wanted = ["mm" if joint.prismatic else "deg" for joint in robot.joints]
    if len(joints) != len(wanted):
        raise InvalidInput(
            f"{table.path}: has {len(joints)} joints, the robot file {len(wanted)}: use the robot file of this robot "
            "(with its external axes behind the others)"
        )
    columns = {name: cells for name, cells in table.columns.items() if name not in joints}
    columns |= {f"q{k}_{unit}": table.columns[f"q{k}_deg"] for k, unit in enumerate(wanted, start=1)}
    return Table(table.path, columns, table.rows)
