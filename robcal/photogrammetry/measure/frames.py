"""From points to frames: the distance criterion, then the body fitted onto its targets with full covariance."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from robcal.errors import DegenerateGeometry, InvalidInput
from robcal.photogrammetry.core.bodies import Body, IntArray, line_ratio
from robcal.photogrammetry.measure.distance_criterion import (
    PairTable,
    body_pair_variance,
    culprits,
    make_pairs,
    robust_scale,
)
from robcal.photogrammetry.measure.frame_fit import FrameFit, fit_frames
from robcal.photogrammetry.measure.measured_points import MeasuredPoints, RejectedPoint
from robcal.photogrammetry.measure.recurring import Recurring, find_recurring
from robcal.photogrammetry.measure.unknown_body import body_from_points
from robcal.transforms import Array

_SPREAD = 0.02
_MISFIT = "lengths agree but the body does not fit"
_TOO_MANY = 0.3
"""Where more than this share of the poses violate a fixed tolerance, the violations are evidence, not blunders."""


@dataclass(frozen=True)
class RejectedPose:
    """A pose without a frame, and why."""

    pose: int
    reason: str


@dataclass(frozen=True)
class PairDeviations:
    """Every pair judged: ``pose`` (k,), ``first``, ``second`` ids, ``measured``, ``expected`` (m), ``sigma`` (m),
    ``tolerance`` (m), ``accepted`` (k,) bool. ``expected`` is the body's length (with recurring deviations, see
    :class:`Recurring`, taken over from the mean of the poses for the judgement only)."""

    pose: IntArray
    first: IntArray
    second: IntArray
    measured: Array
    body: Array
    expected: Array
    sigma: Array
    tolerance: Array
    accepted: NDArray[np.bool_]

    @property
    def deviation(self) -> Array:
        """Measured minus the body's own length, m."""
        return self.measured - self.body


@dataclass(frozen=True)
class MeasuredFrames:
    """Frames of the body in the world.

    Attributes
    ----------
    pose : (n,) pose numbers; world_T_body : (n, 4, 4).
    covariance : (n, 6, 6) the part that is independent from pose to pose (right perturbation, translation first).
    common_covariance : (n, 6, 6) what station and body coordinates add, common to all poses; zero where not known.
    method : (n,) 'points', 'resection' (one camera: anisotropic) or 'gram_schmidt' (body without coordinates).
    targets : ids used per pose; chi2, redundancy (n,) of each fit.
    rejected_poses, rejected_points : with reason. pairs : all length deviations, for the report.
    recurring : evidence over all poses; left_out : ids not used in any fit because of it.
    noise_factor : robust estimate of the scatter of lengths by what the covariance says.
    body : the body used (estimated from the points where it had no coordinates).
    sigma : isotropic standard deviation (m) of a coordinate where no covariance was given, else None.
    """

    pose: IntArray
    world_T_body: Array
    covariance: Array
    common_covariance: Array
    method: tuple[str, ...]
    targets: tuple[tuple[int, ...], ...]
    chi2: Array
    redundancy: IntArray
    rejected_poses: tuple[RejectedPose, ...]
    rejected_points: tuple[RejectedPoint, ...]
    pairs: PairDeviations
    recurring: Recurring
    left_out: tuple[int, ...]
    noise_factor: float
    body: Body
    sigma: float | None
    notes: tuple[str, ...] = field(default=())


