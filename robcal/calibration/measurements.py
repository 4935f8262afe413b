"""What was measured of a robot, as observation operators: for the identification and for the diagnosis."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from robcal.calibration.observations import (
    DistanceObservations,
    FrameObservations,
    PointObservations,
    SensorPointObservations,
)
from robcal.photogrammetry.core.bodies import Body
from robcal.photogrammetry.measure.frames import MeasuredFrames, unabsorbed_covariance
from robcal.photogrammetry.measure.measured_points import MeasuredPoints
from robcal.transforms import Array, transform

Rows = NDArray[np.int64]
RobotObservations = FrameObservations | PointObservations | DistanceObservations | SensorPointObservations

ASSUMED_SIGMA = 1e-4
"""Standard deviation (m, and rad for frames) of measurements that state none, until the residuals tell a better one."""

LEAST_SIGMA = 1e-7
"""Points that fit their body exactly, as calculated ones do, scatter by this (m)."""
WEAK = 10.0
"""A kept-out frame whose measurement is this many times less certain than the median says nothing about the robot."""


@dataclass(frozen=True)
class RobotRecording:
    """Measurements of a robot, by row of the table of poses.

    Attributes
    ----------
    observations : for the identification; frames where the points of a pose carry one.
    detailed : for the diagnosis: the points themselves where there are some, else the same.
    stated : whether the measurements state their uncertainty.
    weighted : factor on the stated sigmas (of positions) that the observations have, because these were contradicted.
    poses : (k,) rows of the poses that have observations.
    """

    observations: tuple[RobotObservations, ...]
    detailed: tuple[RobotObservations, ...]
    stated: bool
    notes: tuple[str, ...] = field(default=())
    weighted: float = 1.0

    @property
    def poses(self) -> Rows:
        """Rows of the poses that have observations."""
        return np.unique(np.concatenate([o.pose for o in self.observations]))

    def select(self, rows: Rows, *, detailed: bool = False) -> tuple[RobotObservations, ...]:
        """Observations of the given poses, renumbered to their order; kinds without any are left out."""
        chosen = [o.subset(rows) for o in (self.detailed if detailed else self.observations)]
        return tuple(o for o in chosen if len(o.pose))


def frame_observations(points: MeasuredPoints, frames: MeasuredFrames) -> FrameObservations:
    """Measured frames as observations: their noise, and what station and body add that no base or tool absorbs."""
    return FrameObservations(
        frames.pose, frames.world_T_body, frames.covariance + unabsorbed_covariance(points, frames)
    )


def used_points(points: MeasuredPoints, frames: MeasuredFrames, body: Body | None) -> PointObservations | None:
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


def well_measured(recording: RobotRecording, kept_out: Rows, names: Sequence[str]) -> tuple[Rows, list[str]]:
    """Kept-out poses without those of which one camera alone saw the plate, where most were measured much better."""
    frames = [o for o in recording.observations if isinstance(o, FrameObservations)]
    if len(frames) != 1 or len(recording.observations) != 1:
        return kept_out, []
    sigma = np.sqrt(np.trace(frames[0].covariance[:, :3, :3], axis1=1, axis2=2) / 3.0)
    limit = WEAK * float(np.median(sigma))
    weak = np.isin(kept_out, frames[0].pose[sigma > limit])
    if not weak.any() or np.count_nonzero(weak) > len(kept_out) / 2:
        return kept_out, []
    listed = ", ".join(names[i] for i in kept_out[weak])
    worst = 1e3 * float(sigma[np.isin(frames[0].pose, kept_out[weak])].max())
    note = (
        f"verified without {listed}: measured to {worst:.2g} mm only (usual: {1e3 * limit / WEAK:.2g} mm), which would "
        "tell of the measurement, not of the robot"
    )
    return kept_out[~weak], [note]


def evenly_weighted(frames: FrameObservations) -> FrameObservations:
    """The frames that are not measured much worse than most, all with the same isotropic covariance.

    Fitted to these, predictions agree with the measured places in their plain mean.
    """
    variance = np.trace(frames.covariance[:, :3, :3], axis1=1, axis2=2) / 3.0
    turns = np.trace(frames.covariance[:, 3:, 3:], axis1=1, axis2=2) / 3.0
    good = variance <= WEAK**2 * np.median(variance)
    even = np.diag(np.repeat([np.mean(variance[good]), np.mean(turns[good])], 3))
    count = int(good.sum())
    return FrameObservations(frames.pose[good], frames.world_T_tool[good], np.tile(even, (count, 1, 1)))


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
