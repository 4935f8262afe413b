"""What the robot stages work on: the measurements as observation operators, for identification and for diagnosis."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from pipeline.campaign import Campaign
from pipeline.measurement_tables import MeasuredTable
from pipeline.runs import Run
from robcal.calibration.observations import (
    DistanceObservations,
    FrameObservations,
    PointObservations,
    SensorPointObservations,
)
from robcal.errors import InvalidInput
from robcal.photogrammetry.core.bodies import Body
from robcal.photogrammetry.measure.frames import MeasuredFrames
from robcal.photogrammetry.measure.measured_points import MeasuredPoints
from robcal.photogrammetry.measure.shared_errors import unabsorbed_covariance
from robcal.transforms import Array, transform

Rows = NDArray[np.int64]
RobotObservations = FrameObservations | PointObservations | DistanceObservations | SensorPointObservations

ASSUMED_SIGMA = 1e-4
"""Standard deviation (m, and rad for frames) of measurements that state none, until the residuals tell a better one."""

LEAST_SIGMA = 1e-7
"""Points that fit their body exactly, as calculated ones do, scatter by this (m)."""


@dataclass(frozen=True)
class RobotRecording:
    """Measurements of a robot, by row of the table of poses.

    Attributes
    ----------
    observations : for the identification; frames where the points of a pose carry one.
    detailed : for the diagnosis: the points themselves where there are some, else the same.
    stated : whether the measurements state their uncertainty.
    poses : (k,) rows of the poses that have observations.
    """

    observations: tuple[RobotObservations, ...]
    detailed: tuple[RobotObservations, ...]
    stated: bool
    notes: tuple[str, ...] = field(default=())

    @property
    def poses(self) -> Rows:
        """Rows of the poses that have observations."""
        return np.unique(np.concatenate([o.pose for o in self.observations]))

    def select(self, rows: Rows, *, detailed: bool = False) -> tuple[RobotObservations, ...]:
        """Observations of the given poses, renumbered to their order; kinds without any are left out."""
        chosen = [o.subset(rows) for o in (self.detailed if detailed else self.observations)]
        return tuple(o for o in chosen if len(o.pose))


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
    if run.record("frames") is not None and run.has("frames"):
        frames: MeasuredFrames = run.load("frames")
        points: MeasuredPoints = run.load("points")
        stated &= points.covariance is not None
        if len(frames.pose):
            observations.append(frame_observations(points, frames))
            # What points of the own station tell about targets and cameras is judged in its images. The robot is
            # diagnosed on the frames with their own noise alone: what they share is told apart (common_errors).
            if points.station_jacobian is not None:
                detailed.append(FrameObservations(frames.pose, frames.world_T_body, frames.covariance))
            else:
                detailed.append(_used_points(points, frames, body) or observations[-1])
    for table in campaign.measurements:
        if table.kind == "points" and observations and run.has("frames"):
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


def frame_observations(points: MeasuredPoints, frames: MeasuredFrames) -> FrameObservations:
    """Measured frames as observations: their noise, and what station and body add that no base or tool absorbs."""
    return FrameObservations(
        frames.pose, frames.world_T_body, frames.covariance + unabsorbed_covariance(points, frames)
    )


def _used_points(points: MeasuredPoints, frames: MeasuredFrames, body: Body | None) -> PointObservations | None:
    """The points that were not rejected, of bodies with coordinates; None where frames come from resections."""
    if body is None:
        return None
    at = body.index(points.target)
    rejected = {(p.pose, p.target) for p in frames.rejected_points}
    kept = np.array(
        [(int(p), int(t)) not in rejected for p, t in zip(points.pose, points.target, strict=True)], dtype=bool
    )
    usable = (at >= 0) & kept & np.isin(points.pose, frames.pose)
    usable[usable] &= body.known[at[usable]]
    several = (points.n_cameras == 0) | (points.n_cameras > 1)
    usable &= several
    if set(np.unique(points.pose[usable])) != set(np.unique(frames.pose)):
        return None
    pose, on_body, measured = points.pose[usable], body.points[at[usable]], points.p_world[usable]
    if points.covariance is not None:
        covariance = points.covariance[usable]
    else:
        covariance = np.tile(_scatter(pose, on_body, measured, frames) ** 2 * np.eye(3), (len(pose), 1, 1))
    return PointObservations(pose, on_body, measured, covariance, points.target[usable])


def _scatter(pose: Rows, on_body: Array, measured: Array, frames: MeasuredFrames) -> float:
    """Standard deviation (m) of points that state none, from how they scatter about the frames that they carry."""
    order = np.argsort(frames.pose)
    T = frames.world_T_body[order[np.searchsorted(frames.pose[order], pose)]]
    left = measured - transform(T, on_body)
    redundancy = 3 * len(pose) - 6 * len(np.unique(pose))
    return max(float(np.sqrt(np.sum(left**2) / redundancy)), LEAST_SIGMA) if redundancy > 0 else ASSUMED_SIGMA


def _from_table(table: MeasuredTable, campaign: Campaign, body: Body | None) -> RobotObservations:
    if table.kind == "frames":
        covariance = table.covariance
        if covariance is None:
            covariance = np.broadcast_to(ASSUMED_SIGMA**2 * np.eye(6), (len(table), 6, 6))
        return FrameObservations(table.pose, table.values, covariance)
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


def rescaled(observations: Sequence[RobotObservations], variances: Sequence[Array]) -> tuple[RobotObservations, ...]:
    """Observations with other variances: a factor for each kind (for frames, one of position and one of rotation)."""
    out: list[RobotObservations] = []
    for o, factor in zip(observations, variances, strict=True):
        if isinstance(o, FrameObservations):
            scale = np.sqrt(np.repeat(factor, 3))
            out.append(replace(o, covariance=o.covariance * np.outer(scale, scale)))
        elif isinstance(o, DistanceObservations):
            out.append(replace(o, sigma=o.sigma * np.sqrt(factor[0])))
        else:
            out.append(replace(o, covariance=o.covariance * factor[0]))
    return tuple(out)
