"""A body with rows of uncoded dots (grid, stepped plate) found in one image among many false dots.

Rows of the image (:mod:`identify_rows`) give poses, each pose grows to all dots it explains (:mod:`identify_grow`),
and every rival numbering that the body's own shape allows (:mod:`identify_congruence`) is tried as hard as the best
before it is believed: a grid shifted by one step explains all dots but those of its edge.

Rival numberings: rigid motions that lay a body (mostly) on itself, as steps along a grid or half turns do.
"""

from collections.abc import Sequence

import numpy as np
from scipy.spatial import cKDTree

from robcal.photogrammetry.core.bodies import IntArray
from robcal.photogrammetry.core.camera import Camera
from robcal.photogrammetry.identify.dots import Dots
from robcal.photogrammetry.identify.grow import (
    Grown,
    View,
    grow,
    log_odds,
    rough_scores,
    usual_error,
    without_stragglers,
)
from robcal.photogrammetry.identify.rows import body_rows, image_rows, row_hypotheses
from robcal.photogrammetry.orientation.p3p import _triangle_frame
from robcal.transforms import Array, invert, transform

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


_MIN_TARGETS = 12
_SAME = 7.0
"""Difference of log odds below which two numberings cannot be distinguished (odds of 1000 to 1)."""
_GROWN = 12
_FEWEST = 0.35
"""Share of the body's targets that must be seen."""
_REASON = "the dots show no rows that fit the body's rows"


def has_rows(points: Array) -> bool:
    """True where a body is large and regular enough for this search."""
    return len(points) >= _MIN_TARGETS and len(body_rows(points)) >= 2


def search_grid(
    camera: Camera, dots: Dots, points: Array, *, model_error_px: float, others: Sequence[View] = ()
) -> tuple[list[Grown], str]:
    """Numberings (targets are rows of ``points``) that cannot be distinguished, the best first; else a reason.

    Parameters
    ----------
    dots : of the image. points : (n, 3) m, body coordinates of the targets that may appear.
    model_error_px : error that the camera's start values may cause along two rows.
    others : what cameras of known numbering see of the same body at the same time (by row of ``points``).
    """
    rows = body_rows(points)
    if len(rows) < 2 or len(dots) < _MIN_TARGETS:
        return [], _REASON
    chains = image_rows(dots, longest_step=0.12 * float(np.hypot(camera.width, camera.height)))
    if len(chains) < 2:
        return [], f"{len(chains)} rows of dots in the image, two are needed"
    tolerance = model_error_px + 2.0
    best: Grown | None = None
    best_score = -np.inf
    for poses, used in row_hypotheses(camera, dots.xy, points, rows, chains, tolerance):
        own = _like(dots, used)
        near = dots.xy[own]
        tree = cKDTree(near)
        score = np.concatenate(list(rough_scores(camera, poses, points, tree, 2.0 * tolerance)))
        for k in np.argsort(-score, kind="stable")[:_GROWN]:
            found = grow(camera, poses[k], points, near, reach=2.0 * tolerance, tree=tree)
            if found is None or found.rms > tolerance:
                continue
            density = _density(near[found.dots], near)
            value = log_odds(found, points, sigma=usual_error(found.off), density=density)
            if value > best_score:
                best_score, best = value, _renumbered(found, own)
        # half of a body is no accident; with less, other rows of the image may show more of it
        if best is not None and len(best.dots) >= 0.5 * len(points) and _believed(best, len(points), best_score)[0]:
            break
    if best is None:
        return [], _REASON
    believed, why = _believed(best, len(points), best_score)
    if not believed:
        return [], why
    return _with_rivals(camera, dots, points, best, tolerance, others), ""


def _like(dots: Dots, used: IntArray) -> IntArray:
    """Rows of the dots that look like those of two chains."""
    size, contrast = dots.size, dots.contrast
    near = np.abs(np.log(size / np.median(size[used]))) < np.log(2.2)
    near &= np.abs(np.log(np.abs(contrast) / np.median(np.abs(contrast[used])))) < np.log(4.0)
    near[used] = True
    return np.flatnonzero(near)


def _renumbered(found: Grown, own: IntArray) -> Grown:
    return Grown(own[found.dots], found.targets, found.camera_T_body, found.camera, found.off)


def _density(matched: Array, like: Array) -> float:
    """Other dots of like size and brightness (k, 2) per px^2 in the rectangle that the matched ones (n, 2) span."""
    low, high = matched.min(axis=0), matched.max(axis=0)
    inside = float(((like >= low) & (like <= high)).all(axis=1).sum()) - len(matched)
    return max(inside, 3.0) / float(np.prod(np.maximum(high - low, 1.0)))


def _believed(found: Grown, n: int, value: float) -> tuple[bool, str]:
    """Enough dots, and log odds beyond all hypotheses that could have been tried (a million and a margin).

    Five dots' worth of odds is spent on pose and lens.
    """
    kept = len(without_stragglers(found).dots)
    if kept >= max(8, _FEWEST * n) and value * (1.0 - 5.0 / kept) > np.log(1e6) + _SAME:
        return True, ""
    return False, f"only {kept} of {n} targets fit the rows of dots in the image"


def _with_rivals(
    camera: Camera, dots: Dots, points: Array, best: Grown, tolerance: float, others: Sequence[View]
) -> list[Grown]:
    """The best numbering, after trying all that the body's shape allows, and those it does not clearly beat."""
    own = _like(dots, best.dots)
    near = dots.xy[own]
    tree = cKDTree(near)
    pool = [best]
    for motion in congruences(points, best.targets):
        start = best.camera_T_body @ invert(motion)
        rival = grow(camera, start, points, near, reach=tolerance, tree=tree, lens=best.camera)
        if rival is not None:
            pool.append(_renumbered(rival, own))
    pool = [without_stragglers(f) for f in pool]
    sigma = min(usual_error(f.off) for f in pool if len(f.dots) >= 0.9 * max(len(g.dots) for g in pool))
    density = _density(dots.xy[best.dots], near)
    value = [log_odds(f, points, sigma=sigma, density=density, others=others) for f in pool]
    order = np.argsort([-v for v in value], kind="stable")
    first = pool[order[0]]
    numbers = dict(zip(first.dots.tolist(), first.targets.tolist(), strict=True))
    out = [first]
    for k in order[1:]:
        f = pool[k]
        other = [numbers[int(d)] != int(t) for d, t in zip(f.dots, f.targets, strict=True) if int(d) in numbers]
        # a stray dot more or less is the same numbering; a half turn may leave one row of several as it is
        if (not other or np.mean(other) > 0.2) and value[k] > value[order[0]] - _SAME:
            out.append(f)
    return out
