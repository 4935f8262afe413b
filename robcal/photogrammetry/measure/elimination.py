"""Points and poses left out because distances contradict the body, and poses that carry no frame.

Distances between the targets of a body judged pair by pair: expected length, standard deviation, tolerance.
"""

from dataclasses import dataclass
from enum import Enum

import numpy as np
from numpy.typing import NDArray

from robcal.errors import DegenerateGeometry
from robcal.photogrammetry.core.bodies import Body, IntArray, spans_plane
from robcal.photogrammetry.measure.distance_criterion import (
    PairTable,
    body_pair_variance,
    culprits,
    make_pairs,
    robust_scale,
)
from robcal.photogrammetry.measure.measured_points import MeasuredPoints, RejectedPoint
from robcal.photogrammetry.measure.recurring import Recurring
from robcal.transforms import Array

TOO_MANY = 0.3
"""Where more than this share of the poses violate a fixed tolerance, the violations are evidence, not blunders."""


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


def shared_variance(points: MeasuredPoints, at: IntArray, table: PairTable) -> Array:
    """(k,) variance of each pair's distance from the station's uncertainty."""
    if points.station_jacobian is None or points.station_covariance is None or len(table) == 0:
        return np.zeros(len(table))
    J = points.station_jacobian[at[table.second]] - points.station_jacobian[at[table.first]]
    along = np.einsum("ki,kij->kj", table.direction, J)
    return np.maximum(np.einsum("ki,ij,kj->k", along, points.station_covariance, along), 0.0)


def noise_from_lengths(body: Body, pose: IntArray, row: IntArray, p: Array) -> float:
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


def judge_pairs(
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
    if len(poses) >= 5 and len(violating) > TOO_MANY * len(poses):
        text = f"{1e3 * tolerance:.3g} mm" if tolerance is not None else f"{sigma_factor:g} sigma"
        note = f"{len(violating)} of {len(poses)} poses violate the tolerance of {text}: evidence, not rejected"
        limit = np.maximum(limit, 2 * sigma_factor * max(factor, 1.0) * sigma)
    pairs = PairDeviations(
        table.pose, body.ids[a], body.ids[b], table.distance, file, expected, sigma, limit, np.abs(off) <= limit
    )
    return pairs, factor, note


class PoseFault(Enum):
    """Why a pose has no frame."""

    FEW_TARGETS = "few_targets"
    IN_LINE = "in_line"
    LENGTHS = "lengths"
    UNDETERMINED = "undetermined"
    MISFIT = "misfit"


@dataclass(frozen=True)
class RejectedPose:
    """A pose without a frame: the kind of fault, and a sentence for the report."""

    pose: int
    fault: PoseFault
    reason: str


@dataclass(frozen=True)
class Elimination:
    """Points (m,) that stay, and what was left out."""

    keep: NDArray[np.bool_]
    poses: tuple[RejectedPose, ...]
    points: tuple[RejectedPoint, ...]


def eliminate(
    body: Body, pose: IntArray, row: IntArray, table: PairTable, judged: PairDeviations, left_out: tuple[int, ...]
) -> Elimination:
    """Leave out the fewest points that explain all violated distances, pose by pose.

    Parameters
    ----------
    pose, row : (m,) pose number and row of the body of each point. table, judged : all their pairs.
    left_out : ids of targets not to be used at all.
    """
    keep = ~np.isin(body.ids[row], left_out)
    poses: list[RejectedPose] = []
    points: list[RejectedPoint] = []
    pairs = _groups(table.pose)
    violated = _groups(np.where(judged.accepted, -1, table.pose))
    for q, rows in _groups(pose).items():
        rows = rows[keep[rows]]
        if q in violated:
            gone = _culprits(rows, table, judged, pairs[q], violated[q])
            if gone is None:
                keep[rows] = False
                poses.append(_contradiction(q, judged, violated[q]))
                continue
            keep[gone] = False
            points += [RejectedPoint(q, int(body.ids[row[i]]), "its distances to other targets are off") for i in gone]
            rows = rows[keep[rows]]
        if len(rows) < 3:
            poses.append(RejectedPose(q, PoseFault.FEW_TARGETS, "fewer than three targets measured"))
        elif not spans_plane(body.points[row[rows]]):
            poses.append(RejectedPose(q, PoseFault.IN_LINE, "the targets measured lie in one line"))
        else:
            continue
        keep[rows] = False
    return Elimination(keep, tuple(poses), tuple(points))


def _culprits(
    rows: IntArray, table: PairTable, judged: PairDeviations, pairs: IntArray, violated: IntArray
) -> IntArray | None:
    """Points to leave out among ``rows`` of one pose; None where too few would remain."""
    local = {int(r): i for i, r in enumerate(rows)}
    badness = np.zeros((len(rows), len(rows)))

    def ends(k: int) -> tuple[int, int] | None:
        first, second = int(table.first[k]), int(table.second[k])
        return (local[first], local[second]) if first in local and second in local else None

    for k in pairs:
        if (between := ends(k)) is not None:
            i, j = between
            badness[i, j] = badness[j, i] = ((judged.measured[k] - judged.expected[k]) / judged.sigma[k]) ** 2
    gone = culprits(len(rows), [between for k in violated if (between := ends(k)) is not None], badness)
    return None if gone is None else rows[np.array(list(gone), dtype=np.int64)]


def _contradiction(pose: int, judged: PairDeviations, violated: IntArray) -> RejectedPose:
    deviation = judged.measured[violated] - judged.expected[violated]
    worst = int(np.argmax(np.abs(deviation) / judged.sigma[violated]))
    k = violated[worst]
    return RejectedPose(
        pose,
        PoseFault.LENGTHS,
        f"lengths contradict the body and fewer than three targets would remain "
        f"(targets {judged.first[k]} and {judged.second[k]}: {1e3 * deviation[worst]:+.3f} mm)",
    )


def _groups(keys: IntArray) -> dict[int, IntArray]:
    """Rows of each key that is not negative, in ascending order."""
    order = np.argsort(keys, kind="stable")
    order = order[keys[order] >= 0]
    if len(order) == 0:
        return {}
    return {int(keys[g[0]]): g for g in np.split(order, np.flatnonzero(np.diff(keys[order])) + 1)}
