"""Measurements freed of what the diagnosis found in the measuring system: a verification speaks of the robot."""

from __future__ import annotations

import dataclasses

import numpy as np

from robcal.calibration.joint_log import JointLog
from robcal.calibration.measurements import RobotObservations, RobotRecording
from robcal.calibration.observations import DistanceObservations, FrameObservations
from robcal.diagnosis.core.recording import Recording, observation_data
from robcal.diagnosis.core.result import Diagnosis
from robcal.physics.cause import ObservationCause
from robcal.robot.kernel import Kernel
from robcal.transforms import Array, retract

MEASURING = ("camera", "wire", "sensor")
"""Stages whose causes displace what is measured; those of the body are judged by the frames already."""


def corrected(
    recording: RobotRecording, log: JointLog, diagnosis: Diagnosis, shared: Array | None = None
) -> RobotRecording | None:
    """The recording without the displacements found in the measuring system; None where there are none.

    `shared` (m, 6): what the own station's errors, common to all poses, displace its frames (the first observations);
    freed of them, the frames have their own noise alone.

    Weakness: displaced targets of a body and exchanged ids are not taken back from frames.
    """
    found = [
        (f, f.cause) for f in diagnosis.findings if isinstance(f.cause, ObservationCause) and f.cause.stage in MEASURING
    ]
    if not found and shared is None:
        return None
    kernel = Kernel(diagnosis.model, "converged")

    own = recording.observations[0].pose
    noise = recording.detailed[0]

    def free(o: RobotObservations) -> RobotObservations:
        if shared is not None and isinstance(o, FrameObservations) and np.array_equal(o.pose, own):
            alone = noise.covariance if isinstance(noise, FrameObservations) else o.covariance
            o = dataclasses.replace(o, world_T_tool=retract(o.world_T_tool, -shared), covariance=alone)
        return displaced(o) if found else o

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

    observations, detailed = (tuple(free(o) for o in some) for some in (recording.observations, recording.detailed))
    return dataclasses.replace(recording, observations=observations, detailed=detailed)
