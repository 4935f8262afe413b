"""What is left of the robot in force at the poses that it was identified from, in its three parts."""

import numpy as np

from robcal.calibration.calibrated import CalibratedRobot
from robcal.calibration.joint_log import JointLog
from robcal.calibration.noise_parts import NoiseParts, noise_parts
from robcal.calibration.observations import FrameObservations, PointObservations
from robcal.recipe.identification import Identification


def noise_of(identification: Identification, robot: CalibratedRobot, log: JointLog) -> NoiseParts:
    """Measurement, scatter of the joints and lack of fit, from points where there are some, else from what there is."""
    rows = identification.sound
    recording = identification.recording
    observations = recording.select(rows, detailed=True)
    # one kind at a time: points say most, since lengths between them are known
    kinds = {type(o) for o in observations}
    kind = next((k for k in (PointObservations, FrameObservations) if k in kinds), type(observations[0]))
    observations = tuple(o for o in observations if isinstance(o, kind))
    inputs = log.inputs(robot.kernel).subset(rows)
    T, _ = robot.predict(inputs)
    residuals = np.concatenate([o.evaluate(T)[0][:, :3] for o in observations])
    J = robot.kernel.joint_jacobian(robot.kernel.theta0, inputs)[:, :3]
    lever = float(np.sqrt(np.mean(np.sum(J**2, axis=(1, 2)))))
    return noise_parts(
        log.q[rows],
        residuals,
        len(robot.names),
        observations,
        stated=recording.stated,
        lever=lever,
        weighted=recording.weighted,
        left=robot.covariance_scale,
    )
