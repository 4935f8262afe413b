"""Denavit-Hartenberg tables as chains of this project: standard, modified (Craig) and with Hayati's angle.

One row moves by ``Rz(theta + q) Tz(d) Tx(a) Rx(alpha) Ry(beta)`` (standard; ``beta`` after Hayati and Mirmirani 1985
for nearly parallel axes, usually with d = 0) or ``Rx(alpha) Tx(a) Ry(beta) Rz(theta + q) Tz(d)`` (modified, Craig). A
sliding joint adds q to d. Both are exactly expressible: what stands behind a joint's turn moves into the frame behind.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from robcal.errors import InvalidInput
from robcal.robot.model import Frame
from robcal.transforms import Array, frame, frame_from_xyzrpy, rotation_from_rpy, rpy_from_rotation

_NEGLIGIBLE = 1e-15
_NEAR, _FAR = 2.0, 20.0


@dataclass(frozen=True)
class DHRow:
    """One row of a table, metres and radians.

    Attributes
    ----------
    theta, d, a, alpha : the four parameters; the joint value is added to theta, or to d of a sliding joint.
    beta : Hayati's turn about y for nearly parallel axes, else 0.
    sign : +1 or -1, sense of q.
    limits : of q; name : of the frame, default ``axis1``, ``axis2``, ...
    """

    theta: float = 0.0
    d: float = 0.0
    a: float = 0.0
    alpha: float = 0.0
    beta: float = 0.0
    prismatic: bool = False
    sign: int = 1
    limits: tuple[float, float] | None = None
    name: str | None = None


def frames_from_dh(
    rows: Sequence[DHRow], convention: Literal["standard", "modified"] = "standard", flange: Array | None = None
) -> tuple[Frame, ...]:
    """Frames of a chain that moves exactly as the table says; the last one is the fixed frame ``flange``.

    Parameters
    ----------
    flange : (4, 4) fixed frame behind the last row, default identity.

    Raises
    ------
    InvalidInput : no rows, numbers that are not finite, an unknown convention, angles that look like degrees, or links
        that look like millimetres (offsets of nearly parallel axes that cancel are none).
    """
    if not rows:
        raise InvalidInput("the Denavit-Hartenberg table has no rows")
    if convention not in ("standard", "modified"):
        raise InvalidInput(f"convention must be standard or modified, not '{convention}'")
    for number, row in enumerate(rows, start=1):
        _check(row, number)
    # The table as alternating joints Rz(theta + q) Tz(d) and links (Tx(a) Rx(alpha) Ry(beta)).
    links = [_link(row) for row in rows]
    if convention == "modified":
        lead, links = links[0], [*links[1:], np.eye(4)]
    else:
        lead = np.eye(4)
    frames: list[Frame] = []
    # a turn before the first joint cannot stand in that joint's own frame: its yaw is the joint
    if np.max(np.abs(lead[:3, :3] - np.eye(3))) > _NEGLIGIBLE:
        frames.append(Frame("mount", None, xyz=_triple(lead[:3, 3]), rpy=_triple(rpy_from_rotation(lead[:3, :3]))))
        carry = np.zeros(3)
    else:
        carry = lead[:3, 3]
    for number, (row, link) in enumerate(zip(rows, links, strict=True), start=1):
        # Rz(theta + q) Trans(0, 0, d) link = [Rz(theta + q) R_link] Trans(R_link' ((0, 0, d) + t_link))
        roll, pitch, yaw = rpy_from_rotation(link[:3, :3])
        # tables of nearly parallel axes (UR's factory calibration) hold offsets of hundreds of metres that cancel; the
        # origin may stand anywhere on the joint's line, so it stays near the robot
        shift = carry[2] if abs(carry[2]) > _NEAR and not row.prismatic else 0.0
        carry = carry - [0.0, 0.0, shift]
        along = np.array([0.0, 0.0, row.d + shift])
        xyz = carry + along if row.prismatic else carry
        behind = link[:3, 3] if row.prismatic else along + link[:3, 3]
        rpy = (float(roll), float(pitch), float(row.theta + yaw))
        name = row.name or f"axis{number}"
        frames.append(Frame(name, "z", row.prismatic, row.sign, row.limits, _triple(xyz), rpy))
        carry = link[:3, :3].T @ behind
    end = frame(np.eye(3), carry) @ (np.eye(4) if flange is None else np.asarray(flange, dtype=float))
    places = np.array([*(f.xyz for f in frames), end[:3, 3]])
    if np.max(np.abs(places)) > _FAR:
        raise InvalidInput(f"Denavit-Hartenberg: a link is longer than {_FAR:g} m; are the lengths in millimetres?")
    frames.append(Frame("flange", None, xyz=_triple(end[:3, 3]), rpy=_triple(rpy_from_rotation(end[:3, :3]))))
    return tuple(frames)


def dh_matrix(row: DHRow, q: float, convention: Literal["standard", "modified"] = "standard") -> Array:
    """The row's own matrix (4, 4) for a joint value: the closed form, for checks."""
    turn, slide = (0.0, row.sign * q) if row.prismatic else (row.sign * q, 0.0)
    joint = frame_from_xyzrpy([0.0, 0.0, row.d + slide, 0.0, 0.0, row.theta + turn])
    link = _link(row)
    return link @ joint if convention == "modified" else joint @ link


def _link(row: DHRow) -> Array:
    R = rotation_from_rpy([row.alpha, 0.0, 0.0]) @ rotation_from_rpy([0.0, row.beta, 0.0])
    return frame(R, [row.a, 0.0, 0.0])


def _check(row: DHRow, number: int) -> None:
    numbers = (row.theta, row.d, row.a, row.alpha, row.beta)
    if not all(math.isfinite(v) for v in numbers):
        raise InvalidInput(f"Denavit-Hartenberg row {number}: a number is not finite")
    if max(abs(row.theta), abs(row.alpha), abs(row.beta)) > 4.0 * math.pi:
        raise InvalidInput(f"Denavit-Hartenberg row {number}: an angle exceeds two turns; are the angles in degrees?")


def _triple(values: Array) -> tuple[float, float, float]:
    x, y, z = (float(v) for v in values)
    return x, y, z
