"""Measured points and poses of a body: the types between the station (or any other measuring system) and the robot."""

from dataclasses import dataclass

import numpy as np

from robcal.errors import InvalidInput
from robcal.photogrammetry.core.bodies import IntArray
from robcal.transforms import Array


@dataclass(frozen=True)
class RejectedPoint:
    """A point left out: pose number, target id and why."""

    pose: int
    target: int
    reason: str


@dataclass(frozen=True)
class Exchange:
    """Two targets that carried each other's number in some poses.

    Attributes
    ----------
    targets : the two numbers, the smaller first. poses : numbers of the poses.
    before, after : m, median deviation of the lengths to the other targets as recorded, and with the numbers exchanged.
    """

    targets: tuple[int, int]
    poses: tuple[int, ...]
    before: float
    after: float


@dataclass(frozen=True)
class ResectedPoses:
    """Poses from all marks of the body at once, used where too few targets are seen by two cameras.

    ``pose`` (k,), ``world_T_body`` (k, 4, 4), ``covariance`` (k, 6, 6) from the marks, ``common_covariance`` (k, 6, 6)
    from station and body (right perturbation, translation first), ``n_cameras`` (k,), ``targets`` ids per pose.
    """

    pose: IntArray
    world_T_body: Array
    covariance: Array
    common_covariance: Array
    n_cameras: IntArray
    targets: tuple[tuple[int, ...], ...]


@dataclass(frozen=True)
class MeasuredPoints:
    """Targets measured in the world, one row per pose and target.

    Attributes
    ----------
    pose : (m,) pose numbers; target : (m,) ids.
    p_world : (m, 3) m.
    covariance : (m, 3, 3) m^2, the part that is independent from point to point; None where nothing is stated.
    n_cameras : (m,) cameras that saw it; 0 for another measuring system, 1 for points that come from a resection:
        those of one pose are not independent of one another, use ``resected`` for frames.
    residual : (m,) root of chi-square by redundancy of the intersection, NaN without redundancy.
    station_jacobian : (m, 3, k) derivative by the station's parameters, station_covariance (k, k); None if not known.
    resected : poses by resection. rejected : points left out, with reason.
    exchanges : numbers that were exchanged in some poses, and are right here.
    inconsistent_poses : poses in which most rays miss one another: evidence, nothing was left out for it.
    """

    pose: IntArray
    target: IntArray
    p_world: Array
    covariance: Array | None
    n_cameras: IntArray
    residual: Array
    station_jacobian: Array | None = None
    station_covariance: Array | None = None
    resected: ResectedPoses | None = None
    rejected: tuple[RejectedPoint, ...] = ()
    inconsistent_poses: tuple[int, ...] = ()
    exchanges: tuple[Exchange, ...] = ()

    def __post_init__(self) -> None:
        m = len(self.pose)
        if np.shape(self.target) != (m,) or np.shape(self.p_world) != (m, 3):
            raise InvalidInput("measured points: pose, target and coordinates must have one row per point")
        if not np.isfinite(self.p_world).all():
            row = int(np.flatnonzero(~np.isfinite(self.p_world).all(axis=1))[0])
            raise InvalidInput(f"point {row} (pose {self.pose[row]}, target {self.target[row]}) is not a number")
        if self.covariance is not None and np.shape(self.covariance) != (m, 3, 3):
            raise InvalidInput(f"covariance of {m} points must be ({m}, 3, 3), got {np.shape(self.covariance)}")
        key = np.column_stack([self.pose, self.target])
        values, counts = np.unique(key, axis=0, return_counts=True)
        if np.any(counts > 1):
            pose, target = values[counts > 1][0]
            raise InvalidInput(f"target {target} is listed more than once in pose {pose}: keep one row")

    @classmethod
    def from_table(
        cls, pose: Array, target: Array, p_world: Array, covariance: Array | None = None
    ) -> "MeasuredPoints":
        """Points of any measuring system; ``covariance`` (m, 3, 3) m^2 or None."""
        m = len(pose)
        return cls(
            np.asarray(pose, dtype=np.int64),
            np.asarray(target, dtype=np.int64),
            np.asarray(p_world, dtype=float),
            None if covariance is None else np.asarray(covariance, dtype=float),
            np.zeros(m, dtype=np.int64),
            np.full(m, np.nan),
        )

    @property
    def total_covariance(self) -> Array | None:
        """(m, 3, 3) noise plus what the station's uncertainty adds."""
        if self.covariance is None or self.station_jacobian is None or self.station_covariance is None:
            return self.covariance
        J = self.station_jacobian
        return self.covariance + J @ self.station_covariance @ np.swapaxes(J, -1, -2)
