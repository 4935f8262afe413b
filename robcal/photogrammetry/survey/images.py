"""All detections of a survey in columns, with what is known about their identity."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from robcal.errors import DegenerateGeometry, InvalidInput
from robcal.imaging.detections import TargetKind
from robcal.photogrammetry.core.network import ImageMarks, IntArray
from robcal.photogrammetry.survey.matching import Sightings
from robcal.transforms import Array

if TYPE_CHECKING:
    from robcal.photogrammetry.survey.types import BodyTarget, SurveyImage


@dataclass
class Collection:
    """Detections of all images, d of them; ``assigned`` and ``barred`` change as the survey goes on.

    Attributes
    ----------
    names : of the usable images. image (d,), xy (d, 2), covariance (d, 2, 2), semi_axes (d, 2) and angle (d,) of the
        ellipses, NaN where unknown.
    ids : (t,) ids of the identified targets. assigned : (d,) row of the target, -1: unknown.
    barred : (d,) detections that the adjustment has thrown out.
    unused : (name, reason) of images left out already. notes : what else to say.
    """

    names: list[str]
    image: IntArray
    xy: Array
    covariance: Array
    semi_axes: Array
    angle: Array
    ids: IntArray
    assigned: IntArray
    barred: NDArray[np.bool_]
    unused: list[tuple[str, str]]
    notes: list[str]

    def has_free(self) -> bool:
        """True if some detections have no identity."""
        return bool(np.any((self.assigned < 0) & ~self.barred))

    def marks(self, rows: IntArray, sigma: Array | None = None) -> ImageMarks:
        """Image marks of detections, with their own covariance or unit ones times ``sigma``^2 (m,)."""
        covariance = self.covariance[rows] if sigma is None else np.eye(2) * (np.asarray(sigma) ** 2)[:, None, None]
        return ImageMarks(self.image[rows], self.assigned[rows], self.xy[rows], covariance, self.semi_axes[rows])

    def sightings(self, rows: IntArray, image: IntArray) -> Sightings:
        """Detections as the matching wants them, with images renumbered."""
        sigma = np.sqrt(np.trace(self.covariance[rows], axis1=1, axis2=2) / 2.0)
        return Sightings(image, self.xy[rows], sigma, self.semi_axes[rows, 0])


def collect(images: Sequence[SurveyImage], targets: Sequence[BodyTarget], lengths: IntArray) -> Collection:
    """Put all images into columns; images that cannot help are left out with their reason.

    A code counts as identified if the body lists it, or if it ends a known length (``lengths``: their ids), or if the
    body lists no coded target at all. A code that appears twice in an image identifies neither.

    Raises
    ------
    InvalidInput : two images have the same name, a target is listed twice, a mark is no number.
    DegenerateGeometry : fewer than two usable images.
    """
    _check_names(images, targets)
    listed = {t.id for t in targets if t.id is not None and t.code is not None}
    if listed:
        listed |= {int(v) for v in np.ravel(lengths)}
    names: list[str] = []
    columns: list[tuple[Array, Array, Array, Array, IntArray]] = []
    unused: list[tuple[str, str]] = []
    notes: list[str] = []
    unknown_codes: dict[int, int] = {}
    for image in images:
        xy, covariance, axes, angle, codes = _columns(image)
        if len(xy) == 0:
            message = image.detections.message if image.detections is not None else ""
            unused.append((image.name, message or "no targets found"))
            continue
        twin = next((n for n, c in zip(names, columns, strict=True) if np.array_equal(c[0], xy)), None)
        if twin is not None:
            unused.append((image.name, f"the same picture as {twin}"))
            continue
        if image.marks is None:
            strange = (codes >= 0) & ~np.isin(codes, list(listed)) if listed else np.zeros(len(codes), dtype=bool)
            for code in codes[strange].tolist():
                unknown_codes[code] = unknown_codes.get(code, 0) + 1
            codes = np.where(strange, -1, codes)
        values, counts = np.unique(codes[codes >= 0], return_counts=True)
        double = values[counts > 1]
        if len(double):
            notes.append(f"image {image.name}: target {', '.join(map(str, double.tolist()))} appears more than once")
            codes = np.where(np.isin(codes, double), -1, codes)
        names.append(image.name)
        columns.append((xy, covariance, axes, angle, codes))
    if len(names) < 2:
        reasons = "; ".join(f"{name}: {reason}" for name, reason in unused[:5])
        told = f" ({reasons})" if reasons else ""
        raise DegenerateGeometry(
            f"only {len(names)} of {len(images)} images can be used{told}: a survey needs at least three, better "
            "twenty from all sides"
        )
    often = {code: count for code, count in unknown_codes.items() if count >= 3}
    if often:
        notes.append(f"codes seen but not listed in the body: {sorted(often)}; their dots are treated as uncoded")
    image_index = np.concatenate([np.full(len(c[0]), i) for i, c in enumerate(columns)]).astype(np.int64)
    codes = np.concatenate([c[4] for c in columns]).astype(np.int64)
    # a code seen once cannot be located from it; its dot may still be found as an uncoded one
    values, counts = np.unique(codes[codes >= 0], return_counts=True)
    ids = values[counts >= 2]
    assigned = np.where(np.isin(codes, ids), np.searchsorted(ids, codes), -1).astype(np.int64)
    d = len(codes)
    return Collection(
        names,
        image_index,
        np.concatenate([c[0] for c in columns]),
        np.concatenate([c[1] for c in columns]),
        np.concatenate([c[2] for c in columns]),
        np.concatenate([c[3] for c in columns]),
        ids.astype(np.int64),
        assigned,
        np.zeros(d, dtype=bool),
        unused,
        notes,
    )


def _check_names(images: Sequence[SurveyImage], targets: Sequence[BodyTarget]) -> None:
    names = [image.name for image in images]
    double = sorted({n for n in names if names.count(n) > 1})
    if double:
        raise InvalidInput(f"two images have the same name {double[0]}: rename one")
    listed = [t.id for t in targets if t.id is not None]
    twice = sorted({i for i in listed if listed.count(i) > 1})
    if twice:
        raise InvalidInput(f"the body lists target {twice[0]} twice: ids must be unique")


def _columns(image: SurveyImage) -> tuple[Array, Array, Array, Array, IntArray]:
    if image.marks is not None:
        ids, xy, covariance = (np.asarray(column) for column in image.marks)
        if xy.shape != (len(ids), 2) or covariance.shape != (len(ids), 2, 2):
            raise InvalidInput(f"image {image.name}: ids, xy and covariance of the marks differ in length")
        if not np.all(np.isfinite(xy)):
            bad = ids[~np.isfinite(xy).all(axis=1)][0]
            raise InvalidInput(f"image {image.name}, target {bad}: a coordinate is no number, remove the row")
        none = np.full((len(ids), 2), np.nan)
        return xy.astype(float), covariance.astype(float), none, none[:, 0], ids.astype(np.int64)
    if image.detections is None:
        raise InvalidInput(f"image {image.name} has neither detections nor marks")
    found = image.detections
    # a square marker shows no ellipse
    angle = np.where(found.kind == TargetKind.ARUCO, np.nan, found.angle)
    return found.xy, found.covariance, found.semi_axes, angle, found.code.astype(np.int64)
