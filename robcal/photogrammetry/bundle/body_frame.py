"""The frame of a surveyed body: fitted onto given coordinates, or centroid and principal directions."""

from dataclasses import dataclass
from enum import Enum

import numpy as np

from robcal.photogrammetry.bundle.datum import spans_triangle
from robcal.photogrammetry.core.network import IntArray
from robcal.transforms import Array, fit_frame, invert, transform


class FrameOrigin(Enum):
    """What defines a frame (or, of scale bars, its scale alone)."""

    GIVEN_COORDINATES = "fitted onto the given coordinates"
    PRINCIPAL_AXES = "origin in the centroid, axes along the principal directions"
    SCALE_BARS = "scale bars"


@dataclass(frozen=True)
class Similarity:
    """``p_new = scale * new_T_old p_old``; ``targets``: how many were fitted."""

    scale: float
    new_T_old: Array
    origin: FrameOrigin
    targets: int = 0

    @property
    def description(self) -> str:
        """What defines the frame, for the report."""
        return f"{self.origin.value} of {self.targets} targets" if self.targets else self.origin.value

    def points(self, p_old: Array) -> Array:
        """Points in the new frame."""
        return transform(self.new_T_old, self.scale * p_old)

    def stations(self, camera_T_old: Array) -> Array:
        """Stations (n, 4, 4) with respect to the new frame."""
        scaled = np.array(camera_T_old, dtype=float)
        scaled[:, :3, 3] *= self.scale
        return scaled @ invert(self.new_T_old)


def fit_similarity(p_new: Array, p_old: Array, *, with_scale: bool, rounds: int = 3) -> Similarity:
    """Robust least-squares fit of at least three pairs (n, 3); pairs that stick out lose weight (Huber).

    Raises
    ------
    DegenerateGeometry : points in one line.
    """
    w = np.ones(len(p_new))
    scale, T = 1.0, np.eye(4)
    for _ in range(rounds):
        T = fit_frame(p_new, p_old, w)
        share = w / w.sum()
        a, b = p_new - share @ p_new, (p_old - share @ p_old) @ T[:3, :3].T
        scale = float(np.sum(w[:, None] * a * b) / np.sum(w[:, None] * b * b)) if with_scale else 1.0
        T = T.copy()
        T[:3, 3] = share @ p_new - scale * T[:3, :3] @ (share @ p_old)
        residual = np.linalg.norm(p_new - transform(T, scale * p_old), axis=1)
        limit = max(2.0 * float(np.median(residual)), 1e-12)
        w = np.where(residual > limit, limit / np.maximum(residual, 1e-300), 1.0)
    return Similarity(scale, T, FrameOrigin.GIVEN_COORDINATES, len(p_new))


def principal_frame(points: Array, station_centres: Array, ids: IntArray) -> Similarity:
    """Origin in the centroid, x and y along the two largest spreads, z towards the cameras (right-handed).

    The sense of x: the target with the lowest id has x >= 0. Weakness: for a square or round body the directions
    within its plane are arbitrary, though the same for the same data.
    """
    centre = points.mean(axis=0)
    centred = points - centre
    axes = np.linalg.svd(centred, full_matrices=False)[2]
    z = axes[2]
    if np.mean(station_centres - centre, axis=0) @ z < 0:
        z = -z
    x = axes[0]
    if centred[int(np.argmin(ids))] @ x < 0:
        x = -x
    R = np.stack([x, np.cross(z, x), z])
    T = np.eye(4)
    T[:3, :3] = R
    T[:3, 3] = -R @ centre
    return Similarity(1.0, T, FrameOrigin.PRINCIPAL_AXES)


def body_frame(points: Array, ids: IntArray, given: Array, station_centres: Array, *, with_scale: bool) -> Similarity:
    """Frame for points (t, 3) with given coordinates (t, 3; NaN where unknown).

    ``with_scale``: the scale is still free and is taken from given coordinates (two suffice for it).
    """
    known = np.isfinite(given).all(axis=1)
    if np.count_nonzero(known) >= 3 and spans_triangle(given[known]) and spans_triangle(points[known]):
        return fit_similarity(given[known], points[known], with_scale=with_scale)
    scale = 1.0
    if with_scale and np.count_nonzero(known) >= 2:
        rows = np.flatnonzero(known)
        a = given[rows] - given[rows].mean(axis=0)
        b = points[rows] - points[rows].mean(axis=0)
        scale = float(np.sqrt(np.sum(a**2) / np.sum(b**2)))
    base = principal_frame(scale * points, scale * station_centres, ids)
    return Similarity(scale, base.new_T_old, base.origin)