def measure_frames(
    points: MeasuredPoints, body: Body | None = None, *, tolerance: float | None = None, sigma_factor: float = 4.0
) -> MeasuredFrames:
    """Frames of a body from its measured targets.

    Parameters
    ----------
    points : from :func:`measure_points` or any other system (without covariance the noise is estimated from lengths).
    body : the body; None or without three known coordinates: the method with unknown targets.
    tolerance : m, fixed limit of a length deviation; default ``sigma_factor`` standard deviations of the pair.

    Raises
    ------
    DegenerateGeometry : the body has fewer than three targets or all in one line, or no pose carries a frame.
    InvalidInput : a tolerance that is not positive.
    """
    if tolerance is not None and not tolerance > 0:
        raise InvalidInput(f"the distance tolerance must be above zero, got {tolerance}")
    method = "points"
    own = points.n_cameras != 1 if points.resected is not None else np.ones(len(points.pose), dtype=bool)
    notes: list[str] = []
    if body is None or body.known.sum() < 3:
        body = body_from_points(points, own, None if body is None else body.ids)
        method = "gram_schmidt"
        notes.append("the body has no coordinates: frames by Gram-Schmidt from its targets (first to second is x)")
    elif line_ratio(body.points[body.known]) < _SPREAD:
        raise DegenerateGeometry(
            f"all targets of body {body.name} lie in one line: they carry no frame; put a target beside the line"
        )
    row = body.index(points.target)
    known = np.zeros(len(row), dtype=bool)
    known[row >= 0] = body.known[row[row >= 0]]
    use = own & known
    rejected = list(points.rejected)
    rejected += [
        RejectedPoint(int(points.pose[i]), int(points.target[i]), f"not a target of body {body.name} with coordinates")
        for i in np.flatnonzero(own & ~known)
    ]
    at = np.flatnonzero(use)
    pose, row, p = points.pose[at], row[at], points.p_world[at]
    sigma = None
    if points.covariance is None:
        sigma = _noise_from_lengths(body, pose, row, p)
        C = np.broadcast_to(sigma**2 * np.eye(3), (len(at), 3, 3)).copy()
    else:
        C = points.covariance[at]
    table = make_pairs(pose, row, p, C)
    shared = _shared_variance(points, at, table)
    recurring = find_recurring(body, table, pose, row, p, shared)
    judged, factor, note = _judge(body, table, recurring, shared, tolerance, sigma_factor)
    if note:
        notes.append(note)
    left_out = _leave_out(body, recurring, notes)
    keep, rejected_poses, dropped = _eliminate(body, pose, row, table, judged, left_out)
    rejected += dropped
    station = _station(points, at[keep])
    fit = fit_frames(pose[keep], row[keep], p[keep], C[keep], body, station, points.station_covariance)
    if sigma is not None and fit.redundancy.sum() >= 30:
        # lengths gave a robust first value; the accepted fits give the efficient one
        scale = float(np.sqrt(fit.chi2.sum() / fit.redundancy.sum()))
        sigma *= scale
        fit = replace(fit, covariance=fit.covariance * scale**2, chi2=fit.chi2 / scale**2)
    reasons = [_bad_fit(fit.chi2[i], int(fit.redundancy[i]), fit.covariance[i], factor) for i in range(len(fit.pose))]
    misfits = [r is not None and r.startswith(_MISFIT) for r in reasons]
    if sum(misfits) > _TOO_MANY * len(reasons):
        notes.append(f"in {sum(misfits)} of {len(reasons)} poses the body does not fit: evidence, not rejected")
        reasons = [None if bad else r for r, bad in zip(reasons, misfits, strict=True)]
    good = np.array([r is None for r in reasons], dtype=bool)
    rejected_poses += [RejectedPose(int(q), r) for q, r in zip(fit.pose, reasons, strict=True) if r is not None]
    out = _assemble(points, fit, good, method)
    with_frame = set(out["pose"].tolist())
    rejected_poses = [r for r in rejected_poses if r.pose not in with_frame]
    named = {r.pose for r in rejected_poses} | with_frame
    for q in np.unique(np.concatenate([points.pose, np.array([r.pose for r in points.rejected], dtype=np.int64)])):
        if int(q) not in named:
            reasons = [r.reason for r in points.rejected if r.pose == q]
            rejected_poses.append(
                RejectedPose(int(q), "fewer than three targets measured" + (f" ({reasons[0]})" if reasons else ""))
            )
    if len(out["pose"]) == 0:
        reason = rejected_poses[0].reason if rejected_poses else "no points of the body"
        raise DegenerateGeometry(f"no pose carries a frame of body {body.name}: {reason}")
    return MeasuredFrames(
        **out,
        rejected_poses=tuple(rejected_poses),
        rejected_points=tuple(rejected),
        pairs=judged,
        recurring=recurring,
        left_out=left_out,
        noise_factor=factor,
        body=body,
        sigma=sigma,
        notes=tuple(notes),
    )


def _station(points: MeasuredPoints, at: IntArray) -> Array | None:
    return None if points.station_jacobian is None else points.station_jacobian[at]


def _shared_variance(points: MeasuredPoints, at: IntArray, table: PairTable) -> Array:
    """(k,) variance of each pair's distance from the station's uncertainty."""
    if points.station_jacobian is None or points.station_covariance is None or len(table) == 0:
        return np.zeros(len(table))
    J = points.station_jacobian[at[table.second]] - points.station_jacobian[at[table.first]]
    along = np.einsum("ki,kij->kj", table.direction, J)
    return np.maximum(np.einsum("ki,ij,kj->k", along, points.station_covariance, along), 0.0)


