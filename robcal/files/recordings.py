"""Recordings from files: the joint log of a robot, and what was measured of it."""

from pathlib import Path

import numpy as np

from robcal.calibration.joint_log import JointLog
from robcal.calibration.measurements import ASSUMED_SIGMA, RobotObservations, RobotRecording
from robcal.calibration.observations import (
    DistanceObservations,
    FrameObservations,
    PointObservations,
    SensorPointObservations,
)
from robcal.errors import InvalidInput
from robcal.files.measurement_tables import MeasuredTable, read_measurements
from robcal.files.poses_table import read_poses
from robcal.photogrammetry.core.bodies import Body
from robcal.robot.model import RobotModel
from robcal.transforms import Array


def read_joint_log(path: Path | str, robot: RobotModel) -> JointLog:
    """The poses of a robot from a CSV file: ``pose``, ``q1_deg`` (``q1_mm`` of a sliding joint), ..., and where known
    ``payload``, ``set`` (``identify`` or ``verify``), ``time_s``, ``temp_<place>_c``, ``approach1``, ...

    Raises
    ------
    InvalidInput : the table contradicts itself or the robot, or a pose is beyond a joint's range.
    """
    log = read_poses(Path(path), robot, robot.payloads)
    if log.outside:
        raise InvalidInput(log.outside)
    return log


def read_recording(path: Path | str, log: JointLog, body: Body | None = None) -> RobotRecording:
    """What was measured of a robot, from a CSV file in mm and degrees; its columns tell what it is.

    Frames have ``pose, x_mm, y_mm, z_mm, roll_deg, pitch_deg, yaw_deg``, points ``pose, target, x_mm, y_mm, z_mm``,
    distances ``pose, distance_mm``; ``sigma_mm`` states the standard deviation (``docs/formats.md`` has all columns).

    Parameters
    ----------
    log : the poses that the table refers to. body : coordinates of the targets of points, in the tool's frame.

    Raises
    ------
    InvalidInput : not such a table, an unknown pose, a target without coordinates.
    """
    table = read_measurements(Path(path), log.names)
    made = observations_of(table, body)
    return RobotRecording((made,), (made,), table.covariance is not None, table.notes)


def observations_of(table: MeasuredTable, body: Body | None) -> RobotObservations:
    """A table as observations; the body gives the coordinates of its targets.

    Raises
    ------
    InvalidInput : a target without coordinates.
    """
    if table.kind == "frames":
        covariance = table.covariance
        if covariance is None:
            covariance = np.broadcast_to(ASSUMED_SIGMA**2 * np.eye(6), (len(table), 6, 6))
        return FrameObservations(table.pose, table.values, covariance, table.angles)
    if table.kind == "distances":
        sigma = np.full(len(table), ASSUMED_SIGMA) if table.covariance is None else np.sqrt(table.covariance)
        return DistanceObservations(table.pose, table.values, sigma)
    if table.kind == "constraints":
        raise InvalidInput(f"{table.path}: closed loops have worlds of their own: list the table in a campaign")
    covariance = table.covariance
    if covariance is None:
        covariance = np.broadcast_to(ASSUMED_SIGMA**2 * np.eye(3), (len(table), 3, 3))
    if table.kind == "sensor_points":
        if body is None:
            raise InvalidInput(
                f"{table.path}: points in the sensor need the body that was looked at: list it under 'bodies'"
            )
        return SensorPointObservations(table.pose, table.values, _coordinates(table, body), covariance)
    return PointObservations(table.pose, _on_tool(table, body), table.values, covariance, table.target)


def _coordinates(table: MeasuredTable, body: Body) -> Array:
    at = body.index(table.target)
    unknown = (at < 0) | ~body.known[at]
    if unknown.any():
        i = int(np.argmax(unknown))
        raise InvalidInput(
            f"{table.path}, row {int(table.rows[i])}: target {int(table.target[i])} has no coordinates in body "
            f"'{body.name}': give them, or a survey of the body"
        )
    return body.points[at]


def _on_tool(table: MeasuredTable, body: Body | None) -> Array:
    """Places of single targets on the tool: those of the body; a lone target without coordinates is the tool itself."""
    if body is not None and np.isfinite(body.points).all(axis=1).any():
        return _coordinates(table, body)
    targets = np.unique(table.target)
    if len(targets) > 1:
        raise InvalidInput(
            f"{table.path}: {len(targets)} targets without coordinates, fewer than three of them in a pose: list them "
            "with coordinates in a body"
        )
    return np.zeros((len(table), 3))
