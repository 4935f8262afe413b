"""From a rough pose to all dots it explains: match, refine pose, lens, match again."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment
from scipy.spatial import cKDTree

from robcal.estimation.levenberg import Linearised, levenberg
from robcal.estimation.summary import TerminationSettings
from robcal.photogrammetry.core.bodies import IntArray, line_ratio
from robcal.photogrammetry.core.camera import INTRINSIC_NAMES, Camera, project, project_with_jacobians
from robcal.transforms import Array, retract, skew, transform

_SIGMA_LOG_FOCAL = 0.15
_RADIAL, _DECENTRED = 0.03, 0.003
"""Prior standard deviations of the distortions in the image corner, as shares of the radius there."""
_AT = {name: k for k, name in enumerate(INTRINSIC_NAMES)}
_LAST_GATE = 2.5
"""Narrowest gate, px: centres of dots seen through water or lit from the side have errors with long tails."""
_BY_CHANCE = 0.015
"""Share of false dots within the last gate that is tolerable."""
_NEIGHBOURS = 6
"""Targets around one from which its chance to be seen is taken."""
_OTHER = 3.0
"""A camera from a similar direction counts as this many neighbours."""


@dataclass(frozen=True)
class Grown:
    """A numbering: rows of dots and of targets, pose, camera with adjusted lens, residuals (k,) px."""

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
    camera: Camera,
    camera_T_body: Array,
    points: Array,
    xy: Array,
    *,
    reach: float,
    tree: cKDTree | None = None,
    lens: Camera | None = None,
) -> Grown | None:
    """Match and refine until the matches stay, the gate following the residuals from ``reach`` (px) downwards.

    The gate stays so wide that systematic errors no lens explains do not cut off whole parts of the body, as far as
    the dots ``xy`` are sparse enough for it. ``lens`` is the camera that belongs to the pose, if adjusted already.
    Returns None where fewer than six dots, or dots in one line, are left.
    """
    tree = cKDTree(xy) if tree is None else tree
    extent = float(np.prod(np.maximum(np.ptp(xy, axis=0), 1.0)))
    last = float(np.clip(np.sqrt(_BY_CHANCE * extent / (np.pi * len(xy))), _LAST_GATE, max(_LAST_GATE, reach)))
    pose, lens, gate = camera_T_body, camera if lens is None else lens, reach
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
        typical = 1.4 * float(np.median(off))
        smaller = max(min(3.0 * typical, 0.75 * gate if step < 5 else gate), last)
        if steady and smaller >= 0.95 * gate:
            return now
        gate, before = smaller, now
    return before


_PoseAndLens = tuple[Array, Camera]


def refine_with_lens(
    start: Camera, camera: Camera, camera_T_body: Array, points: Array, xy: Array, *, scale: float, iterations: int = 15
) -> _PoseAndLens:
    """Pose, common focal factor, k1, p1 and p2 of one image from matched dots (Cauchy weights of width ``scale`` px).

    The four numbers of the lens are held to ``start`` by weak priors, since one image of a rather flat body hardly
    separates them from the pose; p1 and p2 also take up a tilted pane. Returns camera_T_body and the camera.
    """
    corner = np.hypot(start.width / start.fx, start.height / start.fy) / 2.0
    prior = 1.0 / np.array([_SIGMA_LOG_FOCAL, _RADIAL / corner**2, _DECENTRED / corner, _DECENTRED / corner])

    def cost(state: _PoseAndLens) -> float:
        pose, lens = state
        s = np.sum(((xy - project(lens, transform(pose, points))) / scale) ** 2, axis=1)
        return 0.5 * float(np.sum(np.log1p(s)) + np.sum((prior * _lens_off(start, lens)) ** 2))

    def linearise(state: _PoseAndLens) -> Linearised[_PoseAndLens]:
        pose, lens = state
        r, J = _whitened(pose, lens, points, xy, scale)
        weight = 1.0 / (1.0 + np.sum(r**2, axis=1))
        N = np.tensordot(J * weight[:, None, None], J, axes=((0, 1), (0, 1)))
        g = np.tensordot(J * weight[:, None, None], r, axes=((0, 1), (0, 1)))
        held = np.arange(6, 10)
        N[held, held] += prior**2
        g[held] -= prior**2 * _lens_off(start, lens)

        def propose(damping: float) -> tuple[_PoseAndLens, float]:
            step = np.linalg.solve(N + np.diag(damping * np.diag(N)), g)
            return (retract(pose, step[:6]), _changed(lens, step[6:])), float(g @ step - 0.5 * step @ N @ step)

        return Linearised(cost(state), propose, cost)

    settings = TerminationSettings(iterations, cost_tolerance=1e-5)
    return levenberg(linearise, (camera_T_body, camera), settings)[0]


def _whitened(pose: Array, lens: Camera, points: Array, xy: Array, scale: float) -> tuple[Array, Array]:
    """Residuals (n, 2) in units of ``scale`` and their derivatives (n, 2, 10) by pose, log focal length, k1, p1, p2."""
    predicted, d_point, d_lens = project_with_jacobians(lens, transform(pose, points))
    R = pose[:3, :3]
    by_pose = d_point @ np.concatenate([np.broadcast_to(R, (len(points), 3, 3)), -R @ skew(points)], axis=-1)
    by_focal = d_lens[:, :, _AT["fx"]] * lens.fx + d_lens[:, :, _AT["fy"]] * lens.fy
    by_rest = d_lens[:, :, [_AT["k1"], _AT["p1"], _AT["p2"]]]
    return (xy - predicted) / scale, np.concatenate([by_pose, by_focal[..., None], by_rest], axis=-1) / scale


def _changed(lens: Camera, step: Array) -> Camera:
    """The camera after a step (4,) of log focal length (at most 0.2), k1, p1, p2."""
    factor = float(np.exp(np.clip(step[0], -0.2, 0.2)))
    k1, p1, p2 = (float(v) for v in step[1:])
    return replace(lens, fx=lens.fx * factor, fy=lens.fy * factor, k1=lens.k1 + k1, p1=lens.p1 + p1, p2=lens.p2 + p2)


def _lens_off(start: Camera, camera: Camera) -> Array:
    others = (camera.k1 - start.k1, camera.p1 - start.p1, camera.p2 - start.p2)
    return np.array([np.log(camera.fx / start.fx), *others])


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


def without_stragglers(found: Grown) -> Grown:
    """The dots within five usual errors (2.5 px at least): the others fit by chance as well as not."""
    keep = found.off <= max(_LAST_GATE, 5.0 * usual_error(found.off))
    return replace(found, dots=found.dots[keep], targets=found.targets[keep], off=found.off[keep])


def view_of(found: Grown, points: Array) -> View:
    """A numbering as other cameras' evidence."""
    seen = np.zeros(len(points), dtype=bool)
    seen[found.targets] = True
    return View(_direction(found.camera_T_body, points), seen, _inside(found, points))


