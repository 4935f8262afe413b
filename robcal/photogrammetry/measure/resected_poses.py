"""Poses of a body by resection, from all its marks at once, where too few targets are seen by two cameras."""

import numpy as np
from scipy import stats

from robcal.estimation.grouping import sum_by
from robcal.photogrammetry.core.bodies import Body, IntArray
from robcal.photogrammetry.measure.measured_points import RejectedPoint, ResectedPoses
from robcal.photogrammetry.orientation.resection import (
    PoseFit,
    Resection,
    Rig,
    TargetMarks,
    refine_poses,
    resect_images,
)
from robcal.photogrammetry.station.adjustment import interior_basis, linearise
from robcal.photogrammetry.station.network import MarkTable, StationOrientation, Unknowns
from robcal.transforms import Array

_SIGNIFICANCE = 1e-9
"""Marks whose chi-square is less probable than this do not fit the body."""
_RIVAL = 14.0
"""Of two distinct poses one is chosen only if its chi-square, in units of its variance, is smaller by this."""


def resect_poses(
    orientation: StationOrientation, table: MarkTable, number: IntArray, wanted: IntArray, body: Body
) -> tuple[ResectedPoses | None, list[RejectedPoint]]:
    """Resect the body in the ``wanted`` poses: the poses found, and why others were not.

    Parameters
    ----------
    table : marks with their scaled covariances; number : (m,) their pose numbers.
    """
    rows = np.flatnonzero(np.isin(number, wanted) & body.known[table.target])
    starts, rejected = _starts(orientation, table, number, rows, body)
    if not starts:
        return None, rejected
    fit, which, tile = _fit_all(orientation, table, number, rows, starts, body)
    own = np.array([q for q, _ in starts])
    chosen: list[int] = []
    for q in np.unique(own):
        best = _best(fit, np.flatnonzero(own == q))
        if isinstance(best, str):
            rejected.append(RejectedPoint(int(q), -1, f"resection: {best}"))
        else:
            chosen.append(best)
    if not chosen:
        return None, rejected
    common = _common_covariance(orientation, table, fit.reference_T_body, which, tile, body)
    marks = [tile[which == k] for k in chosen]
    poses = ResectedPoses(
        own[chosen],
        fit.reference_T_body[chosen],
        fit.covariance[chosen],
        common[chosen],
        np.array([len(np.unique(table.camera[m])) for m in marks], dtype=np.int64),
        tuple(tuple(sorted({int(i) for i in body.ids[table.target[m]]})) for m in marks),
    )
    return poses, rejected


def _starts(
    orientation: StationOrientation, table: MarkTable, number: IntArray, rows: IntArray, body: Body
) -> tuple[list[tuple[int, Array]], list[RejectedPoint]]:
    """(pose number, world_T_body) of every pose that the marks of a single camera allow."""
    starts: list[tuple[int, Array]] = []
    rejected: list[RejectedPoint] = []
    for c, camera in enumerate(orientation.cameras):
        mine = rows[table.camera[rows] == c]
        if len(mine) == 0:
            continue
        seen, image = np.unique(number[mine], return_inverse=True)
        ids = body.ids[table.target[mine]]
        fits = resect_images(camera, image.astype(np.int64), ids, table.xy[mine], table.covariance[mine], body)
        for q, fit in zip(seen, fits, strict=True):
            if isinstance(fit, Resection):
                e = orientation.exterior_of(c, [q])[0]
                found = [T for T in (fit.camera_T_body, fit.alternative) if T is not None]
                starts += [(int(q), orientation.world_T_exterior[e] @ T) for T in found]
            else:
                rejected.append(RejectedPoint(int(q), -1, f"camera {orientation.names[c]}: {fit}"))
    return starts, rejected


def _best(fit: PoseFit, candidates: IntArray) -> int | str:
    """The pose to choose among refined ones of one image, or why there is none."""
    candidates = candidates[np.argsort(fit.cost[candidates])]
    best = int(candidates[0])
    cost, redundancy = fit.cost[best], int(fit.redundancy[best])
    R = fit.reference_T_body[:, :3, :3]
    distinct = [k for k in candidates[1:] if np.trace(R[k].T @ R[best]) < 3 - 1e-4]
    if redundancy <= 0:
        return "three marks alone cannot be verified"
    if stats.chi2.sf(cost, redundancy) < _SIGNIFICANCE:
        return "the marks do not fit the body"
    if distinct and fit.cost[distinct[0]] < cost + _RIVAL * max(1.0, cost / redundancy):
        return "a plane seen by one camera, two poses fit equally well"
    if not np.isfinite(fit.covariance[best]).all():
        return "the pose is not determined"
    return best


def _fit_all(
    orientation: StationOrientation,
    table: MarkTable,
    number: IntArray,
    rows: IntArray,
    starts: list[tuple[int, Array]],
    body: Body,
) -> tuple[PoseFit, IntArray, IntArray]:
    """Refine all start poses with the marks of all cameras: fit, start number and table row of each mark used."""
    tiles = [rows[number[rows] == q] for q, _ in starts]
    tile = np.concatenate(tiles)
    which = np.repeat(np.arange(len(starts)), [len(t) for t in tiles])
    points = body.points[table.target[tile]]
    marks = TargetMarks(points, table.xy[tile], table.covariance[tile], table.radius[tile], table.normals[tile])
    cameras = [orientation.cameras[c] for c in orientation.exterior_camera]
    rig = Rig(table.exterior[tile], cameras, orientation.world_T_exterior)
    fit = refine_poses(np.array([T for _, T in starts]), which, marks, rig, iterations=25)
    return fit, which, tile


def _common_covariance(
    orientation: StationOrientation, table: MarkTable, poses: Array, which: IntArray, tile: IntArray, body: Body
) -> Array:
    """(k, 6, 6) what the uncertainty of station and body adds to resected poses."""
    marks = MarkTable(
        table.camera[tile],
        table.exterior[tile],
        which,
        table.target[tile],
        table.xy[tile],
        table.covariance[tile],
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
    gain = np.swapaxes(B, -1, -2)
    by_numbers = np.nan_to_num(lin.by_interior) @ np.linalg.inv(interior_basis(interior))[marks.camera]
    pinv = np.linalg.pinv(N, hermitian=True)

    def gathered(owner: IntArray, count: int, blocks: Array) -> Array:
        """(k, 6, count * width) sums of gain @ blocks, one column block per owner."""
        width = blocks.shape[-1]
        total = sum_by(which * count + owner, gain @ np.nan_to_num(blocks), k * count)
        return np.moveaxis(total.reshape(k, count, 6, width), 1, 2).reshape(k, 6, count * width)

    K = -pinv @ np.concatenate(
        [gathered(marks.exterior, e, lin.by_exterior), gathered(marks.camera, c, by_numbers)], axis=-1
    )
    out = K @ orientation.covariance @ np.swapaxes(K, -1, -2)
    if body.covariance is not None:
        L = -pinv @ gathered(marks.target, t, lin.by_point)
        out = out + L @ np.nan_to_num(body.covariance) @ np.swapaxes(L, -1, -2)
    return out
