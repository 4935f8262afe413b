"""New targets from uncoded dots: rays of pairs of images that meet, accepted by their support in all images.

Hypotheses from pairs of images (rays that meet inside the body's surroundings) are accepted in the order of their
support; what stays ambiguous is left out.
"""

from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from robcal.estimation.gauss_newton import gauss_newton
from robcal.estimation.summary import TerminationSettings
from robcal.photogrammetry.core.camera import Camera, normalise, project, project_with_jacobians
from robcal.photogrammetry.core.network import IntArray
from robcal.photogrammetry.survey.matching import Geometry, Sightings
from robcal.transforms import Array, transform

_PARTNERS = 4
"""Images with which one is intersected."""
_TERMINATION = TerminationSettings(6, cost_tolerance=1e-6)
"""Of the intersection of one point; cost in px^2."""


@dataclass(frozen=True)
class NewPoints:
    """Points found from uncoded dots: coordinates (q, 3), covariances (q, 3, 3) and the detections of each."""

    points: Array
    covariance: Array
    members: tuple[IntArray, ...]


def find_new_points(
    geometry: Geometry,
    sightings: Sightings,
    assigned: IntArray,
    *,
    centre: Array,
    radius: float,
    min_images: int = 3,
    gate: float = 2.0,
) -> NewPoints:
    """New points from detections that belong to no known point.

    Parameters
    ----------
    centre, radius : sphere in body coordinates outside which nothing can be a target.
    min_images : images that must support a point. gate : px within which a detection supports a point.
    """
    n = len(geometry.camera_T_body)
    R, t = geometry.camera_T_body[:, :3, :3], geometry.camera_T_body[:, :3, 3]
    station = -np.einsum("nij,ni->nj", R, t)
    rays = _directions(geometry, sightings)
    free = (assigned < 0) & np.isfinite(rays[:, 0])
    view = (station - centre) / np.linalg.norm(station - centre, axis=1, keepdims=True)
    angle = np.arccos(np.clip(view @ view.T, -1.0, 1.0))
    tolerance = 1.5 * gate / geometry.camera.fx
    found: list[tuple[Array, Array, IntArray]] = []
    idle = 0
    for i in _by_load(sightings.image[free], n):
        if idle > max(12, n // 4):
            break
        mine = np.flatnonzero(free & (sightings.image == i))
        if len(mine) == 0:
            continue
        candidates = [np.zeros((0, 3))]
        for j in _partners(angle[i], sightings.image[free], _PARTNERS):
            other = np.flatnonzero(free & (sightings.image == j))
            if len(other):
                pair = station[i], rays[mine], station[j], rays[other]
                candidates.append(_meeting(*pair, tolerance, centre, radius))
        hypotheses = np.concatenate(candidates)
        accepted = _accept(geometry, sightings, free, hypotheses, view, gate, min_images) if len(hypotheses) else []
        for _, _, rows in accepted:
            free[rows] = False
        found += accepted
        idle = 0 if accepted else idle + 1
    q = len(found)
    return NewPoints(
        np.array([point for point, _, _ in found]).reshape(q, 3),
        np.array([C for _, C, _ in found]).reshape(q, 3, 3),
        tuple(rows for _, _, rows in found),
    )


def _directions(geometry: Geometry, sightings: Sightings) -> Array:
    """(d, 3) unit directions of the detections' rays in body coordinates."""
    ideal = normalise(geometry.camera, sightings.xy)
    rays = np.concatenate([ideal, np.ones((len(ideal), 1))], axis=1)
    rays = np.einsum("dij,di->dj", geometry.camera_T_body[sightings.image, :3, :3], rays)
    return np.asarray(rays / np.linalg.norm(rays, axis=1, keepdims=True))


def _partners(angle: Array, free_images: IntArray, count: int) -> IntArray:
    """Images to intersect one with: of those seen from about 35 degrees (best base) the ones with most free dots.

    ``angle`` (n,) rad between the views; ``free_images``: image of every free detection.
    """
    usable = np.flatnonzero((angle > np.radians(8.0)) & (angle < np.radians(75.0)))
    usable = usable[np.argsort(np.abs(angle[usable] - np.radians(35.0)))][: 3 * count]
    loads = np.bincount(free_images, minlength=len(angle))[usable]
    return usable[np.argsort(-loads, kind="stable")][:count]


def _by_load(images: IntArray, n: int) -> list[int]:
    return [int(i) for i in np.argsort(-np.bincount(images, minlength=n), kind="stable")]


def _meeting(a: Array, rays_a: Array, b: Array, rays_b: Array, tolerance: float, centre: Array, radius: float) -> Array:
    """Points (q, 3) where rays from a (p, 3) and from b (s, 3) pass within ``tolerance`` rad inside the sphere."""
    base = b - a
    dot = rays_a @ rays_b.T
    along_a, along_b = rays_a @ base, rays_b @ base
    det = np.maximum(1.0 - dot**2, 1e-12)
    s = (along_a[:, None] - dot * along_b[None]) / det
    u = (dot * along_a[:, None] - along_b[None]) / det
    p = a + s[..., None] * rays_a[:, None]
    q = b + u[..., None] * rays_b[None]
    distance = np.linalg.norm(p - q, axis=2)
    middle = 0.5 * (p + q)
    good = (s > 0) & (u > 0) & (distance < tolerance * np.maximum(s, u))
    good &= np.linalg.norm(middle - centre, axis=2) < radius
    return middle[good]


def _accept(
    geometry: Geometry,
    sightings: Sightings,
    free: NDArray[np.bool_],
    candidates: Array,
    view: Array,
    gate: float,
    min_images: int,
) -> list[tuple[Array, Array, IntArray]]:
    """Candidates that enough images support, best supported first, every detection used once.

    ``view`` (n, 3): unit directions from the body to the cameras.
    """
    n = len(geometry.camera_T_body)
    size = np.array([geometry.camera.width, geometry.camera.height])
    hits = np.full((len(candidates), n), -1, dtype=np.int64)
    seen = np.zeros((len(candidates), n), dtype=bool)
    for j in range(n):
        rows = np.flatnonzero(free & (sightings.image == j))
        xy = project(geometry.camera, transform(geometry.camera_T_body[j], candidates))
        inside = np.all((xy > 0) & (xy < size - 1), axis=1)
        seen[:, j] = inside
        if len(rows) == 0 or not inside.any():
            continue
        at = np.flatnonzero(inside)
        distance, found = cKDTree(sightings.xy[rows]).query(xy[at], distance_upper_bound=1.5 * gate)
        nearest = np.asarray(found, dtype=np.int64)
        close = np.isfinite(distance)
        hits[at[close], j] = rows[nearest[close]]
    support = np.count_nonzero(hits >= 0, axis=1)
    claimed: dict[int, int] = {}
    out: list[tuple[Array, Array, IntArray]] = []
    for c in np.argsort(-support, kind="stable"):
        if support[c] < min_images:
            break
        rows = hits[c][hits[c] >= 0]
        rows = np.array([r for r in rows.tolist() if r not in claimed], dtype=np.int64)
        # most of the support must not have been explained by a better point already
        if len(rows) < max(min_images, 0.6 * support[c]):
            continue
        fitted = _fit_point(geometry, sightings, candidates[c], rows, gate)
        if fitted is None or len(fitted[2]) < min_images:
            continue
        # pictures from about the same side should show it too; an accidental meeting of rays is seen by few of them
        mean_view = view[sightings.image[fitted[2]]].sum(axis=0)
        near = view @ (mean_view / np.linalg.norm(mean_view)) > np.cos(np.radians(40.0))
        if len(fitted[2]) < 0.5 * np.count_nonzero(seen[c] & near):
            continue
        for row in fitted[2].tolist():
            claimed[row] = int(c)
        out.append(fitted)
    return out


def _fit_point(
    geometry: Geometry, sightings: Sightings, start: Array, rows: IntArray, gate: float
) -> tuple[Array, Array, IntArray] | None:
    """Least-squares intersection (point, covariance, supporting rows), dropping what does not fit; None if it fails."""
    X = start
    for _ in range(6):
        if len(rows) < 2:
            return None
        T, xy = geometry.camera_T_body[sightings.image[rows]], sightings.xy[rows]
        residuals, linearise = partial(_residuals, geometry.camera, T, xy), partial(_linearised, geometry.camera, T, xy)
        X, _ = gauss_newton(linearise, residuals, np.add, X, _TERMINATION)
        r, J = linearise(X)
        N = J.T @ J
        if np.linalg.cond(N) > 1e10:
            return None
        residual = np.linalg.norm(r.reshape(-1, 2), axis=1)
        if residual.max() < gate:
            sigma = max(float(np.sqrt(np.mean(residual**2))), float(np.median(sightings.sigma[rows])), 0.02)
            return X, np.asarray(sigma**2 * np.linalg.inv(N)), rows
        rows = np.delete(rows, int(np.argmax(residual)))
    return None


def _residuals(camera: Camera, camera_T_body: Array, xy: Array, X: Array) -> Array:
    """(2m,) px of a point at X (3,), seen at ``xy`` (m, 2) from ``camera_T_body`` (m, 4, 4)."""
    return (xy - project(camera, transform(camera_T_body, X))).ravel()


def _linearised(camera: Camera, camera_T_body: Array, xy: Array, X: Array) -> tuple[Array, Array]:
    """The same with the Jacobian (2m, 3)."""
    predicted, by_point, _ = project_with_jacobians(camera, transform(camera_T_body, X))
    return (xy - predicted).ravel(), (by_point @ camera_T_body[:, :3, :3]).reshape(-1, 3)
