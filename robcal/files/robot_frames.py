"""Frames of a robot file: joints, fixed frames, and frames that joints turn (parallelograms, four-bars).

Joints are q1, q2, ... in the order of the frames that carry them. A frame with ``angle`` or ``fourbar`` has no joint of
its own, unless it names the joint that is next in number: a motor that stands elsewhere and has no frame in the chain.
"""

import math
import re
from collections.abc import Iterator, Sequence
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BeforeValidator

from robcal.files.schemas import Entry, NotNegative, Number, Text, Triple
from robcal.files.yaml_io import FlowMapping, YamlDocument
from robcal.robot.loops import FourBar, impossible_lengths
from robcal.robot.model import Frame
from robcal.transforms import Array


def _sign(value: Any) -> Any:
    if value not in (1, -1):
        raise ValueError(f"sign must be 1 or -1, found {value!r}")
    return int(value)


class FourBarEntry(Entry):
    """A crank turned by a joint, a coupler, and the rocker that turns the frame; angles from the ground line."""

    driven_by: Text
    lengths_mm: tuple[Number, Number, Number, Number]
    crank_zero_deg: Number = 0.0
    assembly: Literal["open", "crossed"] = "open"


class FrameEntry(Entry):
    """One frame of the chain."""

    name: Text
    axis: Literal["x", "y", "z"] | None
    type: Literal["revolute", "prismatic"] = "revolute"
    sign: Annotated[int, BeforeValidator(_sign)] = 1
    range_deg: tuple[Number, Number] | None = None
    range_mm: tuple[Number, Number] | None = None
    xyz_mm: Triple = (0.0, 0.0, 0.0)
    rpy_deg: Triple = (0.0, 0.0, 0.0)
    mass_kg: NotNegative = 0.0
    cog_mm: Triple = (0.0, 0.0, 0.0)
    angle: dict[str, Number] | None = None
    fourbar: FourBarEntry | None = None

    @property
    def drivers(self) -> list[str]:
        """Names of the joints that turn the frame, as written."""
        return list(self.angle or {}) + ([self.fourbar.driven_by] if self.fourbar is not None else [])

    @property
    def turned(self) -> bool:
        """Whether joints turn the frame by ``angle`` or ``fourbar``."""
        return self.angle is not None or self.fourbar is not None


def metres(values: Triple) -> Triple:
    """Millimetres to metres."""
    return (values[0] / 1000, values[1] / 1000, values[2] / 1000)


def radians(values: Triple) -> Triple:
    """Degrees to radians."""
    return (math.radians(values[0]), math.radians(values[1]), math.radians(values[2]))


def chain_frames(entries: Sequence[FrameEntry]) -> tuple[Frame, ...]:
    """The chain of entries without :func:`frame_faults`."""
    return tuple(_frame(entry, own) for entry, own in zip(entries, _own_joints(entries), strict=True))


def frame_faults(entries: Sequence[FrameEntry], document: YamlDocument) -> Iterator[str]:
    """A sentence for each contradiction within a frame, or between frames and the joints that turn them."""
    sliding: list[bool] = []  # of the joints so far
    for i, (entry, own) in enumerate(zip(entries, _own_joints(entries), strict=True)):
        where = f"{document.path}, line {document.line(('frames', i))}: frame '{entry.name}'"
        yield from _range_faults(entry, where)
        if entry.turned:
            yield from _loop_faults(entry, own, sliding, where)
        if own is not None:
            sliding.append(entry.type == "prismatic")


def _own_joints(entries: Sequence[FrameEntry]) -> list[int | None]:
    """Index of the joint that each frame carries, None for the others."""
    own: list[int | None] = []
    count = 0
    for entry in entries:
        carries = entry.axis is not None and (not entry.turned or f"q{count + 1}" in entry.drivers)
        own.append(count if carries else None)
        count += carries
    return own


def _range_faults(entry: FrameEntry, where: str) -> Iterator[str]:
    if entry.type == "prismatic" and entry.axis is None:
        yield f"{where}: a sliding joint needs an axis (x, y or z)"
    if entry.range_mm is not None and entry.type != "prismatic":
        yield f"{where}: range_mm is for sliding joints: use range_deg or add 'type: prismatic'"
    if entry.range_deg is not None and entry.type == "prismatic":
        yield f"{where}: range_deg is for turning joints: use range_mm"
    for limits in (entry.range_deg, entry.range_mm):
        if limits is not None and limits[0] >= limits[1]:
            yield f"{where}: the range {list(limits)} is empty: the smaller limit comes first"