def _noise_from_lengths(body: Body, pose: IntArray, row: IntArray, p: Array) -> float:
    """Isotropic standard deviation of a coordinate from the scatter of lengths about their medians over the poses.

    With fewer than five poses from the deviations from the body itself. A length's variance is twice a coordinate's.
    """
    table = make_pairs(pose, row, p, np.zeros((len(pose), 3, 3)))
    if len(table) == 0:
        raise DegenerateGeometry("no pose has two targets of the body: lengths cannot be compared")
    key = table.a * len(body) + table.b
    unique, inverse, count = np.unique(key, return_inverse=True, return_counts=True)
    expected = np.linalg.norm(body.points[table.b] - body.points[table.a], axis=1)
    deviation = table.distance - expected
    centred = np.full(len(table), np.nan)
    for k in range(len(unique)):
        if count[k] >= 5:
            rows = inverse == k
            centred[rows] = (deviation[rows] - np.median(deviation[rows])) * np.sqrt(count[k] / (count[k] - 1))
    values = centred[np.isfinite(centred)]
    if len(values) < 5:
        values = deviation
    return max(robust_scale(values) / np.sqrt(2.0), 1e-7)


def _judge(
    body: Body, table: PairTable, recurring: Recurring, shared: Array, tolerance: float | None, sigma_factor: float
) -> tuple[PairDeviations, float, str | None]:
    """Deviation, standard deviation and tolerance of every pair; the noise factor; what a fixed tolerance would do."""
    a, b = table.a, table.b
    file = np.linalg.norm(body.points[b] - body.points[a], axis=1)
    expected = file * (1.0 + 1e-6 * (recurring.scale_ppm or 0.0))
    marked = {(r.first, r.second) for r in recurring.pairs}
    if marked:
        measured = np.linalg.norm(recurring.mean_points[b] - recurring.mean_points[a], axis=1)
        ids = np.column_stack([body.ids[a], body.ids[b]])
        recurs = np.array([(int(i), int(j)) in marked or (int(j), int(i)) in marked for i, j in ids])
        expected = np.where(recurs & np.isfinite(measured), measured, expected)
    variance = table.variance + shared + body_pair_variance(body.points, body.covariance, a, b)
    sigma = np.sqrt(np.maximum(variance, 1e-18))
    off = table.distance - expected
    factor = robust_scale(off / sigma) if len(table) >= 30 else 1.0
    factor = float(np.clip(factor, 0.2, 1e6))
    limit = np.full(len(table), tolerance) if tolerance is not None else sigma_factor * max(factor, 0.5) * sigma
    poses = np.unique(table.pose)
    violating = np.unique(table.pose[np.abs(off) > limit])
    note = None
    if len(poses) >= 5 and len(violating) > _TOO_MANY * len(poses):
        text = f"{1e3 * tolerance:.3g} mm" if tolerance is not None else f"{sigma_factor:g} sigma"
        note = f"{len(violating)} of {len(poses)} poses violate the tolerance of {text}: evidence, not rejected"
        limit = np.maximum(limit, 2 * sigma_factor * max(factor, 1.0) * sigma)
    pairs = PairDeviations(
        table.pose, body.ids[a], body.ids[b], table.distance, file, expected, sigma, limit, np.abs(off) <= limit
    )
    return pairs, factor, note


def _leave_out(body: Body, recurring: Recurring, notes: list[str]) -> tuple[int, ...]:
    """Shifted targets are not used for frames as long as three others remain that span a plane."""
    ids = recurring.shifted_ids
    stay = body.known & ~np.isin(body.ids, ids)
    if not ids:
        return ()
    if stay.sum() >= 3 and line_ratio(body.points[stay]) > _SPREAD:
        notes.append(f"left out of all frames: target {', '.join(map(str, ids))} ({recurring.statement})")
        return ids
    return ()


