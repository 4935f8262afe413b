"""Errors that all poses share, as the diagnosis takes them: orientation of the station, coordinates of the body."""

from __future__ import annotations

import numpy as np

from pipeline.stages.observations import RobotObservations, RobotRecording, Rows
from robcal.calibration.observations import FrameObservations, PointObservations
from robcal.photogrammetry.bodies import Body
from robcal.photogrammetry.measured_points import MeasuredPoints
from robcal.transforms import Array


def common_errors(
    observations: RobotObservations, recording: RobotRecording, rows: Rows, body: Body | None,
    points: MeasuredPoints | None,
) -> Array | None:
    """(m, 3, k) displacements of points by one standard deviation of the errors that station and body give to all."""
    if not isinstance(observations, PointObservations):
        return None
    columns: list[Array] = []
    if points is not None and points.station_jacobian is not None and points.station_covariance is not None:
        place = {(int(p), int(t)): i for i, (p, t) in enumerate(zip(points.pose, points.target, strict=True))}
        pairs = zip(observations.pose, observations.target, strict=True)
        at = np.array([place.get((int(rows[p]), int(t)), -1) for p, t in pairs])
        moved = points.station_jacobian[at] @ _root(points.station_covariance)
        columns.append(np.where(at[:, None, None] >= 0, moved, 0.0))
    turns = _turns(recording, rows)
    if body is not None and body.covariance is not None and turns is not None and np.any(body.covariance):
        root = _root(np.nan_to_num(body.covariance)).reshape(len(body.ids), 3, -1)
        columns.append(turns[observations.pose] @ root[body.index(observations.target)])
    return np.concatenate(columns, axis=2) if columns else None


def _root(covariance: Array) -> Array:
    """Columns whose products sum to a covariance; directions without variance are left out."""
    values, vectors = np.linalg.eigh(covariance)
    keep = values > 1e-9 * values.max(initial=0.0)
    return vectors[:, keep] * np.sqrt(values[keep])


def _turns(recording: RobotRecording, rows: Rows) -> Array | None:
    """Measured orientation (n, 3, 3) of the body at the given poses, zero where there is none."""
    for observations in recording.select(rows):
        if isinstance(observations, FrameObservations):
            turns = np.zeros((len(rows), 3, 3))
            turns[observations.pose] = observations.world_T_tool[:, :3, :3]
            return turns
    return None