def _direction(camera_T_body: Array, points: Array) -> Array:
    towards = -camera_T_body[:3, :3].T @ camera_T_body[:3, 3] - points.mean(axis=0)
    return np.asarray(towards / np.linalg.norm(towards))


def log_odds(found: Grown, points: Array, *, sigma: float, density: float, others: Sequence[View] = ()) -> float:
    """Log odds of a numbering against chance: each matched dot against dots at random, each missing one against it.

    Parameters
    ----------
    sigma : px per coordinate of a matched dot; errors are taken with long tails (Student, five degrees of freedom).
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
    near = np.asarray(cKDTree(points).query(points, k=k)[1])[:, 1:]
    there = inside[near]
    hits = np.sum(seen[near] & there, axis=1) + 1.0
    trials = there.sum(axis=1) + 2.0
    own = _direction(found.camera_T_body, points)
    for other in others:
        if own @ other.direction > 0.5:
            hits += _OTHER * (other.seen & other.inside)
            trials += _OTHER * other.inside
    shown = hits / trials
    fit = -np.log(2.0 * np.pi * sigma**2 * density) - 3.5 * np.log1p((found.off / sigma) ** 2 / 5.0)
    missing = inside & ~seen
    return float(np.sum(np.log(shown[found.targets]) + fit)) + float(np.sum(np.log(1.0 - shown[missing])))


def usual_error(off: Array) -> float:
    """Scale per coordinate (px) of distances (k,) with long tails: their median is 1.26 scales (Student, five)."""
    return max(0.2, float(np.median(off)) / 1.26) if len(off) else np.inf


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
