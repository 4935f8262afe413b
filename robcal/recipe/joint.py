"""The robot adjusted once more together with the marks, the cameras and the body that it was identified with."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from robcal.calibration.calibrated import CalibratedRobot
from robcal.calibration.joint_log import JointLog
from robcal.calibration.observations import FrameObservations
from robcal.calibration.verification import fit_nominal
from robcal.joint_adjustment.adjustment import adjust_jointly
from robcal.joint_adjustment.result import JointAdjustment
from robcal.photogrammetry.measure.frames import MeasuredFrames, frame_sensitivities, measure_frames
from robcal.photogrammetry.measure.measured_points import MeasuredPoints
from robcal.photogrammetry.measure.points import measure_points
from robcal.photogrammetry.station.network import StationMarks, StationOrientation
from robcal.recipe.identification import Identification
from robcal.robot.model import RobotModel
from robcal.transforms import Array, transport_covariance


@dataclass(frozen=True)
class JointlyAdjusted:
    """A robot from one adjustment, and what it is verified against.

    Attributes
    ----------
    robot : with the nominal robot in its best cell beside it.
    adjustment : as it came out.
    identification : of the stages, with the frames measured anew by the cameras as adjusted and without the poses that
        were found not to hang on the robot.
    """

    robot: CalibratedRobot = field(repr=False)
    adjustment: JointAdjustment = field(repr=False)
    identification: Identification = field(repr=False)


def adjust_robot(
    model: RobotModel,
    identification: Identification,
    robot: CalibratedRobot,
    log: JointLog,
    orientation: StationOrientation,
    marks: Mapping[str, StationMarks],
    tolerance: float | None = None,
) -> JointlyAdjusted:
    """Adjust a robot jointly with its own station.

    Parameters
    ----------
    model : the nominal robot. robot : the one in force; what is free in it is adjusted.
    orientation, marks : the station by itself, and all identified marks.
    tolerance : m, of lengths on the body, for the frames that the robot is verified against.

    Raises
    ------
    InvalidInput : no mark of a pose to identify from is left.
    DegenerateGeometry : no pose carries a frame.
    """
    found = adjust_jointly(orientation, marks, robot, log, np.flatnonzero(~log.verify))
    points = measure_points(found.orientation, marks)
    frames = measure_frames(points, found.orientation.body, tolerance=tolerance)
    detailed = FrameObservations(frames.pose, frames.world_T_body, frames.covariance)
    observed = replace(detailed, covariance=frames.covariance + _beside_the_robot(found, log, points, frames))
    recording = replace(identification.recording, observations=(observed,), detailed=(detailed,))
    used = ~np.isin(identification.rows, found.loose)
    anew = replace(identification, robot=replace(identification.robot, used=used), recording=recording)
    inputs = log.inputs(found.robot.kernel)
    nominal = fit_nominal(model, inputs.subset(anew.sound), recording.select(anew.sound))
    return JointlyAdjusted(found.robot.with_recording(log, nominal.model), found, anew)


def _beside_the_robot(found: JointAdjustment, log: JointLog, points: MeasuredPoints, frames: MeasuredFrames) -> Array:
    """(n, 6, 6) what the errors of cameras and body add to frames beyond what the robot, adjusted with them, follows.

    A frame misses the robot's prediction by ``K c - J t`` with the errors c and t of station and robot, whose joint
    covariance is known: this less the part ``J Q J'`` of the robot alone, which a verification adds itself.
    """
    kernel, columns = found.robot.kernel, found.robot.columns
    J = kernel.frames_and_jacobian(kernel.theta0, log.inputs(kernel).subset(frames.pose), columns)[1]
    by_all = np.concatenate([*frame_sensitivities(points, frames), -J], axis=2)
    return transport_covariance(by_all, found.covariance) - transport_covariance(J, found.relative)
