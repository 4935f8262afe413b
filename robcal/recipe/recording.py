"""A recording as the diagnosis takes it, with the errors that all poses share: of the station, of the body."""

import numpy as np

from robcal.calibration.joint_log import JointLog
from robcal.calibration.measurements import RobotObservations, RobotRecording, Rows
from robcal.calibration.observations import FrameObservations, PointObservations
from robcal.diagnosis.core.recording import Recording
from robcal.photogrammetry.core.bodies import Body
from robcal.photogrammetry.measure.measured_points import MeasuredPoints
from robcal.photogrammetry.station.network import StationOrientation
from robcal.transforms import Array


def recording_for_diagnosis(
    log: JointLog,
    recording: RobotRecording,
    rows: Rows,
    body: Body | None,
    points: MeasuredPoints | None = None,
    orientation: StationOrientation | None = None,
) -> Recording | None:
    """The measurements of some poses in the form the diagnosis takes: the kind with the most of them."""
    chosen = recording.select(rows, detailed=True)
    if not chosen:
        return None
    observations = max(chosen, key=lambda o: len(o.pose) * o.dimension)
    return Recording(
        q=log.q[rows],
        payload=tuple(log.payload[i] for i in rows),
        covariates={name: values[rows] for name, values in log.recorded().items()},
        names=tuple(log.names[i] for i in rows),
        observations=observations,
        body=body.name if body is not None else "body",
        ids=tuple(int(i) for i in body.ids) if body is not None else (),
        common=common_errors(observations, recording, rows, body, points, orientation),
        own_station=orientation is not None and isinstance(observations, FrameObservations),
    )


def common_errors(
    observations: RobotObservations,
    recording: RobotRecording,
    rows: Rows,
    body: Body | None,
    points: MeasuredPoints | None,
    orientation: StationOrientation | None = None,
) -> Array | None:
    """Displacements by one standard deviation of the errors that station and body give to all.

    (m, 3, k) of points, (m, 6, k) of the frames of an own station; None where nothing is known of such errors.
    """
    if isinstance(observations, FrameObservations) and orientation is not None:
        return _of_frames(observations, rows, orientation)
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


def _of_frames(observations: FrameObservations, rows: Rows, orientation: StationOrientation) -> Array:
    """The share that cameras and body have in the poses of the station's adjustment: exactly its joint covariance.

    Weakness: poses that the adjustment did not use count as free of it.
    """
    moved = orientation.design.pose_response @ _root(orientation.design.reduced_inverse)
    place = {int(p): i for i, p in enumerate(orientation.poses)}
    at = np.array([place.get(int(rows[p]), -1) for p in observations.pose])
    return np.where(at[:, None, None] >= 0, moved[at], 0.0)


def _root(covariance: Array) -> Array:
    """Columns whose products sum to a covariance (of mixed units); directions without variance are left out."""
    size = np.sqrt(np.clip(np.diag(covariance), 0.0, None))
    safe = np.where(size > 0, size, 1.0)
    values, vectors = np.linalg.eigh(covariance / np.outer(safe, safe))
    keep = values > 1e-10 * values.max(initial=0.0)
    return size[:, None] * vectors[:, keep] * np.sqrt(values[keep])


def _turns(recording: RobotRecording, rows: Rows) -> Array | None:
    """Measured orientation (n, 3, 3) of the body at the given poses, zero where there is none."""
    for observations in recording.select(rows):
        if isinstance(observations, FrameObservations):
            turns = np.zeros((len(rows), 3, 3))
            turns[observations.pose] = observations.world_T_tool[:, :3, :3]
            return turns
    return None
