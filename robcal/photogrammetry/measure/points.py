"""From marks to points in the world: forward intersection, and resection where only one camera sees the body."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from robcal.errors import DegenerateGeometry
from robcal.estimation.grouping import sum_by
from robcal.photogrammetry.core.bodies import Body, IntArray, line_ratio
from robcal.photogrammetry.core.camera import project
from robcal.photogrammetry.core.eccentric_circle import effective_point
from robcal.photogrammetry.measure.measured_points import MeasuredPoints, RejectedPoint, ResectedPoses
from robcal.photogrammetry.orientation.intersection import intersect
from robcal.photogrammetry.orientation.resection import PoseFit, Resection, refine_poses, resect_images
from robcal.photogrammetry.station.adjustment import interior_basis, linearise
from robcal.photogrammetry.station.network import MarkTable, StationMarks, StationOrientation, Unknowns
from robcal.transforms import Array, invert, skew, transform

_SPREAD = 0.02
"""Targets whose spread across their line is below this share do not carry a frame."""


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
    table, number, noise = _table(orientation, marks, carried)
    rejected: list[RejectedPoint] = []
    suspect = {r.pose for r in orientation.rejected if r.kind == "contradiction"}
    if len(table.camera) == 0:
        raise DegenerateGeometry("the cameras of the station have no usable marks")
    poses, pose_row = np.unique(number, return_inverse=True)
    world_T_body = _known_poses(orientation, poses)
    xy = _centred(orientation, table, pose_row, world_T_body, carried)
    key = pose_row * (len(carried) + 1) + table.target
    point = np.unique(key, return_inverse=True)[1]
    rays = np.bincount(point)
    several = rays[point] >= 2
    sub_keys, sub_point = np.unique(key[several], return_inverse=True)
    e, c = len(orientation.world_T_exterior), len(orientation.names)
    width = 6 * e + 9 * c
    empty = np.empty((0, 3))
    pose_of, target_of, p, C, n_cam, res, J = (
        np.empty(0, dtype=np.int64),
        np.empty(0, dtype=np.int64),
        empty,
        np.empty((0, 3, 3)),
        np.empty(0, dtype=np.int64),
        np.empty(0),
        np.empty((0, 3, width)),
    )
    inconsistent: tuple[int, ...] = ()
    if len(sub_keys):
        covariance = table.covariance[several] * noise[several][:, None, None]
        out = intersect(
            sub_point,
            table.camera[several],
            xy[several],
            covariance,
            orientation.cameras,
            orientation.world_T_exterior,
            exterior=table.exterior[several],
            critical=critical,
        )
        pose_of = poses[sub_keys // (len(carried) + 1)]
        target_of = carried.ids[sub_keys % (len(carried) + 1)]
        keep, inconsistent = _consistent(
            out.chi2, out.n_cameras, out.p_world, pose_of, target_of, critical, rejected, suspect
        )
        redundancy = 2 * out.n_cameras - 3
        res = np.sqrt(np.maximum(out.chi2, 0) / np.maximum(redundancy, 1))[keep]
        J = np.concatenate(
            [
                np.moveaxis(out.by_exterior, 1, 2).reshape(len(out.p_world), 3, 6 * e),
                np.moveaxis(out.by_interior, 1, 2).reshape(len(out.p_world), 3, 9 * c),
            ],
            axis=-1,
        )[keep]
        pose_of, target_of, p = pose_of[keep], target_of[keep], out.p_world[keep]
        C, n_cam = out.covariance[keep], out.n_cameras[keep]
    resected = None
    if resection:
        weak = _weak_poses(poses, pose_of, target_of, carried)
        weak = np.array([q for q in weak if q not in suspect], dtype=np.int64)
        resected = _resect_poses(orientation, table, number, noise, weak, carried, rejected)
    if resected is not None and len(resected.pose):
        drop = np.isin(pose_of, resected.pose)
        extra = _points_of_resection(resected, carried)
        zero = np.zeros((len(extra[0]), 3, width))
        pose_of = np.concatenate([pose_of[~drop], extra[0]])
        target_of = np.concatenate([target_of[~drop], extra[1]])
        p, C = np.concatenate([p[~drop], extra[2]]), np.concatenate([C[~drop], extra[3]])
        n_cam = np.concatenate([n_cam[~drop], extra[4]])
        res = np.concatenate([res[~drop], np.full(len(extra[0]), np.nan)])
        J = np.concatenate([J[~drop], zero])
    order = np.lexsort((carried.index(target_of), pose_of))
    return MeasuredPoints(
        pose_of[order],
        target_of[order],
        p[order],
        C[order],
        n_cam[order],
        res[order],
        J[order],
        orientation.covariance,
        resected,
        tuple(rejected),
        inconsistent,
    )


def _table(
    orientation: StationOrientation, marks: Mapping[str, StationMarks], body: Body
) -> tuple[MarkTable, IntArray, Array]:
    """All marks not left out by the orientation: table (pose unused), pose numbers, variance factor per mark."""
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
                m.covariance[keep],
                np.full(n, orientation.noise[name] ** 2),
            )
        )
    if not columns:
        raise DegenerateGeometry("none of the cameras of the orientation has marks")
    camera, exterior, number, target, xy, covariance, noise = (np.concatenate(v) for v in zip(*columns, strict=True))
    zeros = np.zeros(len(camera), dtype=np.int64)
    table = MarkTable(camera, exterior, zeros, target, xy, covariance, radius[target], normals[target])
    return table, number, noise


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
    chi2: Array,
    n_cameras: IntArray,
    p: Array,
    pose: IntArray,
    target: IntArray,
    critical: float,
    rejected: list[RejectedPoint],
    suspect: set[int],
) -> tuple[NDArray[np.bool_], tuple[int, ...]]:
    """Points whose rays agree. Where most points of a pose fail it is not the points: they stay, the pose is named;
    but in a ``suspect`` pose, whose images the orientation found to contradict one another, they go."""
    level = 2 * stats.norm.sf(critical)
    finite = np.asarray(np.isfinite(p).all(axis=1))
    limit = stats.chi2.isf(level, np.maximum(2 * n_cameras - 3, 1))
    fails = finite & (chi2 > limit)
    inconsistent = []
    for q in np.unique(pose[fails]):
        rows = pose == q
        if fails[rows].sum() > 0.5 * rows.sum() and rows.sum() >= 3 and int(q) not in suspect:
            inconsistent.append(int(q))
            fails[rows] = False
    for i in np.flatnonzero(fails | ~finite):
        reason = (
            f"the rays miss one another by {np.sqrt(chi2[i] / max(1, 2 * n_cameras[i] - 3)):.1f} standard deviations"
            if finite[i]
            else "the rays are nearly parallel"
        )
        rejected.append(RejectedPoint(int(pose[i]), int(target[i]), reason))
    return finite & ~fails, tuple(inconsistent)


def _weak_poses(poses: IntArray, pose_of: IntArray, target_of: IntArray, body: Body) -> IntArray:
    """Poses with fewer than three intersected targets of known coordinates, or with all of them in one line."""
    weak = []
    known = body.known
    at = body.index(target_of)
    for q in poses:
        rows = at[pose_of == q]
        rows = rows[known[rows]]
        if len(rows) < 3 or line_ratio(body.points[rows]) < _SPREAD:
            weak.append(q)
    return np.array(weak, dtype=np.int64)


def _resect_poses(
    orientation: StationOrientation,
    table: MarkTable,
    number: IntArray,
    noise: Array,
    wanted: IntArray,
    body: Body,
    rejected: list[RejectedPoint],
) -> ResectedPoses | None:
    use = np.isin(number, wanted) & body.known[table.target]
    if not use.any():
        return None
    rows = np.flatnonzero(use)
    scaled = table.covariance * noise[:, None, None]
    starts: list[tuple[int, Array]] = []
    for c, camera in enumerate(orientation.cameras):
        mine = rows[table.camera[rows] == c]
        if len(mine) == 0:
            continue
        seen, image = np.unique(number[mine], return_inverse=True)
        fits = resect_images(
            camera, image.astype(np.int64), body.ids[table.target[mine]], table.xy[mine], scaled[mine], body
        )
        for q, fit in zip(seen, fits, strict=True):
            if isinstance(fit, Resection):
                e = orientation.exterior_of(c, [q])[0]
                for T in (fit.camera_T_body, fit.alternative):
                    if T is not None:
                        starts.append((int(q), orientation.world_T_exterior[e] @ T))
            else:
                rejected.append(RejectedPoint(int(q), -1, f"camera {orientation.names[c]}: {fit}"))
    if not starts:
        return None
    best_fit, which, tile = _fit_all(orientation, table, scaled, number, rows, starts, body)
    own = np.array([q for q, _ in starts])
    chosen: list[int] = []
    for q in np.unique(own):
        candidates = np.flatnonzero(own == q)
        candidates = candidates[np.argsort(best_fit.cost[candidates])]
        best = candidates[0]
        redundancy = int(best_fit.redundancy[best])
        variance = max(1.0, best_fit.cost[best] / max(1, redundancy))
        distinct = [
            k
            for k in candidates[1:]
            if np.trace(best_fit.reference_T_body[k][:3, :3].T @ best_fit.reference_T_body[best][:3, :3]) < 3 - 1e-4
        ]
        if redundancy <= 0:
            rejected.append(RejectedPoint(int(q), -1, "resection: three marks alone cannot be verified"))
        elif stats.chi2.sf(best_fit.cost[best], redundancy) < 1e-9:
            rejected.append(RejectedPoint(int(q), -1, "resection: the marks do not fit the body"))
        elif distinct and best_fit.cost[distinct[0]] < best_fit.cost[best] + 14 * variance:
            rejected.append(
                RejectedPoint(int(q), -1, "resection: a plane seen by one camera, two poses fit equally well")
            )
        elif not np.isfinite(best_fit.covariance[best]).all():
            rejected.append(RejectedPoint(int(q), -1, "resection: the pose is not determined"))
        else:
            chosen.append(int(best))
    if not chosen:
        return None
    common = _common_covariance(orientation, table, scaled, best_fit.reference_T_body, which, tile, body)
    seen_by = [np.unique(table.camera[tile[which == k]]) for k in chosen]
    return ResectedPoses(
        own[chosen],
        best_fit.reference_T_body[chosen],
        best_fit.covariance[chosen],
        common[chosen],
        np.array([len(s) for s in seen_by], dtype=np.int64),
        tuple(tuple(sorted({int(i) for i in body.ids[table.target[tile[which == k]]]})) for k in chosen),
    )


def _fit_all(
    orientation: StationOrientation,
    table: MarkTable,
    scaled: Array,
    number: IntArray,
    rows: IntArray,
    starts: list[tuple[int, Array]],
    body: Body,
) -> tuple[PoseFit, IntArray, IntArray]:
    """Refine all start poses with the marks of all cameras: fit, start number and table row of each mark used."""
    tiles = [rows[number[rows] == q] for q, _ in starts]
    tile = np.concatenate(tiles)
    which = np.repeat(np.arange(len(starts)), [len(t) for t in tiles])
    fit = refine_poses(
        np.array([T for _, T in starts]),
        which,
        table.exterior[tile],
        [orientation.cameras[c] for c in orientation.exterior_camera],
        orientation.world_T_exterior,
        body.points[table.target[tile]],
        table.xy[tile],
        scaled[tile],
        radius=table.radius[tile],
        normals=table.normals[tile],
        iterations=25,
    )
    return fit, which, tile


def _common_covariance(
    orientation: StationOrientation,
    table: MarkTable,
    scaled: Array,
    poses: Array,
    which: IntArray,
    tile: IntArray,
    body: Body,
) -> Array:
    """(k, 6, 6) what the uncertainty of station and body adds to resected poses."""
    marks = MarkTable(
        table.camera[tile],
        table.exterior[tile],
        which,
        table.target[tile],
        table.xy[tile],
        scaled[tile],
        table.radius[tile],
        table.normals[tile],
    )
    interior = np.array([camera.vector for camera in orientation.cameras])
    unknowns = Unknowns(interior, orientation.world_T_exterior, poses, np.nan_to_num(body.points))
    ones = np.ones(len(orientation.names))
    lin = linearise(marks, unknowns, orientation.cameras, ones)
    k, e, c, t = len(poses), len(orientation.world_T_exterior), len(orientation.names), len(body)
    B = np.nan_to_num(lin.by_pose)
    N = sum_by(which, np.swapaxes(B, -1, -2) @ B, k)
    pull = np.swapaxes(B, -1, -2)
    by_numbers = np.nan_to_num(lin.by_interior) @ np.linalg.inv(interior_basis(interior))[marks.camera]
    pinv = np.linalg.pinv(N, hermitian=True)

    def gathered(owner: IntArray, count: int, blocks: Array) -> Array:
        """(k, 6, count * width) sums of pull @ blocks, one column block per owner."""
        width = blocks.shape[-1]
        total = sum_by(which * count + owner, pull @ np.nan_to_num(blocks), k * count)
        return np.moveaxis(total.reshape(k, count, 6, width), 1, 2).reshape(k, 6, count * width)

    K = -pinv @ np.concatenate(
        [gathered(marks.exterior, e, lin.by_exterior), gathered(marks.camera, c, by_numbers)], axis=-1
    )
    out = K @ orientation.covariance @ np.swapaxes(K, -1, -2)
    if body.covariance is not None:
        L = -pinv @ gathered(marks.target, t, lin.by_point)
        out = out + L @ np.nan_to_num(body.covariance) @ np.swapaxes(L, -1, -2)
    return out


def _points_of_resection(resected: ResectedPoses, body: Body) -> tuple[IntArray, IntArray, Array, Array, IntArray]:
    """Points of resected bodies: pose, target, p_world, covariance from the pose's, n_cameras (all marked 1)."""
    pose = np.repeat(resected.pose, [len(t) for t in resected.targets])
    row = np.repeat(np.arange(len(resected.pose)), [len(t) for t in resected.targets])
    target = np.array([i for t in resected.targets for i in t], dtype=np.int64)
    X = body.points[body.index(target)]
    T = resected.world_T_body[row]
    R = T[:, :3, :3]
    J = np.concatenate([R, -R @ skew(X)], axis=-1)
    covariance = J @ resected.covariance[row] @ np.swapaxes(J, -1, -2)
    return pose, target, transform(T, X), covariance, np.ones(len(pose), dtype=np.int64)
