"""From a rough pose to all dots it explains: match, refine pose, focal length and k1, match again."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment
from scipy.spatial import cKDTree

from robcal.photogrammetry.bodies import IntArray, line_ratio
from robcal.photogrammetry.camera import INTRINSIC_NAMES, Camera, project, project_with_jacobians
from robcal.transforms import Array, retract, skew, transform

_SIGMA_LOG_FOCAL = 0.15
_CORNER_DISTORTION = 0.03
"""Prior standard deviation of the radial distortion in the image corner, as a share of the radius there."""
_LAST_GATE = 2.5
"""Narrowest gate, px: centres of dots seen through water or lit from the side have errors with long tails."""
_NEIGHBOURS = 6
"""Targets around one from which its chance to be seen is taken."""
_OTHER = 3.0
"""A camera from a similar direction counts as this many neighbours."""


@dataclass(frozen=True)
class Grown:
    """A numbering: rows of dots and of targets, pose, camera with adjusted focal length and k1, residuals (k,) px."""

    dots: IntArray
    targets: IntArray
    camera_T_body: Array
    camera: Camera
    off: Array

    @property
    def rms(self) -> float:
        """Root mean square distance of dot and prediction, px (per dot, not per coordinate)."""
        return float(np.sqrt(np.mean(self.off**2))) if len(self.off) else np.inf


def grow(
    camera: Camera, camera_T_body: Array, points: Array, xy: Array, *, reach: float, tree: cKDTree | None = None
) -> Grown | None:
    """Match and refine until the matches stay, the gate following the residuals from ``reach`` (px) downwards.

    Returns None where fewer than six dots, or dots in one line only, are left.
    """
    tree = cKDTree(xy) if tree is None else tree
    pose, lens, gate = camera_T_body, camera, reach
    before: Grown | None = None
    for step in range(10):
        predicted = project(lens, transform(pose, points))
        targets, dots = _assign(predicted, xy, tree, gate)
        if len(dots) < 6 or line_ratio(points[targets]) < 0.01:
            return None
        scale = max(0.3, 0.25 * gate)
        pose, lens = refine_with_lens(camera, lens, pose, points[targets], xy[dots], scale=scale, iterations=6)
        off = np.linalg.norm(project(lens, transform(pose, points[targets])) - xy[dots], axis=1)
        now = Grown(dots, targets, pose, lens, off)
        steady = before is not None and np.array_equal(dots, before.dots) and np.array_equal(targets, before.targets)
        usual = 1.4 * float(np.median(off))
        smaller = max(min(3.0 * usual, 0.75 * gate if step < 5 else gate), _LAST_GATE)
        if steady and smaller >= 0.95 * gate:
            return now
        gate, before = smaller, now
    return before


def refine_with_lens(
    start: Camera, camera: Camera, camera_T_body: Array, points: Array, xy: Array, *, scale: float, iterations: int = 15
) -> tuple[Array, Camera]:
    """Pose, common focal factor and k1 of one image from matched dots (robust: Cauchy weights of width ``scale`` px).

    Focal factor and k1 are held to ``start`` by weak priors, since one image of a flat body hardly separates them from
    the distance. Returns camera_T_body and the camera.
    """
    corner = np.hypot(start.width / start.fx, start.height / start.fy) / 2.0
    sigma_k1 = _CORNER_DISTORTION / corner**2
    at_k1 = INTRINSIC_NAMES.index("k1")
    at_f = [INTRINSIC_NAMES.index("fx"), INTRINSIC_NAMES.index("fy")]
    pose = camera_T_body
    prior = np.array([1.0 / _SIGMA_LOG_FOCAL, 1.0 / sigma_k1]) * 1.0

    def cost(p: Array, c: Camera) -> float:
        r = (xy - project(c, transform(p, points))) / scale
        s = np.sum(r**2, axis=1)
        if not np.isfinite(s).all():
            return np.inf
        return float(np.sum(np.log1p(s))) + float(np.sum((prior * _lens_off(start, c)) ** 2))

    damping, value = 1e-4, cost(pose, camera)
    for _ in range(iterations):
        value_xy, d_point, d_lens = project_with_jacobians(camera, transform(pose, points))
        R = pose[:3, :3]
        by_pose = d_point @ np.concatenate([np.broadcast_to(R, (len(points), 3, 3)), -R @ skew(points)], axis=-1)
        by_focal = d_lens[:, :, at_f[0]] * camera.fx + d_lens[:, :, at_f[1]] * camera.fy
        J = np.concatenate([by_pose, by_focal[..., None], d_lens[:, :, at_k1, None]], axis=-1) / scale
        r = (xy - value_xy) / scale
        weight = 1.0 / (1.0 + np.sum(r**2, axis=1))
        N = np.einsum("m,mia,mib->ab", weight, J, J)
        g = np.einsum("m,mia,mi->a", weight, J, r)
        N[[6, 7], [6, 7]] += prior**2
        g[6:] -= prior**2 * _lens_off(start, camera)
        step = np.linalg.solve(N + damping * np.diag(np.diag(N)) + 1e-30 * np.eye(8), g)
        trial_pose = retract(pose, step[:6])
        factor = float(np.exp(np.clip(step[6], -0.2, 0.2)))
        trial = replace(camera, fx=camera.fx * factor, fy=camera.fy * factor, k1=camera.k1 + float(step[7]))
        trial_value = cost(trial_pose, trial)
        if trial_value <= value:
            gain = value - trial_value
            pose, camera, value, damping = trial_pose, trial, trial_value, damping * 0.2
            if gain < 1e-6 * (1e-3 + value):
                break
        else:
            damping = max(damping, 1e-4) * 10.0
            if damping > 1e6:
                break
    return pose, camera


def _lens_off(start: Camera, camera: Camera) -> Array:
    return np.array([np.log(camera.fx / start.fx), camera.k1 - start.k1])


def _assign(predicted: Array, xy: Array, tree: cKDTree, gate: float) -> tuple[IntArray, IntArray]:
    """One-to-one matches within ``gate`` px that leave the smallest sum of squares; rows of targets and dots."""
    ok = np.flatnonzero(np.isfinite(predicted).all(axis=1))
    near = tree.query_ball_point(predicted[ok], gate)
    columns = np.unique(np.concatenate([np.asarray(n, dtype=np.int64) for n in near])) if len(ok) else ok
    if len(columns) == 0:
        return np.empty(0, dtype=np.int64), np.empty(0, dtype=np.int64)
    d2 = np.sum((predicted[ok][:, None] - xy[columns][None]) ** 2, axis=-1) / gate**2
    rows, cols = linear_sum_assignment(np.minimum(d2, 1.0))
    keep = d2[rows, cols] < 1.0
    return ok[rows[keep]], columns[cols[keep]]


@dataclass(frozen=True)
class View:
    """What another camera sees of the same body at the same time: unit vector (3,) from the body to that camera in
    body coordinates, ``seen`` and ``inside`` (n,): target identified, target within that image."""

    direction: Array
    seen: NDArray[np.bool_]
    inside: NDArray[np.bool_]


def view_of(found: Grown, points: Array) -> View:
    """A numbering as other cameras' evidence."""
    seen = np.zeros(len(points), dtype=bool)
    seen[found.targets] = True
    return View(_direction(found.camera_T_body, points), seen, _inside(found, points))


