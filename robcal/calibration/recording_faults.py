"""Faults of the recording that make a fit fail, told with the proof: the miss of the nominal robot after mending."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from robcal.calibration.identification import IdentifiedRobot
from robcal.calibration.measurements import RobotRecording
from robcal.calibration.observations import DistanceObservations, FrameObservations, PointObservations
from robcal.calibration.slips import Slip, find_slips
from robcal.calibration.slips.search import SUSPICIOUS_SHARE
from robcal.errors import InvalidInput
from robcal.robot.kernel import Kernel, PoseInputs
from robcal.robot.model import RobotModel

FAILED = 10.0
"""sigma0 of the stated uncertainty above which a fit counts as failed."""
MOST_POSES = 300
MOST_TOLD = 4
"""Candidates that are listed where the data cannot tell which."""
HOPELESS, HOPELESS_SHARE = 0.01, 0.02
"""Miss (m, and as a share of the way of the tool) of an identified robot above which it is no robot's."""


def check_joint_log(robot: RobotModel, inputs: PoseInputs, recording: RobotRecording, kernel: Kernel) -> list[Slip]:
    """Refuse recordings in which joint angles and measurements do not belong together.

    Returns
    -------
    What the robot has every right to be (other zeros, another length) but its file does not say: to be told.

    Raises
    ------
    InvalidInput : a slip explains the miss; the message gives the proof and the remedy, and all candidates.
    """
    _check_unit(inputs, recording, kernel)
    found = find_slips(robot, inputs, recording.observations)
    if found and not found[0].legitimate:
        raise InvalidInput(f"joint angles and measurements do not belong together: {told(found)}")
    return found


def check_failed_fit(
    robot: RobotModel, inputs: PoseInputs, recording: RobotRecording, kernel: Kernel, found: IdentifiedRobot
) -> None:
    """Where even the identified robot misses by many sigmas, look for smaller slips (a sign of the last joint, say).

    Raises
    ------
    InvalidInput : a fault that explains the miss was found (the message gives the proof and the remedy), or the miss is
        beyond anything that a robot does.
    """
    if found.sigma0 < FAILED:
        return
    rows = np.arange(min(len(inputs), MOST_POSES))
    few = replace(recording, observations=recording.select(rows))
    fault = fault_of(robot, inputs.subset(rows), few, share=0.0)
    if fault:
        raise InvalidInput(f"joint angles and measurements do not belong together: {fault}")
    T = found.kernel.frames(found.kernel.theta0, inputs)
    miss = float(np.sqrt(np.mean(np.concatenate([o.evaluate(T)[0].ravel() ** 2 for o in recording.observations]))))
    size = float(np.linalg.norm(np.std(T[:, :3, 3], axis=0)))
    if miss > max(HOPELESS, HOPELESS_SHARE * size):
        raise InvalidInput(
            f"even the identified robot misses the measurements by {1e3 * miss:.3g} mm RMS: joint "
            "angles, robot file and measurements do not belong together, and no single slip (sign, unit, exchanged "
            "columns, shifted rows) explains it: check which recording belongs to which"
        )


def fault_of(robot: RobotModel, inputs: PoseInputs, recording: RobotRecording, share: float = SUSPICIOUS_SHARE) -> str:
    """The likeliest slip with proof and remedy; empty if there is none."""
    return told([s for s in find_slips(robot, inputs, recording.observations, share) if not s.legitimate])


def told(slips: Sequence[Slip]) -> str:
    """Slips in a sentence: the likeliest with proof and remedy, then the others that explain as much."""
    if not slips:
        return ""
    others = [f"{slip.statement.split(': mending')[0]} ({slip.remedy})" for slip in slips[1:MOST_TOLD]]
    also = f"; the recording alone cannot tell this from: {'; or '.join(others)}" if others else ""
    return f"{slips[0].statement}: {slips[0].remedy}{also}"


def _check_unit(inputs: PoseInputs, recording: RobotRecording, kernel: Kernel) -> None:
    """Coordinates in metres under a heading of millimetres: the measured ways are a thousandth of the robot's."""
    moved = kernel.with_references(np.eye(4), np.eye(4)).frames(kernel.theta0, inputs)[:, :3, 3]
    for o in recording.observations:
        if isinstance(o, FrameObservations):
            measured = o.world_T_tool[:, :3, 3]
        elif isinstance(o, PointObservations):
            measured = o.p_world
        elif isinstance(o, DistanceObservations):
            measured = o.distance[:, None]
        else:
            continue
        way, robot_way = float(np.std(measured, axis=0).max()), float(np.std(moved[o.pose], axis=0).max())
        if robot_way > 1e-3 and (way > 100 * robot_way or way < 0.01 * robot_way):
            raise InvalidInput(
                f"the measured coordinates scatter by {way * 1000:.3g} mm while the robot moved "
                f"by {robot_way * 1000:.3g} mm: columns _mm must be in millimetres, check the unit of the measurements"
            )