def _eliminate(
    body: Body, pose: IntArray, row: IntArray, table: PairTable, judged: PairDeviations, left_out: tuple[int, ...]
) -> tuple[NDArray[np.bool_], list[RejectedPose], list[RejectedPoint]]:
    """Points that stay, poses rejected, points rejected."""
    keep = ~np.isin(body.ids[row], left_out)
    poses: list[RejectedPose] = []
    points: list[RejectedPoint] = []
    violated: dict[int, list[int]] = {}
    for k in np.flatnonzero(~judged.accepted):
        violated.setdefault(int(table.pose[k]), []).append(int(k))
    order = np.argsort(table.pose, kind="stable")
    bounds: Mapping[int, IntArray] = _groups(table.pose, order)
    by_pose = _groups(pose, np.argsort(pose, kind="stable"))
    for q, rows in by_pose.items():
        rows = rows[keep[rows]]
        if q in violated:
            local = {int(r): i for i, r in enumerate(rows)}
            badness = np.zeros((len(rows), len(rows)))
            for k in bounds[q]:
                i, j = local.get(int(table.first[k])), local.get(int(table.second[k]))
                if i is not None and j is not None:
                    size = (judged.measured[k] - judged.expected[k]) / judged.sigma[k]
                    badness[i, j] = badness[j, i] = size**2
            bad = [
                (local[int(table.first[k])], local[int(table.second[k])])
                for k in violated[q]
                if int(table.first[k]) in local and int(table.second[k]) in local
            ]
            gone = culprits(len(rows), bad, badness)
            if gone is None:
                keep[rows] = False
                worst = max(violated[q], key=lambda k: abs(judged.measured[k] - judged.expected[k]) / judged.sigma[k])
                off = 1e3 * (judged.measured[worst] - judged.expected[worst])
                poses.append(
                    RejectedPose(
                        q,
                        f"lengths contradict the body and fewer than three targets would remain "
                        f"(targets {judged.first[worst]} and {judged.second[worst]}: {off:+.3f} mm)",
                    )
                )
                continue
            for i in gone:
                keep[rows[i]] = False
                points.append(RejectedPoint(q, int(body.ids[row[rows[i]]]), "its distances to other targets are off"))
            rows = rows[keep[rows]]
        if len(rows) < 3 or line_ratio(body.points[row[rows]]) < _SPREAD:
            keep[rows] = False
            text = "fewer than three targets measured" if len(rows) < 3 else "the targets measured lie in one line"
            poses.append(RejectedPose(q, text))
    return keep, poses, points


def _groups(keys: IntArray, order: IntArray) -> dict[int, IntArray]:
    if len(keys) == 0:
        return {}
    cuts = np.flatnonzero(np.diff(keys[order])) + 1
    return {int(keys[g[0]]): g for g in np.split(order, cuts)}


def _bad_fit(chi2: float, redundancy: int, covariance: Array, factor: float) -> str | None:
    """Why a fit is not to be trusted although its lengths are (a mirrored or wrongly numbered body)."""
    if not np.isfinite(covariance).all() or np.sqrt(np.trace(covariance[3:, 3:])) > 0.2:
        return "the targets measured do not determine the orientation of the body (or their sigmas are too large)"
    if redundancy > 0 and stats.chi2.sf(chi2 / max(factor, 1.0) ** 2, redundancy) < 1e-12:
        return f"{_MISFIT} (chi-square {chi2:.0f} with {redundancy}): mirrored or misnumbered targets"
    return None


def _assemble(points: MeasuredPoints, fit: FrameFit, good: NDArray[np.bool_], method: str) -> dict[str, Any]:
    """Frames from points and frames by resection, in the order of the poses."""
    pose, T, C, common = fit.pose[good], fit.world_T_body[good], fit.covariance[good], fit.common_covariance[good]
    methods = [method] * int(good.sum())
    targets = [t for t, g in zip(fit.targets, good, strict=True) if g]
    chi2, redundancy = fit.chi2[good], fit.redundancy[good]
    r = points.resected
    if r is not None:
        new = ~np.isin(r.pose, pose)
        pose = np.concatenate([pose, r.pose[new]])
        T = np.concatenate([T, r.world_T_body[new]])
        C, common = np.concatenate([C, r.covariance[new]]), np.concatenate([common, r.common_covariance[new]])
        methods += ["resection"] * int(new.sum())
        targets += [t for t, n in zip(r.targets, new, strict=True) if n]
        chi2 = np.concatenate([chi2, np.full(new.sum(), np.nan)])
        redundancy = np.concatenate([redundancy, np.zeros(new.sum(), dtype=np.int64)])
    order = np.argsort(pose, kind="stable")
    return {
        "pose": pose[order],
        "world_T_body": T[order],
        "covariance": C[order],
        "common_covariance": common[order],
        "method": tuple(methods[i] for i in order),
        "targets": tuple(targets[i] for i in order),
        "chi2": chi2[order],
        "redundancy": redundancy[order],
    }
