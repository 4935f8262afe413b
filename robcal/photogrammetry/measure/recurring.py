"""What recurs in the lengths of a body over many poses: a target that is off its place in the file, a wrong scale.

Evidence for the diagnosis, and the reference against which isolated errors are judged.
"""

from dataclasses import dataclass, replace

import numpy as np

from robcal.photogrammetry.core.bodies import Body, IntArray, spans_plane
from robcal.photogrammetry.measure.distance_criterion import PairTable, body_pair_variance, culprits
from robcal.transforms import Array, fit_frame, invert, transform

_SIGNIFICANT = 5.0
_MIN_POSES = 5


@dataclass(frozen=True)
class TargetShift:
    """A target that is off its place in the file: id, shift (3,) m in body coordinates (true minus file), its
    covariance, the chi-square of the shift and, where two targets stand in each other's place, the other id."""

    target: int
    shift: Array
    covariance: Array
    statistic: float
    swapped_with: int | None


@dataclass(frozen=True)
class RecurringPair:
    """A pair whose distance deviates in the mean over all poses: ids, mean deviation and its sigma (m), poses."""

    first: int
    second: int
    deviation: float
    sigma: float
    poses: int


@dataclass(frozen=True)
class Recurring:
    """Recurring deviations of lengths.

    ``pairs`` the significant ones, ``targets`` shifts that explain them, ``scale_ppm`` (``scale_sigma_ppm``) a common
    scale of all measured lengths (measured = true * (1 + ppm); None when not significant), ``unexplained`` significant
    pairs that neither explains, ``mean_points`` (t, 3) body coordinates as measured (NaN where too few poses).
    """

    pairs: tuple[RecurringPair, ...]
    targets: tuple[TargetShift, ...]
    scale_ppm: float | None
    scale_sigma_ppm: float | None
    unexplained: tuple[RecurringPair, ...]
    mean_points: Array
    statement: str

    @property
    def shifted_ids(self) -> tuple[int, ...]:
        """Ids of shifted targets."""
        return tuple(t.target for t in self.targets)


def mean_shape(
    pose: IntArray, row: IntArray, p_world: Array, points: Array, rounds: int = 3
) -> tuple[Array, Array, IntArray]:
    """Body coordinates as the poses show them in the mean: each pose fitted onto the shape, medians, repeated.

    Returns coordinates (t, 3) in the frame of ``points``, their standard deviation of the mean per axis (t, 3), and the
    number of poses of each target; NaN where a target was measured in no usable pose.
    """
    reference = points.copy()
    t = len(points)
    order = np.argsort(pose, kind="stable")
    groups = [g for g in np.split(order, np.flatnonzero(np.diff(pose[order])) + 1) if len(g)]
    usable = [g for g in groups if spans_plane(points[row[g]])]
    mean, sigma, count = np.full((t, 3), np.nan), np.full((t, 3), np.nan), np.zeros(t, dtype=np.int64)
    if not usable:
        return mean, sigma, count
    rows = np.concatenate(usable)
    for _ in range(rounds):
        back = [transform(invert(fit_frame(p_world[g], reference[row[g]])), p_world[g]) for g in usable]
        local = np.concatenate(back)
        for i in range(t):
            mine = local[row[rows] == i]
            count[i] = len(mine)
            if len(mine) == 0:
                continue
            centre = np.median(mine, axis=0)
            spread = 1.4826 * np.median(np.abs(mine - centre), axis=0)
            good = (np.abs(mine - centre) <= 4 * spread + 1e-15).all(axis=1)
            mean[i] = mine[good].mean(axis=0)
            sigma[i] = np.maximum(spread, 1e-12) / np.sqrt(max(1, good.sum()))
        fixed = np.isfinite(mean).all(axis=1)
        reference = np.where(fixed[:, None], mean, points)
    return mean, sigma, count


