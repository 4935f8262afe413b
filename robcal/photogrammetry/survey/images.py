"""All detections of a survey in columns, with the identity that codes give them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from robcal.errors import DegenerateGeometry, InvalidInput
from robcal.imaging.detections import TargetKind
from robcal.photogrammetry.core.network import ImageMarks, IntArray
from robcal.photogrammetry.survey.matching import Sightings
from robcal.transforms import Array

if TYPE_CHECKING:
    from robcal.photogrammetry.survey.types import BodyTarget, SurveyImage


@dataclass(frozen=True)
class Collection:
    """Detections of all images, d of them.

    Attributes
    ----------
    names : of the usable images. image (d,), xy (d, 2), covariance (d, 2, 2), semi_axes (d, 2) and angle (d,) of the
        ellipses, NaN where unknown.
    ids : (t,) ids of the targets identified by codes. target : (d,) row of the target, -1: not identified.
    unused : (name, reason) of images left out already. notes : for the report.
    """

    names: tuple[str, ...]
    image: IntArray
    xy: Array
    covariance: Array
    semi_axes: Array
    angle: Array
    ids: IntArray
    target: IntArray
    unused: tuple[tuple[str, str], ...]
    notes: tuple[str, ...]

    def marks(self, rows: IntArray, target: IntArray, sigma: Array | None = None) -> ImageMarks:
        """Marks of detections as targets (m,), with their own covariance or unit ones times ``sigma``^2 (m,)."""
        covariance = self.covariance[rows] if sigma is None else np.eye(2) * (np.asarray(sigma) ** 2)[:, None, None]
        return ImageMarks(self.image[rows], target, self.xy[rows], covariance, self.semi_axes[rows])

    def sightings(self, rows: IntArray, image: IntArray) -> Sightings:
        """Detections as the matching wants them, with images renumbered."""
        sigma = np.sqrt(np.trace(self.covariance[rows], axis1=1, axis2=2) / 2.0)
        return Sightings(image, self.xy[rows], sigma, self.semi_axes[rows, 0])


@dataclass(frozen=True)
class _Columns:
    """Detections of one image: as in :class:`Collection`, with the codes (d,), -1 where there is none."""

    name: str
    xy: Array
    covariance: Array
    semi_axes: Array
    angle: Array
    codes: IntArray


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
    usable: list[_Columns] = []
    unused: list[tuple[str, str]] = []
    notes: list[str] = []
    unlisted: Counter[int] = Counter()
    for image in images:
        columns = _columns(image)
        twin = next((c.name for c in usable if np.array_equal(c.xy, columns.xy)), None)
        if len(columns.xy) == 0:
            message = image.detections.message if image.detections is not None else ""
            unused.append((image.name, message or "no targets found"))
        elif twin is not None:
            unused.append((image.name, f"the same picture as {twin}"))
        else:
            columns = columns if image.marks is not None else _without_unlisted(columns, listed, unlisted)
            usable.append(_without_repeated(columns, notes))
    if len(usable) < 2:
        reasons = "; ".join(f"{name}: {reason}" for name, reason in unused[:5])
        because = f" ({reasons})" if reasons else ""
        raise DegenerateGeometry(
            f"only {len(usable)} of {len(images)} images can be used{because}: a survey needs at least three, better "
            "twenty from all sides"
        )
    often = sorted(code for code, count in unlisted.items() if count >= 3)
    if often:
        notes.append(f"codes seen but not listed in the body: {often}; their dots are treated as uncoded")
    codes = np.concatenate([c.codes for c in usable]).astype(np.int64)
    # a code seen once cannot be located from it; its dot may still be found as an uncoded one
    values, counts = np.unique(codes[codes >= 0], return_counts=True)
    ids = values[counts >= 2]
    return Collection(
        tuple(c.name for c in usable),
        np.repeat(np.arange(len(usable)), [len(c.xy) for c in usable]),
        np.concatenate([c.xy for c in usable]),
        np.concatenate([c.covariance for c in usable]),
        np.concatenate([c.semi_axes for c in usable]),
        np.concatenate([c.angle for c in usable]),
        ids,
        np.where(np.isin(codes, ids), np.searchsorted(ids, codes), -1),
        tuple(unused),
        tuple(notes),
    )


def _without_unlisted(columns: _Columns, listed: set[int], unlisted: Counter[int]) -> _Columns:
    """Codes that the body does not list (if it lists any) identify nothing; they are counted."""
    if not listed:
        return columns
    unknown = (columns.codes >= 0) & ~np.isin(columns.codes, list(listed))
    unlisted.update(columns.codes[unknown].tolist())
    return replace(columns, codes=np.where(unknown, -1, columns.codes))


def _without_repeated(columns: _Columns, notes: list[str]) -> _Columns:
    """A code that appears more than once identifies none of its dots."""
    values, counts = np.unique(columns.codes[columns.codes >= 0], return_counts=True)
    repeated = values[counts > 1]
    if len(repeated) == 0:
        return columns
    which = ", ".join(map(str, repeated.tolist()))
    notes.append(f"image {columns.name}: target {which} appears more than once")
    return replace(columns, codes=np.where(np.isin(columns.codes, repeated), -1, columns.codes))


def _check_names(images: Sequence[SurveyImage], targets: Sequence[BodyTarget]) -> None:
    names = [image.name for image in images]
    double = sorted({n for n in names if names.count(n) > 1})
    if double:
        raise InvalidInput(f"two images have the same name {double[0]}: rename one")
    listed = [t.id for t in targets if t.id is not None]
    twice = sorted({i for i in listed if listed.count(i) > 1})
    if twice:
        raise InvalidInput(f"the body lists target {twice[0]} twice: ids must be unique")


def _columns(image: SurveyImage) -> _Columns:
    if image.marks is not None:
        ids, xy, covariance = (np.asarray(column) for column in image.marks)
        if xy.shape != (len(ids), 2) or covariance.shape != (len(ids), 2, 2):
            raise InvalidInput(f"image {image.name}: ids, xy and covariance of the marks differ in length")
        if not np.all(np.isfinite(xy)):
            bad = ids[~np.isfinite(xy).all(axis=1)][0]
            raise InvalidInput(f"image {image.name}, target {bad}: a coordinate is no number, remove the row")
        none = np.full((len(ids), 2), np.nan)
        return _Columns(image.name, xy.astype(float), covariance.astype(float), none, none[:, 0], ids.astype(np.int64))
    if image.detections is None:
        raise InvalidInput(f"image {image.name} has neither detections nor marks")
    found = image.detections
    # a square marker or a corner shows no ellipse
    angle = np.where(np.isin(found.kind, (TargetKind.ARUCO, TargetKind.CORNER)), np.nan, found.angle)
    return _Columns(image.name, found.xy, found.covariance, found.semi_axes, angle, found.code.astype(np.int64))
