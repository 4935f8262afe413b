"""Closed-form poses of a known body in one image: start values for the least squares.

IPPE for planes (Collins and Bartoli 2014), SQPnP for spatial bodies (Terzakis and Lourakis 2020), three-point poses
over many triples where marks may be misidentified (Fischler and Bolles 1981).
"""

from itertools import combinations

import cv2
import numpy as np
from numpy.typing import NDArray

from robcal.errors import DegenerateGeometry
from robcal.photogrammetry.core.bodies import line_ratio, thickness_ratio
from robcal.photogrammetry.core.camera import Camera, normalise, project
from robcal.photogrammetry.orientation.p3p import three_point_poses
from robcal.transforms import Array, frame, transform

LINE = 0.01
"""Targets whose spread across their line is below this share of its length carry no pose."""


def start_poses(camera: Camera, xy: Array, points: Array) -> list[Array]:
    """Closed-form poses camera_T_body of at least three marks, the likelier first; empty where none exists.

    Raises
    ------
    DegenerateGeometry : fewer than three marks, or all in one line.
    """
    if len(points) < 3:
        raise DegenerateGeometry(f"a resection needs at least three targets in the image, got {len(points)}")
    if line_ratio(points) < LINE:
        raise DegenerateGeometry("the targets seen lie in one line: their image does not fix a pose")
    ideal = normalise(camera, xy)
    use = np.isfinite(ideal).all(axis=1)
    if use.sum() < 3:
        return []
    centre = points[use].mean(axis=0)
    ideal, object_points = ideal[use], points[use] - centre
    if len(ideal) == 3:
        found = [T for T in three_point_poses(ideal[None], object_points[None])[0] if np.isfinite(T).all()]
        return [T @ frame(np.eye(3), -centre) for T in found]
    flat = thickness_ratio(object_points) < 0.02
    found = []
    methods = [cv2.SOLVEPNP_IPPE, cv2.SOLVEPNP_SQPNP] if flat else [cv2.SOLVEPNP_SQPNP]
    for method in methods:
        try:
            _, rotations, translations, _ = cv2.solvePnPGeneric(
                object_points, np.ascontiguousarray(ideal[:, None]), np.eye(3), None, flags=method
            )
        except cv2.error:  # degenerate for this solver; the other one or the three-point search may still do
            continue
        for rotation, translation in zip(rotations, translations, strict=True):
            T = frame(cv2.Rodrigues(rotation)[0], np.ravel(translation))
            if np.isfinite(T).all() and np.all(transform(T, object_points)[:, 2] > 0):
                found.append(T @ frame(np.eye(3), -centre))
        if flat and len(found) >= 2:
            break
    return found


def three_point_search(
    camera: Camera, xy: Array, points: Array, *, tolerance_px: float, seed: int = 1, triples: int = 300
) -> tuple[Array | None, NDArray[np.bool_]]:
    """Pose that most marks agree with, although some are misidentified: three-point solutions, counted inliers.

    Returns the pose (None where no triple works) and the mask of marks within ``tolerance_px`` of it.
    """
    ideal = normalise(camera, xy)
    usable = np.flatnonzero(np.isfinite(ideal).all(axis=1))
    none = np.zeros(len(xy), dtype=bool)
    if len(usable) < 3:
        return None, none
    if len(usable) <= 13:
        chosen = np.array(list(combinations(usable, 3)))
    else:
        rng = np.random.default_rng(seed)
        chosen = np.array([rng.choice(usable, 3, replace=False) for _ in range(triples)])
    poses = three_point_poses(ideal[chosen], points[chosen]).reshape(-1, 4, 4)
    poses = poses[np.isfinite(poses[:, 0, 0])]
    if len(poses) == 0:
        return None, none
    off = np.linalg.norm(project(camera, transform(poses[:, None], points)) - xy, axis=-1)
    off = np.where(np.isfinite(off), off, np.inf)
    score = np.sum(np.minimum(off / tolerance_px, 1.0) ** 2, axis=1)
    best = int(np.argmin(score))
    return poses[best], off[best] < tolerance_px
