"""Finding an uncoded body in an image from its geometry alone: three-point hypotheses, verification, uniqueness.

Each hypothesis puts three targets on three dots (P3P) and predicts all others. It is accepted only if chance would
hardly produce it (expected number of equally good accidents over all hypotheses below a limit) and if no other
numbering explains the dots as well: a symmetric arrangement is refused, not guessed.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import combinations, permutations

import numpy as np
from scipy import stats
from scipy.spatial import cKDTree

from robcal.photogrammetry.core.bodies import Body, IntArray, spans_plane
from robcal.photogrammetry.core.camera import Camera, normalise, project
from robcal.photogrammetry.identify.dots import Dots, match_dots
from robcal.photogrammetry.orientation.p3p import three_point_poses
from robcal.photogrammetry.orientation.resection import TargetMarks, refine_poses
from robcal.transforms import Array, transform

_CHANCE = 1e-3
_SAME = 14.0
"""Difference of chi-square below which two numberings cannot be distinguished (odds of 1000 to 1)."""
_BATCH = 20000
_MORE_TRIPLES = 1
"""Body triples tried beyond the first success, in search of rival numberings."""


@dataclass(frozen=True)
class Found:
    """One numbering of an image: ``rows`` of the dots, ``targets`` rows of the body, pose and cost."""

    rows: IntArray
    targets: IntArray
    camera_T_body: Array
    cost: float


def search_body(
    camera: Camera,
    dots: Dots,
    body: Body,
    candidates: IntArray,
    *,
    model_error_px: float,
    max_hypotheses: int = 120_000,
) -> tuple[list[Found], str]:
    """Numberings of uncoded dots that geometry supports, the best first.

    Parameters
    ----------
    dots : of the image, m of them. candidates : body rows that may appear (uncoded, with coordinates).
    model_error_px : error the camera's start values cause.
    max_hypotheses : three-point problems at most; triples of dots of similar size are tried first.

    Returns
    -------
    Believable numberings (two or more: ambiguous) and, where there is none, the reason.
    """
    n, m = len(candidates), len(dots)
    points, diameters, semi_major = body.points[candidates], body.diameters[candidates], dots.semi_axes[:, 0]
    if n < 4:
        return [], f"{n} uncoded targets with coordinates cannot be distinguished by geometry; four or more are needed"
    if m < 4:
        return [], f"only {m} dots in the image"
    if not spans_plane(points):
        return [], "the targets lie in one line"
    ideal = normalise(camera, dots.xy)
    tree = cKDTree(dots.xy)
    tolerance = 3.0 * model_error_px + 1.0
    tried = 0
    spare = _MORE_TRIPLES
    found: list[Found] = []
    why = "no arrangement of the dots fits the body"
    for triple in _body_triples(points):
        base = list(triple)
        pool: list[tuple[float, Array]] = []
        for three in _dot_triples(semi_major, diameters[base]):
            tried += len(three)
            poses = three_point_poses(ideal[three], np.broadcast_to(points[base], (len(three), 3, 3)))
            poses = poses[_right_size(camera, poses, points[base], diameters[base], semi_major[three])]
            if len(poses):
                pool += _best(camera, poses, semi_major, tree, points, diameters, tolerance)
        pool = sorted(pool, key=lambda item: item[0])[:60]
        if pool:
            more, why = _verify(camera, dots, points, pool, model_error_px, tried)
            found += [replace(f, targets=candidates[f.targets]) for f in more]
        # any other numbering that fits as well has this triple elsewhere in the image: it would be in the pool, too
        if any(len(f.rows) >= max(5, 0.6 * n) or len(f.rows) == n for f in found):
            if spare == 0:
                break
            spare -= 1
        if tried >= max_hypotheses:
            break
    return _unique(found, m, float(camera.width * camera.height)), why


def _right_size(camera: Camera, poses: Array, points: Array, diameters: Array, semi_major: Array) -> Array:
    """Mask (k, 4) of existing solutions whose distance agrees with the size of the three dots (where known)."""
    exists = np.isfinite(poses[..., 0, 0])
    if not np.isfinite(diameters).all():
        return exists
    z = np.einsum("ksj,nj->ksn", poses[..., 2, :3], points) + poses[..., 2, 3][..., None]
    with np.errstate(invalid="ignore", divide="ignore"):
        size = camera.fx * 0.5 * diameters / z
        fits = (semi_major[:, None] < 1.4 * size + 1.0) & (semi_major[:, None] > size / 1.4 - 1.0)
    return exists & fits.all(axis=-1)


def _body_triples(points: Array) -> Iterator[tuple[int, ...]]:
    """Triples of targets, the widest triangles first, each new one sharing as little as possible with those before."""
    n = len(points)
    if n > 12:
        rng = np.random.default_rng(0)
        pool = [tuple(sorted(int(i) for i in rng.choice(n, 3, replace=False))) for _ in range(150)]
    else:
        pool = list(combinations(range(n), 3))
    areas = {
        t: float(np.linalg.norm(np.cross(points[t[1]] - points[t[0]], points[t[2]] - points[t[0]]))) for t in set(pool)
    }
    largest = max(areas.values())
    left = [t for t in areas if areas[t] > 0.02 * largest]
    used = np.zeros(n)
    while left:
        best = max(left, key=lambda t: areas[t] / largest - 2.0 * float(used[list(t)].sum()))
        left.remove(best)
        used[list(best)] += 1
        yield best


def _dot_triples(semi_major: Array, diameters: Array) -> Iterator[IntArray]:
    """Ordered triples of dots in batches; where the targets' sizes are known, dots of unlike size are passed over."""
    m = len(semi_major)
    order = np.arange(m)
    if m > 60:  # the sizes most common among the dots first
        order = np.argsort(np.abs(np.log(semi_major / np.median(semi_major))), kind="stable")[:60]
    known = np.isfinite(diameters).all()
    batch: list[tuple[int, ...]] = []
    for chosen in combinations(order, 3):
        if known:
            relative = semi_major[list(chosen)]
            if relative.max() > 2.0 * relative.min() * diameters.max() / diameters.min():
                continue
        batch += permutations([int(i) for i in chosen])
        if len(batch) >= _BATCH:
            yield np.array(batch)
            batch = []
    if batch:
        yield np.array(batch)


