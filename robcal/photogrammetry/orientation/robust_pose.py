"""Approximate pose of a body in one image while the lens is hardly known and marks may be misidentified.

Closed-form candidates, refined with Geman-McClure weights in pixels and with distortion; the best by a truncated cost.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from robcal.errors import DegenerateGeometry
from robcal.estimation.batched import NormalEquations, minimise_each
from robcal.estimation.grouping import IntArray
from robcal.estimation.robust import geman_mcclure_costs, geman_mcclure_weights
from robcal.estimation.summary import TerminationSettings
from robcal.photogrammetry.core.camera import Camera, normalise, project, project_with_jacobians
from robcal.photogrammetry.orientation.closed_form import start_poses, three_point_search
from robcal.transforms import Array, retract, skew, transform

INLIER = 3.0
"""Marks within this many scales fit; further ones cost no more than one just there."""


@dataclass(frozen=True)
class RobustPose:
    """camera_T_body (4, 4), which points fit (n,), and the truncated cost in scales^2 (lower is better)."""

    camera_T_body: Array
    inliers: NDArray[np.bool_]
    cost: float


def ideal_points(camera: Camera, xy: Array) -> Array:
    """Ideal coordinates (n, 2); where the distortion cannot be undone, those without distortion."""
    ideal = normalise(camera, xy)
    plain = (xy - [camera.cx, camera.cy]) / [camera.fx, camera.fy]
    return np.where(np.isfinite(ideal), ideal, plain)


def truncated_cost(length: Array, scale: float) -> Array:
    """Sums (...) of truncated squares of residual lengths (..., n) px, in units of scale^2."""
    return np.sum(np.minimum((length / scale) ** 2, INLIER**2), axis=-1)


def refine_robust(
    camera: Camera, camera_T_body: Array, points: Array, xy: Array, scale: float, iterations: int = 12
) -> Array:
    """Poses (k, 4, 4) of one image refined from start poses (k, 4, 4), marks beyond ``scale`` px down-weighted."""

    def equations(poses: Array, chosen: IntArray) -> NormalEquations:
        k, n = len(poses), len(points)
        predicted, d_point, _ = project_with_jacobians(camera, transform(poses[:, None], points).reshape(-1, 3))
        r = (np.tile(xy, (k, 1)) - predicted) / scale
        length = np.linalg.norm(r, axis=1)
        R = np.repeat(poses[:, :3, :3], n, axis=0)
        J = d_point @ np.concatenate([R, -R @ skew(np.tile(points, (k, 1)))], axis=-1) / scale
        good = np.isfinite(length)
        root = np.sqrt(geman_mcclure_weights(length))[:, None]
        r, J = np.where(good[:, None], r * root, 0.0), np.where(good[:, None, None], J * root[..., None], 0.0)
        system = NormalEquations.of_rows(np.repeat(np.arange(k), n), r, J, k)
        return NormalEquations(system.matrix, system.right, geman_mcclure_costs(length).reshape(k, n).sum(axis=1))

    settings = TerminationSettings(iterations, cost_tolerance=1e-6, negligible=1e-12)
    return minimise_each(equations, retract, camera_T_body, settings).state


def robust_pose(camera: Camera, points: Array, xy: Array, scale: float) -> RobustPose | None:
    """The pose of one image that most points agree with, or None if fewer than four do.

    Parameters
    ----------
    points : (n, 3) m, n >= 4. xy : (n, 2) px.
    scale : expected size of a good residual in px, systematic parts (unknown distortion) included.
    """
    n = len(points)
    if n < 4:
        return None
    try:
        best = _best(camera, start_poses(camera, xy, points), points, xy, scale)
    except DegenerateGeometry:
        return None
    if best is None or np.count_nonzero(best.inliers) < max(4, 0.8 * n):
        found, _ = three_point_search(camera, xy, points, tolerance_px=INLIER * scale)
        candidates = [T for T in (found, best.camera_T_body if best else None) if T is not None]
        best = _best(camera, candidates, points, xy, scale)
    return best if best is not None and np.count_nonzero(best.inliers) >= 4 else None


def _best(camera: Camera, starts: Sequence[Array], points: Array, xy: Array, scale: float) -> RobustPose | None:
    if not starts:
        return None
    poses = refine_robust(camera, np.array(starts), points, xy, scale)
    length = np.linalg.norm(project(camera, transform(poses[:, None], points)) - xy, axis=-1)
    length = np.where(np.isfinite(length), length, np.inf)
    cost = truncated_cost(length, scale)
    k = int(np.argmin(cost))
    return RobustPose(poses[k], length[k] < INLIER * scale, float(cost[k]))
