"""The marks still in use during a bundle adjustment, with the values of all images and targets."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike

from robcal.errors import DegenerateGeometry, NotIdentifiable
from robcal.estimation.summary import SolveSummary
from robcal.photogrammetry.bundle.datum import DatumSpec, resolve_datum
from robcal.photogrammetry.bundle.lengths import rows_of
from robcal.photogrammetry.bundle.normals import MarkOrder, State
from robcal.photogrammetry.bundle.solver import Bars, Problem
from robcal.photogrammetry.core.network import ImageMarks, IntArray, Lengths, RejectedMark
from robcal.transforms import Array


@dataclass(frozen=True)
class Compact:
    """The problem of what is in use: only images (n,) and targets (t,) with marks, whose rows it names.

    ``note``: on the datum, '' if there is none.
    """

    problem: Problem
    state: State
    images: IntArray
    targets: IntArray
    note: str


@dataclass
class WorkingSet:
    """Rows ``kept`` of the marks still in use and values of all images and targets, as the adjustment goes on."""

    marks: ImageMarks
    state: State
    kept: IntArray
    radii: Array
    normals: Array | None
    group_sigma: Array
    names: tuple[str, ...]
    ids: IntArray
    summaries: list[SolveSummary] = field(default_factory=list)
    rejected: list[RejectedMark] = field(default_factory=list)

    def subset(self) -> tuple[IntArray, IntArray]:
        """Images and targets in use."""
        return np.unique(self.marks.image[self.kept]), np.unique(self.marks.target[self.kept])

    def compact(self, basis: Array, spec: DatumSpec, lengths: Lengths | None = None) -> Compact:
        """The adjustment problem of what is in use, with scale bars if given."""
        bars = lengths or Lengths.none()
        images, targets = self.subset()
        marks = self.marks.select(self.kept)
        marks = replace(
            marks, image=np.searchsorted(images, marks.image), target=np.searchsorted(targets, marks.target)
        )
        order = MarkOrder(marks, len(images), len(targets))
        state = State(self.state.camera, self.state.camera_T_body[images], self.state.points[targets])
        ids = self.ids[targets]
        datum, note = resolve_datum(spec, ids, state.points, bars)
        problem = Problem(
            order,
            basis,
            datum,
            Bars(rows_of(bars, ids), bars.length, bars.sigma),
            self.radii[targets],
            None if self.normals is None else self.normals[targets],
            np.zeros(len(marks), np.int64) if order.marks.group is None else order.marks.group,
            self.group_sigma,
        )
        return Compact(problem, state, images, targets, note)

    def store(self, at: Compact, state: State, summary: SolveSummary) -> None:
        """Put the values of a minimised compact problem back."""
        poses, points = self.state.camera_T_body.copy(), self.state.points.copy()
        poses[at.images], points[at.targets] = state.camera_T_body, state.points
        self.state = State(state.camera, poses, points)
        self.summaries.append(summary)

    def drop_duplicates(self) -> None:
        """A target marked twice in one image: at least one mark is wrong and it is unknown which, so both go."""
        key = self.marks.image * (int(self.marks.target.max(initial=0)) + 1) + self.marks.target
        _, inverse, counts = np.unique(key, return_inverse=True, return_counts=True)
        repeated = counts[inverse] > 1
        for row in np.flatnonzero(repeated):
            self.reject(int(row), "target marked more than once in this image")
        self.kept = self.kept[~repeated]

    def prune(self) -> None:
        """Drop what cannot be used: images with fewer than four marks, targets seen in one image only."""
        while True:
            image, target = self.marks.image[self.kept], self.marks.target[self.kept]
            few_marks = np.bincount(image, minlength=1)[image] < 4
            few_rays = np.bincount(target, minlength=1)[target] < 2
            if not np.any(few_marks | few_rays):
                return
            for flag, reason in ((few_marks, "image with fewer than four marks"), (few_rays, "seen in one image only")):
                for row in self.kept[flag & ~(few_marks if flag is few_rays else np.zeros_like(flag))]:
                    self.reject(row, reason)
            self.kept = self.kept[~(few_marks | few_rays)]

    def check_size(self, free: Sequence[str]) -> None:
        """Raise an error where there are fewer observations than unknowns.

        Raises
        ------
        DegenerateGeometry : too few images or targets. NotIdentifiable : too few marks for them.
        """
        images, targets = self.subset()
        if len(images) < 2 or len(targets) < 4:
            raise DegenerateGeometry(
                f"only {len(images)} images and {len(targets)} targets can be used together: a network needs at least "
                "two images that share four targets, better ten images with ten targets each"
            )
        unknowns = 6 * len(images) + 3 * len(targets) + len(free) - 7
        if 2 * len(self.kept) < unknowns:
            raise NotIdentifiable(
                f"{2 * len(self.kept)} image coordinates cannot determine {unknowns} unknowns: take more images",
                tuple(free),
            )

    def reject(self, row: int, reason: str, residual: ArrayLike = (np.nan, np.nan), statistic: float = np.nan) -> None:
        """Note a mark as taken out (``kept`` is updated by the caller)."""
        xy, r = self.marks.xy[row], np.asarray(residual)
        self.rejected.append(
            RejectedMark(
                self.names[int(self.marks.image[row])],
                int(self.ids[self.marks.target[row]]),
                (float(xy[0]), float(xy[1])),
                (float(r[0]), float(r[1])),
                float(statistic),
                reason,
            )
        )