def _loop_faults(entry: FrameEntry, own: int | None, sliding: Sequence[bool], where: str) -> Iterator[str]:
    if entry.axis is None or entry.type == "prismatic":
        yield f"{where}: 'angle' and 'fourbar' turn a frame: give it an axis (x, y or z) and no 'type: prismatic'"
        return
    if entry.angle is not None and entry.fourbar is not None:
        yield f"{where}: it turns by 'angle' or by 'fourbar', not by both: put one of them in a frame of its own"
        return
    if not entry.drivers:
        yield f"{where}: 'angle' names no joint: write for example 'angle: {{q2: -1.0, q3: 1.0}}'"
    known = [f"q{k + 1}" for k in range(len(sliding))]
    for name in entry.drivers:
        if name in known and sliding[known.index(name)]:
            yield f"{where}: joint {name} slides, a loop is turned by turning joints"
        elif name not in known and (own is None or name != f"q{own + 1}"):
            upto = ", ".join(known) or "none"
            yield (
                f"{where}: there is no joint '{name}' before it: the joints before it are {upto}; the next number, "
                f"q{len(known) + 1}, stands for a motor that has no frame of its own"
            )
    for name, coefficient in (entry.angle or {}).items():
        if own is not None and name == f"q{own + 1}" and abs(coefficient) != 1.0:
            yield f"{where}: {name} has no other frame, so its coefficient must be 1 or -1, not {coefficient:g}"
        elif coefficient == 0.0:
            yield f"{where}: the coefficient of {name} is zero: leave {name} out"
    if entry.fourbar is not None and (fault := impossible_lengths(_bar_lengths(entry.fourbar))):
        yield f"{where}: {fault}: correct lengths_mm (crank, coupler, rocker, ground)"
    if own is None and entry.range_deg is not None:
        yield f"{where}: range_deg is for joints: this frame follows others, whose ranges hold"


def _bar_lengths(entry: FourBarEntry) -> tuple[float, float, float, float]:
    a, b, c, g = entry.lengths_mm
    return a / 1000, b / 1000, c / 1000, g / 1000


def _frame(entry: FrameEntry, own: int | None) -> Frame:
    prismatic = entry.type == "prismatic"
    limits: tuple[float, float] | None = None
    if prismatic and entry.range_mm is not None:
        limits = (entry.range_mm[0] / 1000, entry.range_mm[1] / 1000)
    elif entry.range_deg is not None:
        limits = (math.radians(entry.range_deg[0]), math.radians(entry.range_deg[1]))
    turns = {_number(name): entry.sign * c for name, c in (entry.angle or {}).items()}
    bar = entry.fourbar
    sign = entry.sign
    if entry.angle is not None:
        sign = int(turns.pop(own)) if own is not None else 1
    return Frame(
        name=entry.name,
        axis=entry.axis,
        prismatic=prismatic,
        sign=sign,
        limits=limits,
        xyz=metres(entry.xyz_mm),
        rpy=radians(entry.rpy_deg),
        mass=entry.mass_kg,
        cog=metres(entry.cog_mm),
        follows=tuple(turns.items()),
        fourbar=None
        if bar is None
        else FourBar(_number(bar.driven_by), _bar_lengths(bar), math.radians(bar.crank_zero_deg), bar.assembly),
        passive=entry.turned and own is None,
    )


def _number(name: str) -> int:
    return int(re.sub(r"\D", "", name)) - 1


def frame_data(frames: Sequence[Frame]) -> list[FlowMapping]:
    """Frames as they stand in the file."""
    rows = []
    joints = [f.name for f in frames if f.is_joint]
    for f in frames:
        row = FlowMapping(name=f.name, axis=f.axis)
        if f.prismatic:
            row["type"] = "prismatic"
        if f.axis is not None and not f.follows:
            row["sign"] = int(f.sign)
        if f.follows:
            own = {joints.index(f.name): float(f.sign)} if f.is_joint else {}
            row["angle"] = FlowMapping({f"q{k + 1}": float(c) for k, c in sorted({**dict(f.follows), **own}.items())})
        if f.fourbar is not None:
            row["fourbar"] = _bar_data(f.fourbar)
        if f.is_joint and f.limits is not None:
            limits = np.array(f.limits)
            key, shown = ("range_mm", limits * 1000) if f.prismatic else ("range_deg", np.degrees(limits))
            row[key] = listed(shown)
        row["xyz_mm"] = listed(np.asarray(f.xyz) * 1000)
        row["rpy_deg"] = listed(np.degrees(f.rpy))
        if f.mass or np.any(f.cog):
            row["mass_kg"] = float(f.mass)
            row["cog_mm"] = listed(np.asarray(f.cog) * 1000)
        rows.append(row)
    return rows


def _bar_data(bar: FourBar) -> FlowMapping:
    row = FlowMapping(driven_by=f"q{bar.driver + 1}", lengths_mm=listed(np.asarray(bar.lengths) * 1000))
    if bar.crank_zero:
        row["crank_zero_deg"] = listed(np.degrees([bar.crank_zero]))[0]
    if bar.assembly != "open":
        row["assembly"] = bar.assembly
    return row


def listed(values: Array) -> list[float]:
    """Numbers for a file: twelve decimals of a millimetre or degree, below any meaning, above conversions' noise."""
    return [float(v) + 0.0 for v in np.round(np.asarray(values, dtype=float), 12)]
