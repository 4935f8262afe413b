"""From marks to points in the world: forward intersection, and resection where only one camera sees the body."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from robcal.columns import Columns
from robcal.errors import DegenerateGeometry
from robcal.photogrammetry.core.bodies import Body, IntArray, spans_plane
from robcal.photogrammetry.core.camera import project
from robcal.photogrammetry.core.eccentricity import effective_point
from robcal.photogrammetry.measure.measured_points import MeasuredPoints, RejectedPoint, ResectedPoses
from robcal.photogrammetry.measure.resected_poses import resect_poses
from robcal.photogrammetry.orientation.intersection import Intersection, Rays, intersect
from robcal.photogrammetry.station.network import MarkTable, StationMarks, StationOrientation
from robcal.transforms import Array, invert, skew, transform


@dataclass(frozen=True)
class _Points(Columns):
    """Columns of :class:`MeasuredPoints`, m rows."""

    pose: IntArray
    target: IntArray
    p_world: Array
    covariance: Array
    n_cameras: IntArray
    residual: Array
    jacobian: Array


def measure_points(
    orientation: StationOrientation,
    marks: Mapping[str, StationMarks],
    body: Body | None = None,
    *,
    critical: float = 4.0,
    resection: bool = True,
) -> MeasuredPoints:
    """Intersect all targets that two or more cameras see; resect the body in poses where fewer than three are left.

    Parameters
    ----------
    orientation : the adjusted station; its noise factors scale the marks' covariances.
    marks : all identified marks, also of poses that took no part in the orientation.
    body : for resections and eccentricity; default the body of the orientation (with adjusted coordinates).
    critical : limit (standard deviations) for the contradiction of the rays of a point.

    Returns
    -------
    Points with the covariance of the marks, and the derivative by the station's parameters with their covariance.
    """
    carried = orientation.body if body is None else body
    table, number = _table(orientation, marks, carried)
    if len(table.camera) == 0:
        raise DegenerateGeometry("the cameras of the station have no usable marks")
    suspect = {r.pose for r in orientation.rejected if r.kind == "contradiction"}
    points, inconsistent, rejected = _intersected(orientation, table, number, carried, critical, suspect)
    resected = None
    if resection:
        weak = _weak_poses(np.unique(number), points, carried)
        weak = weak[~np.isin(weak, list(suspect))]
        resected, failed = resect_poses(orientation, table, number, weak, carried)
        rejected += failed
    if resected is not None:
        points = points.select(~np.isin(points.pose, resected.pose))
        points = points.joined(_points_of_resection(resected, carried, points.jacobian.shape[-1]))
    points = points.select(np.lexsort((carried.index(points.target), points.pose)))
    return MeasuredPoints(
        points.pose,
        points.target,
        points.p_world,
        points.covariance,
        points.n_cameras,
        points.residual,
        points.jacobian,
        orientation.covariance,
        resected,
        tuple(rejected),
        inconsistent,
    )


def _intersected(
    orientation: StationOrientation, table: MarkTable, number: IntArray, body: Body, critical: float, suspect: set[int]
) -> tuple[_Points, tuple[int, ...], list[RejectedPoint]]:
    """Points that two or more cameras see: those consistent, poses in which most are not, points rejected."""
    poses, pose_row = np.unique(number, return_inverse=True)
    xy = _centred(orientation, table, pose_row, _known_poses(orientation, poses), body)
    key = pose_row * (len(body) + 1) + table.target
    point = np.unique(key, return_inverse=True)[1]
    several = np.bincount(point)[point] >= 2
    keys, point = np.unique(key[several], return_inverse=True)
    if len(keys) == 0:
        width, none = 6 * len(orientation.world_T_exterior) + 9 * len(orientation.names), np.empty(0, dtype=np.int64)
        empty = np.empty((0, 3, 3))
        return _Points(none, none, empty[:, 0], empty, none, np.empty(0), np.empty((0, 3, width))), (), []
    rays = Rays(
        point,
        table.camera[several],
        xy[several],
        table.covariance[several],
        orientation.cameras,
        orientation.world_T_exterior,
        table.exterior[several],
    )
    out = intersect(rays, critical)
    pose, target = poses[keys // (len(body) + 1)], body.ids[keys % (len(body) + 1)]
    keep, inconsistent, rejected = _consistent(out, pose, target, critical, suspect)
    by_station = [np.moveaxis(J, 1, 2).reshape(len(keys), 3, -1) for J in (out.by_exterior, out.by_interior)]
    residual = np.sqrt(np.maximum(out.chi2, 0) / np.maximum(2 * out.n_cameras - 3, 1))
    J = np.concatenate(by_station, axis=-1)
    points = _Points(pose, target, out.p_world, out.covariance, out.n_cameras, residual, J)
    return points.select(keep), inconsistent, rejected


def _table(
    orientation: StationOrientation, marks: Mapping[str, StationMarks], body: Body
) -> tuple[MarkTable, IntArray]:
    """Marks not left out by the orientation, covariances scaled by its noise factors, and their pose numbers."""
    banned = {(r.camera, r.pose, r.target) for r in orientation.rejected if r.kind == "outlier"}
    radius, normals = 0.5 * body.diameters, body.estimated_normals()
    columns: list[tuple[np.ndarray, ...]] = []
    for c, name in enumerate(orientation.names):
        m = marks.get(name)
        if m is None or len(m) == 0:
            continue
        target = body.index(m.target)
        keep = target >= 0
        if banned:
            keep &= np.array([(name, int(p), int(t)) not in banned for p, t in zip(m.pose, m.target, strict=True)])
        n = int(keep.sum())
        columns.append(
            (
                np.full(n, c),
                orientation.exterior_of(c, m.pose[keep]),
                m.pose[keep],
                target[keep],
                m.xy[keep],
                m.covariance[keep] * orientation.noise[name] ** 2,
            )
        )
    if not columns:
        raise DegenerateGeometry("none of the cameras of the orientation has marks")
    camera, exterior, number, target, xy, covariance = (np.concatenate(v) for v in zip(*columns, strict=True))
    zeros = np.zeros(len(camera), dtype=np.int64)
    table = MarkTable(camera, exterior, zeros, target, xy, covariance, radius[target], normals[target])
    return table, number


def _known_poses(orientation: StationOrientation, poses: IntArray) -> Array:
    """(p, 4, 4) body poses of the orientation, NaN for poses that took no part."""
    out = np.full((len(poses), 4, 4), np.nan)
    at = np.clip(np.searchsorted(orientation.poses, poses), 0, len(orientation.poses) - 1)
    found = orientation.poses[at] == poses
    out[found] = orientation.world_T_body[at[found]]
    return out


def _centred(
    orientation: StationOrientation, table: MarkTable, pose_row: IntArray, world_T_body: Array, body: Body
) -> Array:
    """Marks reduced from the centre of the ellipse to the image of the target's centre."""
    xy = table.xy.copy()
    T = world_T_body[pose_row]
    use = np.isfinite(T).all(axis=(1, 2)) & np.isfinite(table.radius) & np.isfinite(table.normals).all(axis=1)
    use &= np.isfinite(body.points[table.target]).all(axis=1)
    for c, camera in enumerate(orientation.cameras):
        rows = np.flatnonzero(use & (table.camera == c))
        if len(rows) == 0:
            continue
        camera_T_body = invert(orientation.world_T_exterior[table.exterior[rows]]) @ T[rows]
        p = transform(camera_T_body, body.points[table.target[rows]])
        normals = np.einsum("mij,mj->mi", camera_T_body[:, :3, :3], table.normals[rows])
        shift = project(camera, effective_point(p, normals, table.radius[rows])) - project(camera, p)
        xy[rows] -= np.where(np.isfinite(shift), shift, 0.0)
    return xy


