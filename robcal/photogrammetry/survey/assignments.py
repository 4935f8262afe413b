"""The table of a survey: which target every detection shows, and what is known of targets and images so far."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from robcal.photogrammetry.core.network import CameraNetwork, IntArray, RejectedMark
from robcal.photogrammetry.survey.images import Collection
from robcal.transforms import Array

UNNAMED = -1
"""Id of a new target that no adjustment kept: it is not part of the body."""


@dataclass(frozen=True)
class Assignments:
    """Targets t of the network in the making, assigned to d detections in n images.

    Attributes
    ----------
    ids : (t,) target ids; new : (t,) bool, targets located by the survey alone, whose ids are provisional until
        :func:`named`.
    target : (d,) row of ``ids`` that a detection shows, -1 none; excluded : (d,) bool, rejected by an adjustment.
    start_points : (t, 3) start coordinates of the targets that were located by matching, NaN for all others.
    late_stations : (n, 4, 4) start values of images placed after the first adjustment, NaN for all others.
    unplaced : (name, reason) of images that the start could not place.
    rejected : marks taken out so far.
    """

    ids: IntArray
    new: NDArray[np.bool_]
    target: IntArray
    excluded: NDArray[np.bool_]
    start_points: Array
    late_stations: Array
    unplaced: tuple[tuple[str, str], ...] = ()
    rejected: tuple[RejectedMark, ...] = ()

    @classmethod
    def of(cls, detections: Collection) -> "Assignments":
        """The table of what is identified by codes."""
        t, d, n = len(detections.ids), len(detections.image), len(detections.names)
        return cls(
            detections.ids,
            np.zeros(t, dtype=bool),
            detections.target,
            np.zeros(d, dtype=bool),
            np.full((t, 3), np.nan),
            np.full((n, 4, 4), np.nan),
        )

    @property
    def assigned(self) -> int:
        """Number of detections that show a known target."""
        return int(np.count_nonzero(self.target >= 0))

    @property
    def late_images(self) -> IntArray:
        """Images that were placed after the first adjustment."""
        return np.flatnonzero(np.isfinite(self.late_stations[:, 0, 0]))

    def has_free(self) -> bool:
        """True if some usable detections have no identity."""
        return bool(np.any((self.target < 0) & ~self.excluded))

    def row_of(self) -> dict[int, int]:
        """Row of each target id."""
        return {int(i): row for row, i in enumerate(self.ids)}

    def assign(self, rows: IntArray, target: IntArray | int) -> "Assignments":
        """The table with detections ``rows`` assigned to target rows (-1: to none)."""
        column = self.target.copy()
        column[rows] = target
        return replace(self, target=column)

    def locate(self, row: int, point: Array) -> "Assignments":
        """The table with start coordinates of a target."""
        points = self.start_points.copy()
        points[row] = point
        return replace(self, start_points=points)

    def append(self, target_id: int, *, new: bool = False) -> "Assignments":
        """The table with one more target."""
        return replace(
            self,
            ids=np.append(self.ids, target_id),
            new=np.append(self.new, new),
            start_points=np.concatenate([self.start_points, np.full((1, 3), np.nan)]),
        )

    def without_starts(self) -> "Assignments":
        """The table without start values: what the last adjustment left out stays out."""
        return replace(
            self,
            start_points=np.full_like(self.start_points, np.nan),
            late_stations=np.full_like(self.late_stations, np.nan),
        )


def set_aside(table: Assignments, detections: Collection, rows: IntArray, reason: str) -> Assignments:
    """Detections that are not the target they were taken for; they may still be another one."""
    nan = float("nan")
    marks = [
        RejectedMark(
            detections.names[int(detections.image[row])],
            int(table.ids[table.target[row]]),
            (float(detections.xy[row, 0]), float(detections.xy[row, 1])),
            (nan, nan),
            nan,
            reason,
        )
        for row in rows
    ]
    return replace(table.assign(rows, -1), rejected=(*table.rejected, *marks))


def exclude_rejected(table: Assignments, detections: Collection, network: CameraNetwork) -> Assignments:
    """Marks that an adjustment rejected lose their assignment for good."""
    image_of = {name: i for i, name in enumerate(detections.names)}
    row_of = table.row_of()
    gone = np.zeros(len(table.target), dtype=bool)
    for mark in network.rejected:
        hit = (detections.image == image_of[mark.image]) & (table.target == row_of[mark.target])
        gone |= hit & np.all(detections.xy == np.array(mark.xy), axis=1)
    table = table.assign(np.flatnonzero(gone), -1)
    return replace(table, excluded=table.excluded | gone, rejected=(*table.rejected, *network.rejected))


def named(table: Assignments, names: dict[int, int]) -> Assignments:
    """New targets with their final ids instead of provisional ones, :data:`UNNAMED` where there is none."""
    provisional = set(table.ids[table.new].tolist())

    def name(i: int) -> int:
        return names.get(i, UNNAMED) if i in provisional else i

    rejected = tuple(replace(mark, target=name(mark.target)) for mark in table.rejected)
    return replace(table, ids=np.array([name(int(i)) for i in table.ids], dtype=np.int64), rejected=rejected)


def sightings_in(
    table: Assignments, detections: Collection, network: CameraNetwork, more_images: Sequence[str] = ()
) -> tuple[IntArray, IntArray, IntArray]:
    """Usable detections (rows), their image in the network (with ``more_images`` behind it) and their target in it.

    A target is -1 where none is assigned, -2 where it is not in the network.
    """
    place = {name: i for i, name in enumerate([*network.image_names, *more_images])}
    compact = np.array([place.get(name, -1) for name in detections.names])
    rows = np.flatnonzero((compact[detections.image] >= 0) & ~table.excluded)
    in_network = {int(i): row for row, i in enumerate(network.ids)}
    of_target = np.array([in_network.get(int(i), -2) for i in table.ids] + [-1], dtype=np.int64)  # row -1: none
    return rows, compact[detections.image[rows]], of_target[table.target[rows]]
