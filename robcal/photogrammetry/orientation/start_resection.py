"""Approximate orientation of one image from known points: start values for the bundle adjustment.

Closed-form candidates come from OpenCV (IPPE for planes: both solutions; SQPNP for spatial points; P3P in a RANSAC
where identities may be wrong); the choice and the robust refinement are made here, in pixels and with distortion.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from robcal.photogrammetry.core.camera import Camera, normalise, project, project_with_jacobians
from robcal.transforms import Array, frame, retract, skew


@dataclass(frozen=True)
class Resection:
    """camera_T_body (4, 4), which points fit (n,), and the robust cost in px^2 (lower is better)."""

    camera_T_body: Array
    inliers: NDArray[np.bool_]
    cost: float


def ideal_points(camera: Camera, xy: Array) -> Array:
    """Ideal coordinates (n, 2); where the distortion cannot be undone, those without distortion."""
    ideal = normalise(camera, xy)
    plain = (xy - [camera.cx, camera.cy]) / [camera.fx, camera.fy]
    return np.where(np.isfinite(ideal), ideal, plain)


def residuals(camera: Camera, camera_T_body: Array, points: Array, xy: Array) -> Array:
    """Lengths (n,) of the image residuals in px; infinite behind the camera."""
    p = points @ camera_T_body[:3, :3].T + camera_T_body[:3, 3]
    length = np.linalg.norm(project(camera, p) - xy, axis=1)
    return np.where(np.isfinite(length), length, np.inf)


def refine(camera: Camera, camera_T_body: Array, points: Array, xy: Array, scale: float, iterations: int = 12) -> Array:
    """Robust Gauss-Newton on the six numbers of one station (Geman-McClure weights with ``scale`` px)."""
    T = camera_T_body
    best, best_cost = T, robust_cost(residuals(camera, T, points, xy), scale)
    for _ in range(iterations):
        p = points @ T[:3, :3].T + T[:3, 3]
        predicted, d_point, _ = project_with_jacobians(camera, p)
        r = xy - predicted
        good = np.isfinite(r).all(axis=1)
        if np.count_nonzero(good) < 3:
            break
        w = 1.0 / (1.0 + np.sum(r[good] ** 2, axis=1) / scale**2)
        Jr = d_point[good] @ T[:3, :3]
        J = np.concatenate([Jr, -Jr @ skew(points[good])], axis=2)
        A = np.einsum("nia,nib,n->ab", J, J, w**2)
        b = np.einsum("nia,ni,n->a", J, r[good], w**2)
        d = np.sqrt(np.maximum(np.diag(A), 1e-300))
        step = np.linalg.solve(A / d[:, None] / d[None, :] + 1e-9 * np.eye(6), b / d) / d
        T = retract(T, step)
        cost = robust_cost(residuals(camera, T, points, xy), scale)
        if cost < best_cost:
            done = best_cost - cost < 1e-6 * best_cost
            best, best_cost = T, cost
            if done:
                break
        elif cost > 2.0 * best_cost:
            break
    return best


def robust_cost(length: Array, scale: float) -> float:
    """Sum of truncated squares of residual lengths, in units of scale^2."""
    return float(np.sum(np.minimum((length / scale) ** 2, 9.0)))


def resect(
    camera: Camera, points: Array, xy: Array, scale: float, rng: np.random.Generator, extra: Iterable[Array] = ()
) -> Resection | None:
    """The best station of one image, or None if fewer than four points fit.

    Parameters
    ----------
    points : (n, 3) m, n >= 4. xy : (n, 2) px.
    scale : expected size of a good residual in px, systematic parts (unknown distortion) included.
    extra : further candidates (4, 4), for example a prediction.
    """
    n = len(points)
    if n < 4:
        return None
    ideal = ideal_points(camera, xy)
    best: Resection | None = None
    for candidate in [*extra, *_all_points(points, ideal)]:
        best = _better(best, _judge(camera, candidate, points, xy, scale))
    if best is None or np.count_nonzero(best.inliers) < max(4, 0.8 * n):
        for candidate in _samples(points, ideal, camera, xy, scale, rng):
            best = _better(best, _judge(camera, candidate, points, xy, scale))
    if best is None or np.count_nonzero(best.inliers) < 4:
        return None
    return best


def _better(a: Resection | None, b: Resection | None) -> Resection | None:
    if a is None or b is None:
        return a or b
    return a if a.cost <= b.cost else b


def _judge(camera: Camera, T: Array, points: Array, xy: Array, scale: float) -> Resection | None:
    if not np.all(np.isfinite(T)):
        return None
    T = refine(camera, T, points, xy, scale)
    length = residuals(camera, T, points, xy)
    return Resection(T, length < 3.0 * scale, robust_cost(length, scale))


def _from_opencv(rvec: ArrayLike, tvec: ArrayLike) -> Array:
    return frame(cv2.Rodrigues(np.asarray(rvec, dtype=float))[0], np.asarray(tvec, dtype=float).ravel())


def _all_points(points: Array, ideal: Array) -> list[Array]:
    """Closed-form solutions from all points."""
    centre = points.mean(axis=0)
    centred = points - centre
    _, values, axes = np.linalg.svd(centred, full_matrices=False)
    out: list[Array] = []
    if values[1] < 1e-6 * max(values[0], 1e-300):
        return out
    if values[2] < 0.02 * values[1]:
        # IPPE wants the plane z = 0
        R = axes * np.sign(np.linalg.det(axes))
        flat = centred @ R.T
        flat[:, 2] = 0.0
        calls = [(cv2.SOLVEPNP_IPPE, flat, frame(R, -R @ centre))]
    else:
        calls = [(cv2.SOLVEPNP_SQPNP, centred, frame(np.eye(3), -centre))]
    for flag, p, shifted_T_body in calls:
        try:
            _, rvecs, tvecs, _ = cv2.solvePnPGeneric(p[:, None], ideal[:, None], np.eye(3), None, flags=flag)
        except cv2.error:
            continue  # a degenerate configuration for this solver; the samples below still have their chance
        out += [_from_opencv(r, t) @ shifted_T_body for r, t in zip(rvecs, tvecs, strict=True)]
    return out


def _samples(
    points: Array, ideal: Array, camera: Camera, xy: Array, scale: float, rng: np.random.Generator, tries: int = 60
) -> list[Array]:
    """The best few P3P solutions over random triples, by robust cost over all points."""
    found: list[tuple[float, Array]] = []
    n = len(points)
    centre = points.mean(axis=0)
    for _ in range(tries):
        three = rng.choice(n, 3, replace=False)
        try:
            _, rvecs, tvecs = cv2.solveP3P(
                (points[three] - centre)[:, None], ideal[three][:, None], np.eye(3), None, flags=cv2.SOLVEPNP_AP3P
            )
        except cv2.error:
            continue  # three points in a line
        for r, t in zip(rvecs, tvecs, strict=True):
            T = _from_opencv(r, t) @ frame(np.eye(3), -centre)
            if np.all(np.isfinite(T)):
                found.append((robust_cost(residuals(camera, T, points, xy), scale), T))
    found.sort(key=lambda item: item[0])
    return [T for _, T in found[:3]]
