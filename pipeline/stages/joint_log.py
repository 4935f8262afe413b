"""Faults of the recording that make a fit fail, told with the proof: the miss of the nominal robot after mending."""

from __future__ import annotations

import numpy as np

from pipeline.poses_table import Poses
from pipeline.stages.observations import RobotRecording
from robcal.calibration.observations import FrameObservations, PointObservations
from robcal.calibration.plausibility import likely_causes
from robcal.errors import InvalidInput
from robcal.robot.kernel import Kernel, PoseInputs
from robcal.robot.model import RobotModel

_REMEDIES = {
    "slipped_rows": "bring poses and measurements together again",
    "exchanged_columns": "exchange the two columns",
    "wrong_sign": "change 'sign' of this joint in the robot file",
    "wrong_unit": "write degrees into the columns _deg",
    "measured_columns": "correct the columns of the measurements",
    "measured_unit": "write degrees into the columns _deg of the measurements",
}


def check_joint_log(
    robot: RobotModel, poses: Poses, inputs: PoseInputs, recording: RobotRecording, kernel: Kernel
) -> None:
    """Refuse recordings in which joint angles and measurements do not belong together.

    Raises
    ------
    InvalidInput : a fault that explains the miss was found; the message gives the proof and the remedy.
    """
    _check_unit(poses, inputs, recording, kernel)
    found = likely_causes(robot, inputs, recording.observations, kernel)
    if found:
        best = found[0]
        raise InvalidInput(
            f"{poses.path}: joint angles and measurements do not belong together: {best.statement}: "
            f"{_REMEDIES.get(best.kind, 'correct the recording')}"
        )


def _check_unit(poses: Poses, inputs: PoseInputs, recording: RobotRecording, kernel: Kernel) -> None:
    """Coordinates in metres under a heading of millimetres: the measured ways are a thousandth of the robot's."""
    moved = kernel.with_references(np.eye(4), np.eye(4)).frames(kernel.theta0, inputs)[:, :3, 3]
    for o in recording.observations:
        if isinstance(o, FrameObservations):
            measured = o.world_T_tool[:, :3, 3]
        elif isinstance(o, PointObservations):
            measured = o.p_world
        else:
            continue
        way, robot_way = float(np.std(measured, axis=0).max()), float(np.std(moved[o.pose], axis=0).max())
        if robot_way > 1e-3 and (way > 100 * robot_way or way < 0.01 * robot_way):
            raise InvalidInput(
                f"{poses.path.parent}: the measured coordinates scatter by {way * 1000:.3g} mm while the robot moved "
                f"by {robot_way * 1000:.3g} mm: columns _mm must be in millimetres, check the unit of the measurements"
            )
