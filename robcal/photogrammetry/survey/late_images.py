"""Images with only three identified targets: placed once the rest of the network is known.

Three points leave up to four poses; the other known targets, which must meet detections, select the right one.
"""

from __future__ import annotations

import cv2
import numpy as np
from scipy.spatial import cKDTree

from robcal.photogrammetry.core.camera import Camera, project
from robcal.photogrammetry.core.network import IntArray
from robcal.photogrammetry.orientation.start_resection import ideal_points, refine
from robcal.transforms import Array, frame, transform

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
    centre = points.mean(axis=0)
    ideal = ideal_points(camera, xy_identified)
    try:
        _, rvecs, tvecs = cv2.solveP3P(
            (points[identified] - centre)[:, None], ideal[:, None], np.eye(3), None, flags=cv2.SOLVEPNP_AP3P
        )
    except cv2.error:
        return None  # three targets in one line carry no pose
    tree = cKDTree(xy_all)
    best: tuple[int, Array] | None = None
    for r, t in zip(rvecs, tvecs, strict=True):
        T = frame(cv2.Rodrigues(np.asarray(r, dtype=float))[0], np.ravel(t)) @ frame(np.eye(3), -centre)
        if not np.all(np.isfinite(T)):
            continue
        for _ in range(3):
            rows, hits = _meetings(camera, T, points, tree, gate)
            if len(rows) < _MATCHES:
                break
            T = refine(camera, T, points[rows], xy_all[hits], gate / 3.0)
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