def find_recurring(
    body: Body, table: PairTable, pose: IntArray, row: IntArray, p_world: Array, common_variance: Array
) -> Recurring:
    """Recurring deviations of a body's lengths.

    Parameters
    ----------
    table : pairs of all poses; pose, row, p_world the points they come from.
    common_variance : (k,) variance of each pair's distance that all poses share (station), m^2.
    """
    mean, sigma, count = mean_shape(pose, row, p_world, body.points)
    pairs = _mean_pairs(body, table, mean, sigma, count, common_variance)
    if len(pairs.first) == 0:
        return Recurring((), (), None, None, (), mean, "no recurring deviation of lengths")
    scale, scale_sigma, left, s = _scale_and_rest(pairs)
    ids = body.ids
    found = tuple(
        RecurringPair(int(ids[i]), int(ids[j]), float(x), float(y), int(k))
        for i, j, x, y, k in zip(pairs.first, pairs.second, pairs.deviation, s, pairs.poses, strict=True)
        if abs(x) > _SIGNIFICANT * y
    )
    seen, ends = np.unique(np.stack([pairs.first, pairs.second]), return_inverse=True)
    i, j = ends.reshape(2, -1)
    badness = np.zeros((len(seen), len(seen)))
    badness[i, j] = badness[j, i] = (left / s) ** 2
    bad = np.abs(left) > _SIGNIFICANT * s
    removed = culprits(len(seen), [(int(k), int(m)) for k, m in zip(i[bad], j[bad], strict=True)], badness)
    violated = {(int(ids[seen[k]]), int(ids[seen[m]])) for k, m in zip(i[bad], j[bad], strict=True)}
    unexplained = tuple(f for f in found if removed is None and (f.first, f.second) in violated)
    stay = np.delete(seen, sorted(removed or ()))
    stay = _off_the_plane(body, mean, sigma, stay, 1.0 + scale, float(np.median(pairs.shared)))
    gone = np.setdiff1d(seen, stay).tolist()
    targets = _shifts(body, mean, sigma, stay, gone, 1.0 + scale) if gone and removed is not None else ()
    return Recurring(
        found,
        targets,
        1e6 * scale if scale else None,
        1e6 * scale_sigma if scale else None,
        unexplained,
        mean,
        _statement(body, targets, scale, unexplained),
    )


@dataclass(frozen=True)
class _MeanPairs:
    """Pairs (q,) measured in enough poses: body rows, number of poses, length in the file, deviation of the mean
    length from it, its standard deviation, and the variance that all poses share."""

    first: IntArray
    second: IntArray
    poses: IntArray
    length: Array
    deviation: Array
    sigma: Array
    shared: Array


def _mean_pairs(
    body: Body, table: PairTable, mean: Array, sigma: Array, count: IntArray, common_variance: Array
) -> _MeanPairs:
    t = len(body)
    unique, inverse = np.unique(table.a * t + table.b, return_inverse=True)
    n = np.bincount(inverse)
    shared = np.bincount(inverse, weights=common_variance) / n
    a, b = unique // t, unique % t
    good = (count[a] >= _MIN_POSES) & (count[b] >= _MIN_POSES) & (n >= _MIN_POSES)
    a, b, n, shared = a[good], b[good], n[good], shared[good]
    length = np.linalg.norm(body.points[b] - body.points[a], axis=1)
    deviation = np.linalg.norm(mean[b] - mean[a], axis=1) - length
    noise = np.sum(sigma[a] ** 2 + sigma[b] ** 2, axis=1) / 3
    s = np.sqrt(noise + shared + body_pair_variance(body.points, body.covariance, a, b))
    return _MeanPairs(a, b, n, length, deviation, s, shared)


def _scale_and_rest(pairs: _MeanPairs) -> tuple[float, float, Array, Array]:
    """Common scale (0 where not significant) and its sigma, deviations (q,) without it, inflated sigmas (q,)."""
    scale, scale_sigma = _common_scale(pairs.deviation, pairs.length, pairs.sigma)
    left = pairs.deviation - scale * pairs.length
    inflation = _inflation(left / pairs.sigma)
    scale_sigma, s = scale_sigma * inflation, pairs.sigma * inflation
    significant = abs(scale) > _SIGNIFICANT * scale_sigma
    before, after = (int(np.sum(np.abs(d) > _SIGNIFICANT * s)) for d in (pairs.deviation, left))
    if not (significant and after < 0.5 * before):
        return 0.0, scale_sigma, pairs.deviation, s
    # the single poses' noise averages out of the scale, the station's and the body's part do not
    scale_sigma = float(np.hypot(scale_sigma, np.median(np.sqrt(pairs.shared) / pairs.length)))
    return scale, scale_sigma, left, s