def _direction(camera_T_body: Array, points: Array) -> Array:
    towards = -camera_T_body[:3, :3].T @ camera_T_body[:3, 3] - points.mean(axis=0)
    return np.asarray(towards / np.linalg.norm(towards))


def log_odds(
    found: Grown, points: Array, *, sigma: float, density: float, others: Sequence[View] = ()
) -> float:
    """Log odds of a numbering against chance: each matched dot against dots at random, each missing one against it.

    Parameters
    ----------
    sigma : px per coordinate of a matched dot; errors are taken with long tails (Student, three degrees of freedom).
    density : dots of like look per px^2 where the body is.
    others : what cameras of known numbering see; those within 60 degrees of this camera's direction count.

    Notes
    -----
    How likely a dot is to be seen at all is taken from its neighbours on the body: where all of them are missing
    something stands before the body, where all of them are seen a missing one is telling. A camera that looks from a
    similar direction most likely sees the same dots.
    """
    inside = _inside(found, points)
    seen = np.zeros(len(points), dtype=bool)
    seen[found.targets] = True
    k = min(_NEIGHBOURS + 1, len(points))
    _, near = cKDTree(points).query(points, k=k)
    near = near[:, 1:]
    there = inside[near]
    hits = np.sum(seen[near] & there, axis=1) + 1.0
    trials = there.sum(axis=1) + 2.0
    own = _direction(found.camera_T_body, points)
    for other in others:
        if own @ other.direction > 0.5:
            hits += _OTHER * (other.seen & other.inside)
            trials += _OTHER * other.inside
    shown = hits / trials
    fit = -np.log(2.0 * np.pi * sigma**2 * density) - 2.5 * np.log1p((found.off / sigma) ** 2 / 3.0)
    missing = inside & ~seen
    return float(np.sum(np.log(shown[found.targets]) + fit)) + float(np.sum(np.log(1.0 - shown[missing])))


def usual_error(off: Array) -> float:
    """Scale per coordinate (px) of distances (k,) with long tails: their median is 1.3 scales (Student, three)."""
    return max(0.2, float(np.median(off)) / 1.3) if len(off) else np.inf


def _inside(found: Grown, points: Array) -> NDArray[np.bool_]:
    seen = project(found.camera, transform(found.camera_T_body, points))
    with np.errstate(invalid="ignore"):
        inside = (seen > 0).all(axis=1) & (seen[:, 0] < found.camera.width) & (seen[:, 1] < found.camera.height)
    return np.asarray(inside)


def rough_scores(camera: Camera, poses: Array, points: Array, tree: cKDTree, reach: float) -> Iterator[Array]:
    """Per batch of poses (k, 4, 4): sum over targets of a triangular reward for a dot within ``reach`` px."""
    for begin in range(0, len(poses), 2000):
        seen = project(camera, transform(poses[begin : begin + 2000, None], points))
        distance, _ = tree.query(np.where(np.isfinite(seen), seen, -1e6), distance_upper_bound=reach)
        yield np.sum(np.maximum(0.0, 1.0 - distance / reach), axis=1)
