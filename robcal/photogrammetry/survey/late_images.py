"""Images with only three identified targets: placed once the rest of the network is known.

Three points leave up to four poses; the other known targets, which must meet detections, select the right one.
"""

import numpy as np
from scipy.spatial import cKDTree

from robcal.errors import DegenerateGeometry
from robcal.photogrammetry.core.camera import Camera, project
from robcal.photogrammetry.core.network import IntArray
from robcal.photogrammetry.orientation.closed_form import start_poses
from robcal.photogrammetry.orientation.robust_pose import refine_robust
from robcal.transforms import Array, transform

_MATCHES = 8
_SHARE = 0.5


def place_late(
    camera: Camera, points: Array, identified: IntArray, xy_identified: Array, xy_all: Array, gate: float
) -> Array | None:
    """camera_T_body (4, 4) of an image with three identified targets, or None if no pose explains the other dots.

    Parameters
    ----------
    points : (t, 3) all known targets. identified : (3,) rows of the identified ones, at ``xy_identified`` (3, 2).
    xy_all : (d, 2) all detections. gate : px within which a target meets a detection.
    """
    try:
        starts = start_poses(camera, xy_identified, points[identified])
    except DegenerateGeometry:
        return None  # three targets in one line carry no pose
    tree = cKDTree(xy_all)
    best: tuple[int, Array] | None = None
    for T in starts:
        for _ in range(3):
            rows, hits = _meetings(camera, T, points, tree, gate)
            if len(rows) < _MATCHES:
                break
            T = refine_robust(camera, T[None], points[rows], xy_all[hits], gate / 3.0)[0]
        rows, hits = _meetings(camera, T, points, tree, gate / 3.0)
        if len(rows) >= max(_MATCHES, _SHARE * len(xy_all)) and (best is None or len(rows) > best[0]):
            best = len(rows), T
    return None if best is None else best[1]


def _meetings(camera: Camera, T: Array, points: Array, tree: cKDTree, gate: float) -> tuple[IntArray, IntArray]:
    """Rows of targets and of the detections they meet, one to one."""
    xy = project(camera, transform(T, points))
    rows = np.flatnonzero(np.isfinite(xy).all(axis=1))
    if len(rows) == 0:
        return rows, rows
    distance, found = tree.query(xy[rows], distance_upper_bound=gate)
    nearest = np.asarray(found, dtype=np.int64)
    close = np.isfinite(distance)
    rows, nearest = rows[close], nearest[close]
    _, first, counts = np.unique(nearest, return_index=True, return_counts=True)
    alone = first[counts == 1]
    return rows[alone], nearest[alone]