def _inflation(z: Array) -> float:
    """By how much the better fifth of normalised deviations is larger than it should be, at least 1.

    A body of modest accuracy, or a lens not fully modelled, moves all lengths a little in every pose; a wrong target
    must stand out from that. The lowest fifth is free of two wrong targets among five.
    """
    return max(1.0, float(np.quantile(np.abs(z), 0.2)) / 0.2533) if len(z) >= 5 else 1.0


def _off_the_plane(body: Body, mean: Array, sigma: Array, stay: IntArray, scale: float, shared: float) -> IntArray:
    """Targets that stay after those are taken away whose place in space is off although their distances are not.

    A shift across a plane changes distances only to second order. Each target is compared with the others' fit.
    """
    stay = stay.copy()
    while len(stay) >= 5:
        sizes, worst, which = [], 0.0, -1
        for i in stay:
            others = stay[stay != i]
            if not spans_plane(body.points[others]):
                continue
            moved = transform(fit_frame(body.points[others], mean[others] / scale), mean[i] / scale)
            C = np.diag(sigma[i] ** 2 + np.mean(sigma[others] ** 2, axis=0)) + 2 * body.marginal(i) + shared * np.eye(3)
            size = float((moved - body.points[i]) @ np.linalg.solve(C, moved - body.points[i]))
            sizes.append(size)
            if size > worst:
                worst, which = size, int(i)
        typical = max(1.0, float(np.median(sizes)) / 2.37) if sizes else 1.0
        if worst < (_SIGNIFICANT**2 + 3 * len(stay)) * typical:
            break
        stay = stay[stay != which]
    return stay


def _common_scale(deviation: Array, length: Array, sigma: Array) -> tuple[float, float]:
    """Weighted median of the relative deviations, then least squares on those that agree."""
    ratio, weight = deviation / length, (length / sigma) ** 2
    order = np.argsort(ratio)
    half = np.searchsorted(np.cumsum(weight[order]), 0.5 * weight.sum())
    centre = ratio[order[min(half, len(ratio) - 1)]]
    near = np.abs(deviation - centre * length) < 4 * sigma
    if not near.any():
        return float(centre), np.inf
    total = weight[near].sum()
    return float((weight[near] * ratio[near]).sum() / total), float(1.0 / np.sqrt(total))


def _shifts(
    body: Body, mean: Array, sigma: Array, stay: IntArray, removed: list[int], scale: float
) -> tuple[TargetShift, ...]:
    if not spans_plane(body.points[stay]):
        return ()
    body_T_mean = fit_frame(body.points[stay], mean[stay] / scale)
    moved = transform(body_T_mean, mean / scale)
    out = []
    for i in removed:
        shift = moved[i] - body.points[i]
        base = np.mean(sigma[stay] ** 2)
        covariance = np.diag(sigma[i] ** 2 + base) + body.marginal(i)
        statistic = float(shift @ np.linalg.solve(covariance, shift))
        reach = 0.1 * np.linalg.norm(shift)
        near = [k for k in removed if k != i and np.linalg.norm(moved[i] - body.points[k]) < reach]
        other = int(body.ids[near[0]]) if near else None
        out.append(TargetShift(int(body.ids[i]), shift, covariance, statistic, other))
    ids = {t.target: t for t in out}
    # a swap is mutual
    return tuple(
        t if t.swapped_with is None or ids[t.swapped_with].swapped_with == t.target else replace(t, swapped_with=None)
        for t in out
    )


def _statement(
    body: Body, targets: tuple[TargetShift, ...], scale: float, unexplained: tuple[RecurringPair, ...]
) -> str:
    parts = []
    for t in targets:
        if t.swapped_with is not None and t.target < t.swapped_with:
            parts.append(f"targets {t.target} and {t.swapped_with} of body {body.name} are swapped")
        elif t.swapped_with is None:
            size = 1e3 * np.linalg.norm(t.shift)
            parts.append(f"target {t.target} of body {body.name} is {size:.3g} mm off its file")
    if scale:
        parts.append(f"all lengths are measured {1e6 * scale:+.0f} ppm off those of body {body.name}")
    if unexplained:
        parts.append(f"{len(unexplained)} lengths of body {body.name} deviate in every pose, without a single culprit")
    return "; ".join(parts) if parts else "no recurring deviation of lengths"
