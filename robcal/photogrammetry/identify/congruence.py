"""Rival numberings: rigid motions that lay a body (mostly) on itself, as steps along a grid or half turns do."""

import numpy as np
from scipy.spatial import cKDTree

from robcal.photogrammetry.core.bodies import IntArray
from robcal.photogrammetry.orientation.p3p import _triangle_frame
from robcal.transforms import Array, transform

_MAX_TRIPLES = 40_000


def congruences(points: Array, seen: IntArray, *, share: float = 0.75, tolerance: float | None = None) -> Array:
    """Rigid motions (k, 4, 4), identity excluded, that carry most seen points onto points of the body.

    Parameters
    ----------
    points : (n, 3) m of the body. seen : rows of the points in question. share : of the seen points that must fall
        on a point. tolerance : m; by default a tenth of the median distance between neighbours.

    Returns
    -------
    Motions ``body_T_body``: a camera pose ``camera_T_body @ inv(motion)`` shows the seen dots at the same places
    under other numbers. Weakness: each motion must carry one of three base triangles as a whole.
    """
    tree = cKDTree(points)
    if tolerance is None:
        tolerance = 0.1 * float(np.median(np.asarray(tree.query(points, k=2)[0])[:, 1]))
    distance = np.linalg.norm(points[:, None] - points[None], axis=-1)
    found: dict[bytes, Array] = {}
    identity = seen.astype(np.int64)
    for base in _base_triangles(points, seen):
        images = _same_triangles(distance, base, 2.0 * tolerance)
        if len(images) == 0:
            continue
        own = np.broadcast_to(points[base], (len(images), 3, 3))
        motions = _triangle_frame(points[images]) @ np.linalg.inv(_triangle_frame(own))
        motions = motions[np.isfinite(motions).all(axis=(1, 2))]
        moved = transform(motions[:, None], points[seen][None])
        nearest = tree.query(moved)
        hit = np.asarray(nearest[0]) < tolerance
        for motion, onto, there in zip(motions, np.asarray(nearest[1]), hit, strict=True):
            if there.mean() < share or np.array_equal(onto[there], identity[there]):
                continue
            found.setdefault(np.where(there, onto, -1).tobytes(), motion)
    return np.array(list(found.values())).reshape(-1, 4, 4)


def _base_triangles(points: Array, seen: IntArray) -> list[IntArray]:
    """Three wide triangles of seen points; different ones, since a motion may carry a corner off the body."""
    rng = np.random.default_rng(0)
    p = points[seen]
    best: list[tuple[float, IntArray]] = []
    for _ in range(200):
        a = rng.choice(len(p), 3, replace=False)
        # compact triangles stay on the body under more motions than wide ones: area by the cube root of extent
        u, v = p[a[1]] - p[a[0]], p[a[2]] - p[a[0]]
        area = float(np.linalg.norm(np.cross(u, v)))
        extent = float(np.linalg.norm([u, v, u - v], axis=1).max())
        best.append((area / max(extent, 1e-300) ** 2 * (1.0 - 0.3 * rng.random()), seen[a]))
    best.sort(key=lambda item: -item[0])
    return [triangle for _, triangle in best[:3]]


def _same_triangles(distance: Array, base: IntArray, tolerance: float) -> IntArray:
    """Ordered triples (k, 3) of points with the mutual distances of ``base``."""
    a, b, c = base
    first, second = np.nonzero(np.abs(distance - distance[a, b]) < tolerance)
    first, second = first[:_MAX_TRIPLES], second[:_MAX_TRIPLES]
    fits = np.abs(distance[first] - distance[a, c]) < tolerance
    fits &= np.abs(distance[second] - distance[b, c]) < tolerance
    row, third = np.nonzero(fits)
    return np.column_stack([first[row], second[row], third])[:_MAX_TRIPLES]
