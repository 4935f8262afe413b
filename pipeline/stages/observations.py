"""What the robot stages work on: the measurements as observation operators, for identification and for diagnosis."""

from __future__ import annotations

import numpy as np

from pipeline.artifacts import FRAMES, POINTS
from pipeline.campaign import Campaign
from pipeline.measurement_tables import MeasuredTable
from pipeline.runs import Run
from robcal.calibration.measurements import (
    ASSUMED_SIGMA,
    RobotObservations,
    RobotRecording,
    frame_observations,
    used_points,
)
from robcal.calibration.observations import (
    DistanceObservations,
    FrameObservations,
    PointObservations,
    SensorPointObservations,
)
from robcal.errors import InvalidInput
from robcal.photogrammetry.core.bodies import Body
from robcal.transforms import Array


def build_recording(campaign: Campaign, run: Run, body: Body | None) -> RobotRecording:
    """Observations of the campaign's measurements, from tables or from the stages before.

    Raises
    ------
    InvalidInput : nothing measured, or measurements that lack the coordinates they refer to.
    """
    observations: list[RobotObservations] = []
    detailed: list[RobotObservations] = []
    stated = True
    notes: list[str] = []
    frames = run.find(FRAMES)
    if frames is not None:
        points = run.load(POINTS)
        stated &= points.covariance is not None
        if len(frames.pose):
            observations.append(frame_observations(points, frames))
            # What points of the own station tell about targets and cameras is judged in its images. The robot is
            # diagnosed on the frames with their own noise alone: what they share is told apart (common_errors).
            if points.station_jacobian is not None:
                detailed.append(FrameObservations(frames.pose, frames.world_T_body, frames.covariance))
            else:
                detailed.append(used_points(points, frames, body) or observations[-1])
    for table in campaign.measurements:
        if table.kind == "points" and frames is not None:
            continue
        made = _from_table(table, campaign, body)
        stated &= table.covariance is not None
        observations.append(made)
        detailed.append(made)
    if not observations:
        raise InvalidInput(f"{campaign.path}: nothing was measured of the robot: no pose is left to identify from")
    if not stated:
        notes.append("the measurements state no uncertainty: it is estimated from the residuals")
    return RobotRecording(tuple(observations), tuple(detailed), stated, tuple(notes))


def _from_table(table: MeasuredTable, campaign: Campaign, body: Body | None) -> RobotObservations:
    if table.kind == "frames":
        covariance = table.covariance
        if covariance is None:
            covariance = np.broadcast_to(ASSUMED_SIGMA**2 * np.eye(6), (len(table), 6, 6))
        return FrameObservations(table.pose, table.values, covariance, table.angles)
    if table.kind == "distances":
        sigma = np.full(len(table), ASSUMED_SIGMA) if table.covariance is None else np.sqrt(table.covariance)
        return DistanceObservations(table.pose, table.values, sigma)
    covariance = table.covariance
    if covariance is None:
        covariance = np.broadcast_to(ASSUMED_SIGMA**2 * np.eye(3), (len(table), 3, 3))
    if table.kind == "sensor_points":
        if body is None:
            raise InvalidInput(
                f"{table.path}: points in the sensor need the body that was looked at: list it under 'bodies' in "
                f"{campaign.path.name}"
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
