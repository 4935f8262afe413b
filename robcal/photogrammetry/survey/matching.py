"""Which uncoded dot is which: guided matching to known points, and new points from consistency over many images.

Known points are projected with propagated covariance; a detection is taken only if it is alone within the gate of a
point that is alone within its reach. New points are hypotheses from pairs of images (rays that meet inside the body's
surroundings), accepted in the order of their support in all images; what stays ambiguous is left out.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from robcal.photogrammetry.core.camera import Camera, normalise, project, project_with_jacobians
from robcal.photogrammetry.core.network import CameraNetwork, IntArray
from robcal.transforms import Array, skew, transform

_GATE_SIGMA = 4.0
_GATE_FLOOR = 0.5
"""px added to every gate: eccentricity, small systematic effects."""


@dataclass(frozen=True)
class Sightings:
    """All detections of the placed images: image (d,), xy (d, 2), sigma (d,) px, semi-major axis (d,) px or NaN."""

    image: IntArray
    xy: Array
    sigma: Array
    size: Array


@dataclass(frozen=True)
class Geometry:
    """Where cameras and points are believed to be, with the uncertainty of predictions.

    ``pose_covariance`` (n, 6, 6), ``points_covariance`` (t, 3, 3), ``intrinsics_covariance`` (9, 9).
    """

    camera: Camera
    camera_T_body: Array
    points: Array
    pose_covariance: Array
    points_covariance: Array
    intrinsics_covariance: Array

    @classmethod
    def of(cls, network: CameraNetwork) -> Geometry:
        """Geometry of an adjusted network."""
        t = len(network.points)
        blocks = network.points_covariance.reshape(t, 3, t, 3)[np.arange(t), :, np.arange(t), :]
        return cls(
            network.camera,
            network.camera_T_body,
            network.points,
            network.pose_covariance,
            blocks,
            network.intrinsics_covariance,
        )

    def with_points(self, points: Array, covariance: Array) -> Geometry:
        """The same cameras with more points."""
        return Geometry(
            self.camera,
            self.camera_T_body,
            np.concatenate([self.points, points]),
            self.pose_covariance,
            np.concatenate([self.points_covariance, covariance]),
            self.intrinsics_covariance,
        )

    def with_stations(self, camera_T_body: Array, covariance: Array) -> Geometry:
        """The same points with more cameras."""
        return Geometry(
            self.camera,
            np.concatenate([self.camera_T_body, camera_T_body]),
            self.points,
            np.concatenate([self.pose_covariance, covariance]),
            self.points_covariance,
            self.intrinsics_covariance,
        )

    def predict(self, image: int) -> tuple[Array, Array]:
        """Image points (t, 2) and their standard deviations (t,), larger axis; NaN where not in the picture.

        Correlations between station and points are neglected, which makes the gate wider, not narrower.
        """
        T = self.camera_T_body[image]
        p = transform(T, self.points)
        xy, d_point, d_in = project_with_jacobians(self.camera, p)
        JX = d_point @ T[:3, :3]
        JP = np.concatenate([JX, -JX @ skew(self.points)], axis=2)
        C = JX @ self.points_covariance @ np.swapaxes(JX, 1, 2)
        C += JP @ self.pose_covariance[image] @ np.swapaxes(JP, 1, 2)
        C += d_in @ self.intrinsics_covariance @ np.swapaxes(d_in, 1, 2)
        sigma = np.sqrt(np.maximum(np.trace(C, axis1=1, axis2=2), 0.0))
        size = np.array([self.camera.width, self.camera.height])
        outside = ~np.all((xy > -0.5) & (xy < size - 0.5), axis=1)
        xy[outside] = np.nan
        return xy, sigma


def facing(geometry: Geometry, normals: Array, image: int, limit: float = 0.1) -> NDArray[np.bool_]:
    """(t,) true where a point's front may be seen; unknown normals and planes (sign open) always may."""
    T = geometry.camera_T_body[image]
    p = transform(T, geometry.points)
    n = normals @ T[:3, :3].T
    cosine = -np.einsum("ti,ti->t", n, p) / np.linalg.norm(p, axis=1)
    return ~(cosine < limit)


