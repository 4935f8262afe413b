"""Measurements freed of what the diagnosis found in the measuring system: a verification speaks of the robot."""

import dataclasses

import numpy as np

from robcal.calibration.joint_log import JointLog
from robcal.calibration.measurements import RobotObservations, RobotRecording
from robcal.calibration.observations import DistanceObservations, FrameObservations
from robcal.diagnosis.core.recording import Recording, observation_data
from robcal.diagnosis.core.result import Diagnosis
from robcal.physics.cause import ObservationCause
from robcal.robot.kernel_cache import kernel_of
from robcal.transforms import retract

MEASURING = ("camera", "wire", "sensor")
"""Stages whose causes displace what is measured; those of the body are judged by the frames already."""


def corrected(
    recording: RobotRecording, log: JointLog, diagnosis: Diagnosis, moves: bool = True
) -> RobotRecording | None:
    """The recording without the displacements found in the measuring system; None where there are none.

    ``moves`` : whether those that follow the order of the poses are still in it.
    Weakness: displaced targets of a body and exchanged ids are not corrected in frames.
    """
    found = [
        (f, f.cause)
        for f in diagnosis.findings
        if isinstance(f.cause, ObservationCause) and f.cause.stage in MEASURING and (moves or not f.cause.of_order)
    ]
    if not found:
        return None
    kernel = kernel_of(diagnosis.model, "converged")

    def displaced(o: RobotObservations) -> RobotObservations:
        rows = Recording(log.q, log.payload, log.recorded(), log.names, o)
        inputs = rows.inputs(kernel)
        data = observation_data(rows, kernel.frames(kernel.theta0, inputs), kernel.variables(kernel.theta0, inputs))
        shifts = (cause.observation_shift(data, f.constants) @ f.values for f, cause in found)
        shift = sum(shifts, np.zeros(()))
        if isinstance(o, FrameObservations):
            return dataclasses.replace(o, world_T_tool=retract(o.world_T_tool, -shift))
        if isinstance(o, DistanceObservations):
            return dataclasses.replace(o, distance=o.distance - shift.reshape(-1))
        return dataclasses.replace(o, p_world=o.p_world - shift)

    observations, detailed = (
        tuple(displaced(o) for o in some) for some in (recording.observations, recording.detailed)
    )
    return dataclasses.replace(recording, observations=observations, detailed=detailed)
