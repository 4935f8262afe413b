"""Rows of equally spaced dots: in the body, in the image, and the poses that lay one pair on the other.

Four dots in a line at equal spacing hardly ever happen by accident; a dozen never do. So a body that has rows (grids,
stepped plates) is found among a thousand false dots, where triples of dots would be hopeless. A pinhole maps a row to
a line with slowly changing spacing, which the chains follow by extrapolating their last two steps.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from itertools import combinations, pairwise

import numpy as np
from scipy.spatial import cKDTree

from robcal.photogrammetry.core.bodies import IntArray
from robcal.photogrammetry.core.camera import Camera, normalise, project
from robcal.photogrammetry.identify.dots import Dots
from robcal.photogrammetry.orientation.p3p import three_point_poses
from robcal.transforms import Array, transform

_MIN_ROW = 5
_MAX_ROWS, _MAX_CHAINS = 24, 24
_BATCH = 8000
_Overlap = tuple[IntArray, IntArray, int]
_LIKE = np.log([1.7, 2.5])
"""Ratios of size and of contrast up to which two neighbours are alike."""
_AROUND = 60.0
"""Radius (px) within which the density of like dots is counted."""


def body_rows(points: Array) -> list[IntArray]:
    """Rows (five or more, in order) of equally spaced points (n, 3) in a line, the longest first, each once."""
    tree = cKDTree(points)
    reach = 3.0 * float(np.median(np.asarray(tree.query(points, k=2)[0])[:, 1]))
    found: dict[tuple[int, ...], IntArray] = {}
    for a, b in tree.query_pairs(reach):
        v = points[b] - points[a]
        tolerance = 0.05 * float(np.linalg.norm(v))
        row = [a, b]
        for end, sign in ((-1, 1.0), (0, -1.0)):
            while True:
                distance, nxt = tree.query(points[row[end]] + sign * v)
                if distance > tolerance or nxt in row:
                    break
                row = [*row, int(nxt)] if sign > 0 else [int(nxt), *row]
        if len(row) >= _MIN_ROW:
            found.setdefault(tuple(sorted(row)), np.array(row, dtype=np.int64))
    rows = sorted(found.values(), key=lambda r: -len(r))
    kept: list[IntArray] = []
    for candidate in rows:  # every second dot of a row is no row of its own
        if not any(np.isin(candidate, other).all() for other in kept):
            kept.append(candidate)
    return kept[:_MAX_ROWS]


def image_rows(dots: Dots, longest_step: float) -> list[IntArray]:
    """Chains of dots of like size and brightness at steadily changing spacing; -1 stands for a gap (one at a time).

    Parameters
    ----------
    dots : of the image, m of them. longest_step : px between two neighbours at most.

    Returns
    -------
    Chains of five or more dots, the least accidental first (by the density of like dots around each), none largely a
    part of another.
    """
    xy, size = dots.xy, dots.size
    features = np.column_stack([np.log(size), np.log(np.maximum(np.abs(dots.contrast), 1e-9))])
    tree = cKDTree(xy)
    pairs = tree.query_pairs(longest_step, output_type="ndarray").reshape(-1, 2)
    step = np.linalg.norm(xy[pairs[:, 1]] - xy[pairs[:, 0]], axis=1)
    like = np.abs(features[pairs[:, 1]] - features[pairs[:, 0]])
    like_size = like[:, 0] < _LIKE[0]
    density = np.bincount(pairs[like_size & (step < _AROUND)].ravel(), minlength=len(xy)) / (np.pi * _AROUND**2)
    density = np.maximum(density, 1e-5)
    # the step must exceed the dots' own size clearly: crumbs of one blob make no row
    pairs = pairs[(like < _LIKE).all(axis=1) & (step > 3.0 * size[pairs].max(axis=1))]
    # a row shows in both directions from any of its pairs: five dots for all pairs at once, then follow the few
    alive = np.concatenate([pairs, pairs[:, ::-1]])
    for _ in range(3):
        v = xy[alive[:, -1]] - xy[alive[:, -2]]
        distance, nxt = (np.asarray(a) for a in tree.query(xy[alive[:, -1]] + v))
        ok = (distance < _gate(np.linalg.norm(v, axis=1))) & (nxt != alive[:, -1])
        ok &= (np.abs(features[nxt] - features[alive[:, -1]]) < 1.3 * _LIKE).all(axis=1)
        alive = np.column_stack([alive[ok], nxt[ok]])
    found: list[tuple[float, IntArray]] = []
    done: set[tuple[int, int]] = set()
    needed = np.log(1000.0 * max(len(pairs), 1))
    for start in alive:
        if (int(start[0]), int(start[1])) in done:
            continue
        chain = _follow(tree, xy, features, _follow(tree, xy, features, [int(i) for i in start])[::-1])
        done.update(pairwise(chain))
        done.update(pairwise(chain[::-1]))
        real = np.array([i for i in chain if i >= 0])
        pitch = float(np.linalg.norm(xy[real[-1]] - xy[real[0]])) / (len(chain) - 1)
        by_chance = np.minimum(density[real] * np.pi * _gate(pitch) ** 2, 0.9)
        # two dots make the pair; a gap is a second chance
        surprise = float(-np.sort(np.log(by_chance))[::-1][2:].sum()) - 0.7 * (len(chain) - len(real))
        if len(real) >= _MIN_ROW and surprise > needed:
            found.append((surprise, np.array(chain, dtype=np.int64)))
    found.sort(key=lambda item: -item[0])
    kept: list[IntArray] = []
    for _, candidate in found:
        if not any(np.isin(candidate, other).mean() > 0.5 for other in kept):
            kept.append(candidate)
    return kept[:_MAX_CHAINS]


def _gate(pitch: Array | float) -> Array:
    """Error (px) of the next dot extrapolated from the last ones: perspective and the dots' own noise."""
    return np.asarray(0.02 * pitch + 1.2)


