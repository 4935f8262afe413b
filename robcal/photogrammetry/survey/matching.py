"""Which uncoded dot is which: guided matching to known points.

Known points are projected with propagated covariance; a detection is taken only if it is alone within the gate of a
point that is alone within its reach.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from robcal.photogrammetry.core.camera import Camera, project_with_jacobians
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
    def of(cls, network: CameraNetwork) -> "Geometry":
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

    def with_points(self, points: Array, covariance: Array) -> "Geometry":
        """The same cameras with more points."""
        return Geometry(
            self.camera,
            self.camera_T_body,
            np.concatenate([self.points, points]),
            self.pose_covariance,
            np.concatenate([self.points_covariance, covariance]),
            self.intrinsics_covariance,
        )

    def with_stations(self, camera_T_body: Array, covariance: Array) -> "Geometry":
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