def _best(
    camera: Camera, poses: Array, semi_major: Array, tree: cKDTree, points: Array, diameters: Array, tolerance: float
) -> list[tuple[float, Array]]:
    """Hypotheses by how well dots (in the ``tree``) stand where the points are predicted, with their scores."""
    p = transform(poses[:, None], points)
    seen = project(camera, p)
    ok = np.asarray(np.isfinite(seen).all(axis=-1))
    distance, index = tree.query(np.where(ok[..., None], seen, -1e6), distance_upper_bound=tolerance)
    size = camera.fx * 0.5 * diameters / np.where(p[..., 2] > 0, p[..., 2], np.nan)
    blob = semi_major[np.minimum(index, len(semi_major) - 1)]
    with np.errstate(invalid="ignore"):
        wrong = (blob > 1.7 * size + 1.0) | (blob < size / 1.7 - 1.0)
    offset = np.where(np.isfinite(distance) & ~wrong, distance / tolerance, 1.0)
    score = np.sum(offset**2, axis=1)
    matched = np.sum(offset < 1.0, axis=1)
    top = np.argsort(score, kind="stable")[:40]
    return [(float(score[k]), poses[k]) for k in top if matched[k] >= 4]


def _verify(
    camera: Camera, dots: Dots, points: Array, pool: list[tuple[float, Array]], model_error_px: float, tried: int
) -> tuple[list[Found], str]:
    """Refine the best hypotheses together, match again, and keep those that accidents would hardly produce."""
    m, n = len(dots), len(points)
    area = float(camera.width * camera.height)
    C = dots.covariance + model_error_px**2 * np.eye(2)
    radius = np.full(n, 3.0 * model_error_px + 1.0)
    poses = np.array([pose for _, pose in pool])
    cost = np.zeros(len(poses))
    matches: list[tuple[IntArray, IntArray]] = []
    for _ in range(3):
        predicted = project(camera, transform(poses[:, None], points))
        unique: dict[bytes, int] = {}
        matches = []
        for k, places in enumerate(predicted):
            targets, rows = match_dots(places, radius, dots.xy, unique=False)
            key = np.stack([targets, rows]).tobytes()
            enough = len(rows) >= 4 and spans_plane(points[targets])
            if enough and key not in unique:
                unique[key] = k
                matches.append((targets, rows))
        if not matches:
            return [], "no arrangement of the dots fits the body"
        which = np.repeat(np.arange(len(matches)), [len(r) for _, r in matches])
        targets = np.concatenate([t for t, _ in matches])
        rows = np.concatenate([r for _, r in matches])
        marks = TargetMarks(points[targets], dots.xy[rows], C[rows])
        fit = refine_poses(poses[list(unique.values())], which, marks, camera, iterations=10)
        poses, cost = fit.reference_T_body, fit.cost
    found: list[Found] = []
    why = "no arrangement of the dots fits the body"
    for k, (own, rows) in enumerate(matches):
        off = np.linalg.norm(project(camera, transform(poses[k], points[own])) - dots.xy[rows], axis=1)
        reach = max(1.5 * float(np.sqrt(np.mean(off**2))), 0.5)
        chance = min(1.0, m * np.pi * reach**2 / area)
        # three matches are spent on the pose; a triple has two solutions in the mean
        accidents = 2.0 * tried * float(stats.binom.sf(len(rows) - 4, n - 3, chance))
        if accidents < _CHANCE:
            found.append(Found(rows, own, poses[k], float(cost[k])))
        else:
            why = f"{len(rows)} of {n} targets fit, which {accidents:.2g} accidental arrangements would do as well"
    return found, why


def _unique(found: list[Found], m: int, area: float) -> list[Found]:
    """Numberings that the best one does not clearly beat: by matched targets first, then by fit."""
    if not found:
        return []
    merged: dict[bytes, Found] = {}
    for f in found:
        order = np.argsort(f.rows)
        key = np.stack([f.rows[order], f.targets[order]]).tobytes()
        if key not in merged or f.cost < merged[key].cost:
            merged[key] = f
    found = list(merged.values())
    best = max(found, key=lambda f: (len(f.rows), -f.cost))
    # a further matched dot is worth its odds against chance
    odds = -2.0 * np.log(min(0.5, m * np.pi * 9.0 / area))
    redundancy = max(1, 2 * len(best.rows) - 6)
    variance = max(best.cost / redundancy, 1e-4)
    score = {id(f): f.cost / variance - odds * len(f.rows) for f in found}
    best = min(found, key=lambda f: score[id(f)])
    out = [best]
    own = dict(zip(best.rows.tolist(), best.targets.tolist(), strict=True))
    for f in sorted(found, key=lambda f: score[id(f)]):
        differs = any(own.get(int(r)) not in (None, int(t)) for r, t in zip(f.rows, f.targets, strict=True))
        if f is not best and differs and score[id(f)] < score[id(best)] + _SAME:
            out.append(f)
    return out
