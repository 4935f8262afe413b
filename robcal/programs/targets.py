"""What all dialects have in common: targets with the tool and base that they are given in, and a program made of them.

A dialect reads a text into a :class:`Program`; :mod:`robcal.programs.correction` finds the numbers that are to stand in
it; each target writes its own numbers back.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from robcal.programs.text import Edit, Number, Source, number_edit
from robcal.transforms import Array, exp_so3, frame, frame_from_xyzrpy, log_so3, xyzrpy_from_frame

Form = Literal["abc", "wpr", "quaternion", "rotation_vector"]


@dataclass(frozen=True)
class Stated:
    """A frame (tool or base) whose numbers the program states."""

    T: tuple[tuple[float, ...], ...]

    @classmethod
    def of(cls, T: Array) -> "Stated":
        """From a (4, 4) frame."""
        return cls(tuple(tuple(float(v) for v in row) for row in T))

    @property
    def frame(self) -> Array:
        """(4, 4)"""
        return np.array(self.T)


IDENTITY = Stated.of(np.eye(4))


@dataclass(frozen=True)
class Named:
    """A frame that the program only names, by number or name; its numbers come from elsewhere."""

    name: str


@dataclass(frozen=True)
class Unclear:
    """A frame that cannot be told from the text: it depends on the way that the program takes."""

    reason: str


FrameOf = Stated | Named | Unclear


@dataclass(frozen=True)
class Hint:
    """Which configuration a Cartesian target asks for.

    Attributes
    ----------
    negative : whether each of the first axes is negative (KRL's turn), None where the target does not say.
    quarters : axis -> quarter turn floor(q / 90 deg) (RAPID's confdata).
    turns : axis -> whole turn, 0 within half a turn of zero (Fanuc's CONFIG).
    near : axes in rad that the program itself gives as nearby.
    """

    negative: tuple[bool, ...] | None = None
    quarters: Mapping[int, int] = field(default_factory=dict)
    turns: Mapping[int, int] = field(default_factory=dict)
    near: tuple[float, ...] | None = None

    def misses(self, axis: int, angle: float) -> int:
        """1 where an angle (rad) of an axis contradicts the hint; what is on a border fits both sides."""
        on = 1e-4  # rad: what the digits of a target leave open
        if self.negative is not None and axis < len(self.negative):
            return int(abs(angle) > on and (angle < 0) != self.negative[axis])
        for table, cell in ((self.quarters, quarter), (self.turns, turn)):
            if axis in table:
                return int(table[axis] not in (cell(angle - on), cell(angle + on)))
        return 0


def quarter(angle: float) -> int:
    """Quarter turn in which an angle (rad) lies: 0 from 0 to 90 degrees, -1 from -90 to 0."""
    return int(np.floor(angle / (np.pi / 2)))


def turn(angle: float) -> int:
    """Whole turns of an angle (rad): 0 from -180 to 180 degrees."""
    return int(np.floor((angle + np.pi) / (2 * np.pi)))


Write = Callable[[Array, Array, Array], list[Edit]]
"""From a corrected frame (4, 4) or axes, and the axes before and after, to the edits that write it."""


@dataclass(frozen=True)
class Written:
    """A target as it stands in a text.

    Attributes
    ----------
    source : index of the file in which it stands; start : its place there.
    T : (4, 4) Cartesian target in the program's base; axes : rotary axes in rad of a joint target. One of them is None.
    external : positions of external axes in m (None where not in use), kept.
    write : puts what is corrected into the text.
    """

    source: int
    start: int
    write: Write
    T: Array | None = None
    axes: Array | None = None
    external: tuple[float | None, ...] = ()
    hint: Hint = field(default_factory=Hint)


@dataclass(frozen=True)
class Target:
    """A target with the tool and base that it is given in, once however many motions use it.

    ``line`` and ``file`` are those of the motion that uses it first.
    """

    literal: Written
    tool: FrameOf
    base: FrameOf
    file: str
    line: int


@dataclass(frozen=True)
class Program:
    """A program that can be corrected as a whole.

    Attributes
    ----------
    sources : its files, the program first. marks : where the comment that marks each file is to stand, and its text.
    targets : in the order in which motions use them first.
    notes : what was left as it is, for the user to know.
    """

    sources: tuple[Source, ...]
    targets: tuple[Target, ...]
    marks: tuple[Edit, ...]
    notes: tuple[str, ...] = ()


def frame_of_numbers(values: Array, form: Form, length: float = 1e-3) -> Array:
    """Frame (4, 4) of six numbers (seven with a quaternion) as a controller writes them; angles of abc and wpr in deg.

    KRL: A, B, C are yaw, pitch, roll (KUKA System Software, operating and programming instructions). Fanuc: W, P, R are
    roll, pitch, yaw. RAPID: quaternion, scalar first. URScript: rotation vector in rad (script manual).
    """
    place = length * np.asarray(values[:3], dtype=float)
    turn = np.asarray(values[3:], dtype=float)
    if form == "quaternion":
        return frame(_rotation(turn / np.linalg.norm(turn)), place)
    if form == "rotation_vector":
        return frame(exp_so3(turn), place)
    rpy = np.deg2rad(turn[::-1] if form == "abc" else turn)
    return frame_from_xyzrpy([*place, *rpy])


def numbers_of_frame(T: Array, old: Array, form: Form, length: float = 1e-3) -> Array:
    """Numbers of a frame in a controller's form, of all that mean the same the ones nearest to the old ones."""
    place = T[:3, 3] / length
    before = np.asarray(old[3:], dtype=float)
    if form == "quaternion":
        w = log_so3(T[:3, :3])
        angle = float(np.linalg.norm(w))
        q = np.array([np.cos(angle / 2), *(0.5 * np.sinc(angle / (2 * np.pi)) * w)])
        return np.array([*place, *(q if q @ before >= 0 else -q)])
    if form == "rotation_vector":
        w = log_so3(T[:3, :3])
        angle = float(np.linalg.norm(w))
        axis = w / angle if angle > 1e-12 else before / max(float(np.linalg.norm(before)), 1e-300)
        turns = [axis * (angle + 2 * np.pi * k) for k in range(-3, 4)]
        return np.array([*place, *min(turns, key=lambda v: float(np.sum((v - before) ** 2)))])
    roll, pitch, yaw = np.rad2deg(xyzrpy_from_frame(T)[3:])
    order = slice(None, None, -1) if form == "abc" else slice(None)
    ways = [np.array([roll, pitch, yaw])[order], np.array([roll + 180, 180 - pitch, yaw + 180])[order]]
    ways = [way - 360 * np.round((way - before) / 360) for way in ways]
    return np.array([*place, *min(ways, key=lambda v: float(np.sum((v - before) ** 2)))])


def _rotation(q: Array) -> Array:
    w, v = q[0], q[1:]
    cross = np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])
    return np.eye(3) + 2 * w * cross + 2 * cross @ cross


def frame_edits(
    text: str,
    numbers: tuple[Number, ...],
    T: Array,
    form: Form,
    digits: tuple[int, int],
    length: float = 1e-3,
    fixed: bool = False,
) -> list[Edit]:
    """Edits that write a frame into the numbers of a target; ``digits`` are least decimals of lengths and turns."""
    old = np.array([n.value for n in numbers])
    new = numbers_of_frame(T, old, form, length)
    return [
        number_edit(text, n, float(v), digits[0 if k < 3 else 1], fixed)
        for k, (n, v) in enumerate(zip(numbers, new, strict=True))
    ]
