"""Points and poses left out because distances contradict the body, and poses that carry no frame."""

from dataclasses import dataclass
from enum import Enum

import numpy as np
from numpy.typing import NDArray

from robcal.photogrammetry.core.bodies import Body, IntArray, spans_plane
from robcal.photogrammetry.measure.distance_criterion import PairTable, culprits
from robcal.photogrammetry.measure.measured_points import RejectedPoint
from robcal.photogrammetry.measure.pair_deviations import PairDeviations


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