@lru_cache(maxsize=4096)
def _extrapolation(k: tuple[int, ...], degree: int) -> Array:
    """Weights (n,) by which values at ``k`` give the least-squares polynomial's value at 0."""
    return np.asarray(np.linalg.pinv(np.vander(np.array(k, dtype=float), degree + 1))[-1])


def _follow(tree: cKDTree, xy: Array, features: Array, chain: list[int]) -> list[int]:
    """Extend a chain at its end while the next dot, or the one after a gap, is where it should be."""
    while True:
        known = [k for k in range(max(0, len(chain) - 7), len(chain)) if chain[k] >= 0]
        places = xy[[chain[k] for k in known]]
        typical = np.median(features[[chain[k] for k in known]], axis=0)
        degree = 2 if len(known) >= 6 else 1
        last = known if degree == 2 else known[-4:]
        pitch = float(np.linalg.norm(places[-1] - places[0])) / (known[-1] - known[0])
        for ahead in (1, 2):
            weights = _extrapolation(tuple(k - (len(chain) - 1 + ahead) for k in last), degree)
            target = weights @ places[-len(last) :]
            near = tree.query_ball_point(target, float(_gate(pitch)) * (1.0 if ahead == 1 else 1.4))
            near = [i for i in near if i not in chain and (np.abs(features[i] - typical) < 1.5 * _LIKE).all()]
            if near:
                best = min(near, key=lambda i: float(np.linalg.norm(xy[i] - target)))
                chain = [*chain, *([-1] * (ahead - 1)), int(best)]
                break
        else:
            return chain