def _consistent(
    out: Intersection, pose: IntArray, target: IntArray, critical: float, suspect: set[int]
) -> tuple[NDArray[np.bool_], tuple[int, ...], list[RejectedPoint]]:
    """Points whose rays agree, poses in which most do not, and points rejected.

    Where most points of a pose fail it is not the points: they stay, the pose is named; but in a ``suspect`` pose,
    whose images the orientation found to contradict one another, they go.
    """
    redundancy = np.maximum(2 * out.n_cameras - 3, 1)
    finite = np.asarray(np.isfinite(out.p_world).all(axis=1))
    fails = finite & (out.chi2 > stats.chi2.isf(2 * stats.norm.sf(critical), redundancy))
    inconsistent = []
    for q in np.unique(pose[fails]):
        rows = pose == q
        if fails[rows].sum() > 0.5 * rows.sum() and rows.sum() >= 3 and int(q) not in suspect:
            inconsistent.append(int(q))
            fails[rows] = False
    rejected = []
    for i in np.flatnonzero(fails | ~finite):
        apart = np.sqrt(out.chi2[i] / redundancy[i])
        reason = f"the rays miss one another by {apart:.1f} standard deviations"
        rejected.append(
            RejectedPoint(int(pose[i]), int(target[i]), reason if finite[i] else "the rays are nearly parallel")
        )
    return finite & ~fails, tuple(inconsistent), rejected


def _weak_poses(poses: IntArray, points: _Points, body: Body) -> IntArray:
    """Poses with fewer than three intersected targets of known coordinates, or with all of them in one line."""
    weak = []
    at = body.index(points.target)
    for q in poses:
        rows = at[points.pose == q]
        rows = rows[body.known[rows]]
        if not spans_plane(body.points[rows]):
            weak.append(q)
    return np.array(weak, dtype=np.int64)


def _points_of_resection(resected: ResectedPoses, body: Body, width: int) -> _Points:
    """Points of resected bodies: covariance from the pose's, n_cameras 1, no derivative by the station."""
    counts = [len(t) for t in resected.targets]
    pose, row = np.repeat(resected.pose, counts), np.repeat(np.arange(len(resected.pose)), counts)
    target = np.array([i for t in resected.targets for i in t], dtype=np.int64)
    X = body.points[body.index(target)]
    T = resected.world_T_body[row]
    R = T[:, :3, :3]
    J = np.concatenate([R, -R @ skew(X)], axis=-1)
    covariance = J @ resected.covariance[row] @ np.swapaxes(J, -1, -2)
    m = len(pose)
    ones, unknown = np.ones(m, dtype=np.int64), np.full(m, np.nan)
    return _Points(pose, target, transform(T, X), covariance, ones, unknown, np.zeros((m, 3, width)))
