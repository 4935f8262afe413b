"""Identification from measurements that state no uncertainty: variance components from the residuals."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from robcal.calibration.identification import IdentifiedRobot, IdentifyOptions, identify
from robcal.calibration.measurements import RobotObservations, RobotRecording, Rows, rescaled
from robcal.calibration.observations import FrameObservations
from robcal.robot.kernel import Kernel, PoseInputs
from robcal.robot.model import RobotModel
from robcal.transforms import Array


def identify_recording(
    robot: RobotModel,
    inputs: PoseInputs,
    recording: RobotRecording,
    rows: Rows,
    options: IdentifyOptions,
    kernel: Kernel,
) -> tuple[IdentifiedRobot, RobotRecording]:
    """Identify; where no uncertainty is stated, estimate variance components from the residuals and do so again."""
    subset = inputs.subset(rows)
    found = identify(robot, subset, recording.select(rows), options, kernel)
    for _ in range(0 if recording.stated else 2):
        factors = variance_factors(found, subset, recording.select(rows), recording.observations)
        observations = rescaled(recording.observations, factors)
        # points tell by their body how they scatter; what they carry, frames, follows the robot's residuals
        pairs = zip(recording.detailed, recording.observations, observations, strict=True)
        detailed = tuple(new if own is old else own for own, old, new in pairs)
        recording = replace(recording, observations=observations, detailed=detailed)
        found = identify(robot, subset, recording.select(rows), options, kernel)
    return found, recording


def variance_factors(
    found: IdentifiedRobot, inputs: PoseInputs, used: Sequence[RobotObservations], kinds: Sequence[RobotObservations]
) -> list[Array]:
    """Factor by which the variances of each kind are too small: (2,) position and rotation of frames, else (1,).

    Every group's sum of squares is set against its share of the redundancy, which is taken as even.
    """
    T = found.kernel.frames(found.kernel.theta0, inputs)
    share = found.redundancy / max(found.redundancy + len(found.names), 1)
    factors: list[Array] = []
    remaining = list(used)
    for kind in kinds:
        mine = next((o for o in remaining if type(o) is type(kind)), None)
        if mine is None:
            factors.append(np.ones(2 if isinstance(kind, FrameObservations) else 1))
            continue
        remaining.remove(mine)
        keep = found.used[mine.pose]
        r, _ = mine.evaluate(T)
        white = np.linalg.solve(np.linalg.cholesky(mine.noise(T)), r[..., None])[..., 0][keep]
        groups = [white[:, :3], white[:, 3:]] if isinstance(kind, FrameObservations) else [white]
        factors.append(np.array([max(float(np.mean(g**2)) / max(share, 0.05), 1e-12) for g in groups]))
    return factors