def match_known(
    geometry: Geometry, sightings: Sightings, assigned: IntArray, normals: Array, largest_gate: float
) -> IntArray:
    """Assign free detections to known points: a copy of ``assigned`` (d,), -1 where still unknown.

    A point gets a detection only if that is the only one within its gate, and the detection lies within the gate of
    no other point. Points already seen in an image are not assigned again there.
    """
    out = assigned.copy()
    for image in np.unique(sightings.image):
        rows = np.flatnonzero(sightings.image == image)
        xy, sigma = geometry.predict(int(image))
        visible = np.isfinite(xy[:, 0]) & facing(geometry, normals, int(image))
        candidates = np.flatnonzero(visible)
        if len(candidates) == 0:
            continue
        gate = np.minimum(_GATE_SIGMA * np.hypot(sigma, np.median(sightings.sigma[rows])) + _GATE_FLOOR, largest_gate)
        taken = np.zeros(len(xy), dtype=bool)
        taken[out[rows][out[rows] >= 0]] = True
        tree = cKDTree(sightings.xy[rows])
        # all detections count as rivals, also the assigned ones
        near = tree.query_ball_point(xy[candidates], gate[candidates])
        claims: dict[int, list[int]] = {}
        for point, found in zip(candidates.tolist(), near, strict=True):
            if len(found) == 1:
                claims.setdefault(int(rows[found[0]]), []).append(point)
            else:
                for one in found:
                    claims.setdefault(int(rows[one]), []).extend([point, -1])
        for row, points in claims.items():
            if len(points) == 1 and out[row] < 0 and not taken[points[0]]:
                out[row] = points[0]
    return out


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
    partners: int = 4,
) -> NewPoints:
    """New points from detections that belong to no known point.

    Parameters
    ----------
    centre, radius : sphere in body coordinates outside which nothing can be a target.
    min_images : images that must support a point. gate : px within which a detection supports a point.
    """
    free = assigned < 0
    n = len(geometry.camera_T_body)
    R, t = geometry.camera_T_body[:, :3, :3], geometry.camera_T_body[:, :3, 3]
    station = -np.einsum("nij,ni->nj", R, t)
    ideal = normalise(geometry.camera, sightings.xy)
    rays = np.concatenate([ideal, np.ones((len(ideal), 1))], axis=1)
    rays = np.einsum("dij,di->dj", R[sightings.image], rays)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    free &= np.isfinite(rays[:, 0])
    view = (station - centre) / np.linalg.norm(station - centre, axis=1, keepdims=True)
    angle = np.arccos(np.clip(view @ view.T, -1.0, 1.0))
    points: list[Array] = []
    covariances: list[Array] = []
    members: list[IntArray] = []
    per_pixel = 1.0 / geometry.camera.fx
    idle = 0
    for i in _by_load(sightings.image[free], n):
        if idle > max(12, n // 4):
            break
        mine = np.flatnonzero(free & (sightings.image == i))
        if len(mine) == 0:
            continue
        # best base for the intersection about 35 degrees
        usable = np.flatnonzero((angle[i] > np.radians(8.0)) & (angle[i] < np.radians(75.0)))
        usable = usable[np.argsort(np.abs(angle[i, usable] - np.radians(35.0)))][: 3 * partners]
        loads = np.array([np.count_nonzero(free & (sightings.image == j)) for j in usable])
        hypotheses: list[Array] = []
        for j in usable[np.argsort(-loads, kind="stable")][:partners]:
            other = np.flatnonzero(free & (sightings.image == j))
            if len(other):
                tolerance = 1.5 * gate * per_pixel
                hypotheses.append(_meeting(station[i], rays[mine], station[j], rays[other], tolerance, centre, radius))
        candidates = np.concatenate(hypotheses) if hypotheses else np.zeros((0, 3))
        found = 0
        if len(candidates):
            accepted = _accept(geometry, sightings, free, candidates, view, gate, min_images)
            for point, C, rows in accepted:
                points.append(point)
                covariances.append(C)
                members.append(rows)
                free[rows] = False
                found += 1
        idle = 0 if found else idle + 1
    q = len(points)
    return NewPoints(np.array(points).reshape(q, 3), np.array(covariances).reshape(q, 3, 3), tuple(members))


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
    miss = np.linalg.norm(p - q, axis=2)
    middle = 0.5 * (p + q)
    good = (s > 0) & (u > 0) & (miss < tolerance * np.maximum(s, u))
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
        beside = view @ (mean_view / np.linalg.norm(mean_view)) > np.cos(np.radians(40.0))
        if len(fitted[2]) < 0.5 * np.count_nonzero(seen[c] & beside):
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
        for _ in range(4):
            T = geometry.camera_T_body[sightings.image[rows]]
            p = np.einsum("nij,j->ni", T[:, :3, :3], X) + T[:, :3, 3]
            xy, d_point, _ = project_with_jacobians(geometry.camera, p)
            J = np.einsum("nia,nab->nib", d_point, T[:, :3, :3])
            r = sightings.xy[rows] - xy
            A = np.einsum("nia,nib->ab", J, J)
            if not np.all(np.isfinite(A)) or np.linalg.cond(A) > 1e10:
                return None
            X = X + np.linalg.solve(A, np.einsum("nia,ni->a", J, r))
        miss = np.linalg.norm(r, axis=1)
        if miss.max() < gate:
            sigma = max(float(np.sqrt(np.mean(miss**2))), float(np.median(sightings.sigma[rows])), 0.02)
            return X, sigma**2 * np.linalg.inv(A), rows
        rows = np.delete(rows, int(np.argmax(miss)))
    return None


def seen_diameters(geometry: Geometry, points: Array, image: IntArray, semi_major: Array) -> Array:
    """Diameters (q,) m of dots from their semi-major axes (q,) px, at points (3,) or (q, 3); NaN where unknown.

    The major axis of a circle's image is not foreshortened (to first order of its size).
    """
    T = geometry.camera_T_body[image]
    depth = np.einsum("qi,qi->q", T[:, 2, :3], np.broadcast_to(points, (len(image), 3))) + T[:, 2, 3]
    return 2.0 * semi_major * depth / geometry.camera.fx


def is_dot(diameters: Array, sizes: Array) -> bool:
    """True if one dot seen with these diameters (q,) is of the same size everywhere and of a plausible one (k, 2).

    Reflections and edges change their size from picture to picture. Where sizes are unknown nothing is refused.
    """
    known = diameters[np.isfinite(diameters)]
    if len(known) < 2 or len(sizes) == 0:
        return True
    middle = float(np.median(known))
    spread = 1.4826 * float(np.median(np.abs(known - middle)))
    return spread < 0.15 * middle and bool(np.any((sizes[:, 0] < middle) & (middle < sizes[:, 1])))