def row_hypotheses(
    camera: Camera, xy: Array, points: Array, rows: list[IntArray], chains: list[IntArray], tolerance: float
) -> Iterator[tuple[Array, IntArray]]:
    """Poses camera_T_body (k, 4, 4) that lay two rows of the body on two chains, with the dots of both chains.

    The pairs of the least accidental chains come first. ``tolerance`` (px): RMS misfit along both chains above which a
    pose is dropped; the camera's start values need only be good to this along two rows.
    """
    ideal = normalise(camera, xy)
    pairings = [[_Pairing(chain, row, tuple(_overlaps(chain, row))) for row in rows] for chain in chains]
    order = sorted(combinations(range(len(chains)), 2), key=lambda pair: (pair[1], pair[0]))
    for one, two in order:
        laid = [
            _laid(xy, points, first, second)
            for i, first in enumerate(pairings[one])
            for j, second in enumerate(pairings[two])
            if i != j
        ]
        dots = np.concatenate([d for d, _ in laid])
        targets = np.concatenate([t for _, t in laid])
        poses = [np.empty((0, 4, 4))]
        for begin in range(0, len(dots), _BATCH):
            d, t = dots[begin : begin + _BATCH], targets[begin : begin + _BATCH]
            some = three_point_poses(ideal[d[:, [0, 1, 3]]], points[t[:, [0, 1, 3]]])
            seen = project(camera, transform(some[:, :, None], points[t][:, None]))
            with np.errstate(invalid="ignore"):
                residual = np.sqrt(np.mean(np.sum((seen - xy[d][:, None]) ** 2, axis=-1), axis=-1))
                poses.append(some[residual < tolerance])
        both = np.concatenate([chains[one], chains[two]])
        if sum(len(p) for p in poses):
            yield np.concatenate(poses), np.unique(both[both >= 0])


@dataclass(frozen=True)
class _Pairing:
    """A chain of dots, a row of targets, and all ways to lay one on the other."""

    chain: IntArray
    row: IntArray
    overlaps: tuple[_Overlap, ...]


def _laid(xy: Array, points: Array, one_on: _Pairing, two_on: _Pairing) -> tuple[IntArray, IntArray]:
    """Five dots (ends of the first chain; ends and middle of the second) and their targets (k, 5), for all offsets."""
    one, two, first, second = one_on.chain, two_on.chain, one_on.row, two_on.row
    u, v = points[first[-1]] - points[first[0]], points[second[-1]] - points[second[0]]
    p, q = xy[one[-1]] - xy[one[0]], xy[two[-1]] - xy[two[0]]
    cross = float(u @ v / (np.linalg.norm(u) * np.linalg.norm(v)))
    turned = float(p @ q / max(float(np.linalg.norm(p) * np.linalg.norm(q)), 1e-300))
    dots: list[list[int]] = []
    targets: list[list[int]] = []
    if abs(cross) > 0.99:  # parallel rows are nearly parallel in the image, and their steps are alike
        image = np.linalg.norm(p) / (len(one) - 1) / (np.linalg.norm(q) / (len(two) - 1))
        body = np.linalg.norm(u) / (len(first) - 1) / (np.linalg.norm(v) / (len(second) - 1))
        if abs(turned) < 0.8 or not 0.6 < image / body < 1.7:
            return np.empty((0, 5), dtype=np.int64), np.empty((0, 5), dtype=np.int64)
    for at_one, named_one, sign_one in one_on.overlaps:
        for at_two, named_two, sign_two in two_on.overlaps:
            # parallel rows point the same way in the image, too
            if abs(cross) > 0.99 and turned * sign_one * sign_two * cross < 0:
                continue
            middle = len(at_two) // 2
            some = [one[at_one[0]], one[at_one[-1]], two[at_two[0]], two[at_two[-1]], two[at_two[middle]]]
            named = [named_one[0], named_one[-1], named_two[0], named_two[-1], named_two[middle]]
            if len(set(named)) == 5 and len(set(some)) == 5:
                dots.append(some)
                targets.append(named)
    return np.array(dots, dtype=np.int64).reshape(-1, 5), np.array(targets, dtype=np.int64).reshape(-1, 5)


def _overlaps(chain: IntArray, row: IntArray) -> list[_Overlap]:
    """Positions in the chain and the targets on them, for every offset and both directions that use most of both."""
    out: list[_Overlap] = []
    real = np.flatnonzero(chain >= 0)
    if len(chain) > len(row) + 3:  # a row may have one or two false dots beyond its ends, not more
        return out
    for sign in (1, -1):
        ordered = row[::sign]
        for offset in range(-len(chain) + 1, len(row)):
            at = real[(real + offset >= 0) & (real + offset < len(row))]
            if len(at) >= max(_MIN_ROW, 0.8 * min(len(real), len(row))):
                out.append((at, ordered[at + offset], sign))
    return out
