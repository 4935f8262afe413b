"""Faults of the joint log that make a fit fail: found by mending them one at a time and fitting again.

The gauge is the miss of the nominal robot in its best cell. No calibration can mend a log that slipped against the
measurements, columns that were exchanged, a joint counted the wrong way or radians under a heading of degrees; the
right one of these mends lowers the miss from decimetres to the millimetres of an uncalibrated robot.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from pipeline.poses_table import Poses, joint_columns
from pipeline.stages.observations import RobotObservations, RobotRecording, Rows
from robcal.calibration.identification import IdentifiedRobot
from robcal.calibration.observations import FrameObservations, PointObservations
from robcal.calibration.verification import fit_nominal, tool_errors
from robcal.errors import InvalidInput, RobcalError
from robcal.robot.kernel import PoseInputs
from robcal.robot.model import RobotModel
from robcal.transforms import Array

SUSPICIOUS = 0.02
"""A nominal robot that misses by less (m, at a tool of a metre where frames are measured) is just uncalibrated."""
GAIN = 4.0
"""A mend must lower the miss by this factor to be believed."""


@dataclass(frozen=True)
class Mend:
    """A fault and what the joint angles would be without it: q (k, N) at the rows of poses that it leaves usable."""

    fault: str
    remedy: str
    q: Array
    rows: Rows


def miss(robot: IdentifiedRobot, inputs: PoseInputs, observations: Sequence[RobotObservations]) -> float:
    """Root mean square of the errors (m) at the longest tool that the measurements can tell."""
    errors = tool_errors(robot.kernel.frames(robot.full_theta, inputs), observations)
    _, values = errors.get("1000", errors["0"])
    return float(np.sqrt(np.mean(values**2)))


def check_joint_log(
    robot: RobotModel, poses: Poses, inputs: PoseInputs, recording: RobotRecording, rows: Rows, nominal: IdentifiedRobot
) -> str | None:
    """Look for a fault if the nominal robot misses by far; returns a warning if none explains it.

    Raises
    ------
    InvalidInput : a fault was found; the message gives the proof.
    """
    _check_unit(poses, nominal, inputs, recording, rows)
    before = miss(nominal, inputs.subset(rows), recording.select(rows))
    if before < SUSPICIOUS:
        return None
    best: tuple[float, Mend] | None = None
    for mend in mends(robot, poses, rows):
        try:
            there = inputs.subset(mend.rows).with_q(mend.q)
            observations = recording.select(mend.rows)
            after = miss(fit_nominal(robot, there, observations), there, observations)
        except RobcalError:
            continue  # this mend makes no sense of the data, which is all that was asked
        if best is None or after < best[0]:
            best = (after, mend)
    told = f"the nominal robot misses the measurements by {before * 1000:.3g} mm (RMS) even in its best cell"
    if best is not None and best[0] * GAIN < before:
        after, mend = best
        raise InvalidInput(
            f"{poses.path}: joint angles and measurements do not belong together: {told}; {mend.fault}, then by "
            f"{after * 1000:.3g} mm: {mend.remedy}"
        )
    return f"{told}: check robot file, units and the order of the poses"


def _check_unit(
    poses: Poses, nominal: IdentifiedRobot, inputs: PoseInputs, recording: RobotRecording, rows: Rows
) -> None:
    """Coordinates in metres under a heading of millimetres: the measured ways are a thousandth of the robot's."""
    moved = nominal.kernel.frames(nominal.full_theta, inputs.subset(rows))[:, :3, 3]
    for o in recording.select(rows):
        if isinstance(o, FrameObservations):
            measured, pose = o.world_T_tool[:, :3, 3], o.pose
        elif isinstance(o, PointObservations):
            measured, pose = o.p_world, o.pose
        else:
            continue
        way, robot_way = float(np.std(measured, axis=0).max()), float(np.std(moved[pose], axis=0).max())
        if robot_way > 1e-3 and (way > 100 * robot_way or way < 0.01 * robot_way):
            raise InvalidInput(
                f"{poses.path.parent}: the measured coordinates scatter by {way * 1000:.3g} mm while the robot moved "
                f"by {robot_way * 1000:.3g} mm: columns _mm must be in millimetres, check the unit of the measurements"
            )


def mends(robot: RobotModel, poses: Poses, rows: Rows) -> Iterator[Mend]:
    """The faults that are looked for, one at a time."""
    q = poses.q
    columns = [name for name, _ in joint_columns(robot)]
    turning = [k for k, joint in enumerate(robot.joints) if not joint.prismatic]
    if turning:
        angles = q.copy()
        angles[:, turning] = np.degrees(q[:, turning])
        if np.abs(angles[:, turning]).max() < 4 * np.pi:  # degrees that are radians are all small numbers
            yield Mend("read as radians", "write degrees into the columns _deg", angles[rows], rows)
    for shift in (1, -1):
        usable = np.array([i for i in rows if 0 <= i + shift < len(q)], dtype=np.int64)
        word = "later" if shift > 0 else "earlier"
        yield Mend(
            f"with the joint angles of one row {word}",
            f"the log is slipped by one row against the measurements (pose '{poses.names[int(usable[0])]}' needs the "
            f"angles of '{poses.names[int(usable[0]) + shift]}')",
            q[usable + shift],
            usable,
        )
    for k, name in enumerate(columns):
        flipped = q[rows].copy()
        flipped[:, k] *= -1
        yield Mend(f"with {name} counted the other way", f"change 'sign' of {robot.joints[k].name}", flipped, rows)
    for a, b in combinations(range(len(columns)), 2):
        swapped = q[rows].copy()
        swapped[:, [a, b]] = swapped[:, [b, a]]
        yield Mend(f"with {columns[a]} and {columns[b]} exchanged", "exchange the two columns", swapped, rows)
