"""What goes into the survey of a body and what becomes of it: marks of other programs, targets that are on the body."""

from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from robcal.files.body_file import BodyFile
from robcal.files.measurement_tables import MarksTable
from robcal.photogrammetry.core.bodies import Body
from robcal.photogrammetry.survey.survey import BodyTarget, SurveyImage, SurveyResult

_MISREAD = 0.2
"""Share of the usual number of images in which a code may be read that is not there."""


def survey_targets(file: BodyFile, ends: Iterable[int]) -> list[BodyTarget]:
    """The listed targets, and those ends of known lengths that are not listed (with ring codes)."""
    targets = [
        BodyTarget(t.id, t.code, t.diameter, t.xyz, None if t.sigma is None else max(t.sigma)) for t in file.targets
    ]
    listed = {t.id for t in targets}
    return targets + [BodyTarget(number, "ring12") for number in sorted(set(ends) - listed)]


def marks_by_image(table: MarksTable) -> list[SurveyImage]:
    """Marks measured by another program, image by image."""
    rows: dict[str, list[int]] = {}
    for i, image in enumerate(table.image):
        rows.setdefault(image, []).append(i)
    return [
        SurveyImage(image, marks=(table.target[at], table.xy[at], table.sigma[at][:, None, None] ** 2 * np.eye(2)))
        for image, at in rows.items()
    ]


def size_of_marks(table: MarksTable) -> tuple[int, int]:
    """Image size where no file tells it: marks are taken to fill the image evenly on all sides."""
    low, high = table.xy.min(axis=0), table.xy.max(axis=0)
    width, height = np.maximum(np.ceil(high + np.maximum(low, 0.0) + 1), 2).astype(int)
    return int(width), int(height)


def hardly_seen(targets: Iterable[int], images: Mapping[int, int], own: Sequence[int]) -> frozenset[int]:
    """Those of some targets that far fewer images (number by id) show than the body's own targets."""
    typical = float(np.median([images.get(target, 0) for target in own])) if own else 0.0
    return frozenset(target for target in targets if images.get(target, 0) <= _MISREAD * typical)


def surveyed_body(name: str, file: BodyFile, done: SurveyResult, absent: frozenset[int] = frozenset()) -> Body:
    """The surveyed targets as a body, without those that are ``absent`` from it.

    Targets that the file does not list (those of scale bars) are not on it either.
    """
    network = done.network
    listed = {t.id: t for t in file.targets if t.id is not None and t.id not in absent}
    unlisted_dot = any(t.id is None for t in file.targets)
    rows = [i for i, t in enumerate(network.ids) if int(t) in listed or (unlisted_dot and int(t) >= 4096)]
    at = np.array([3 * i + k for i in rows for k in range(3)], dtype=np.intp)
    own = [listed.get(int(network.ids[i])) for i in rows]
    common = next((t.diameter for t in file.targets if t.id is None and t.diameter is not None), np.nan)
    # what the file does not state was measured, where dots of stated size tell how large dots look
    measured = np.where(network.radii[rows] > 0, 2.0 * network.radii[rows], np.nan)
    stated = [common if t is None else np.nan if t.diameter is None else t.diameter for t in own]
    return Body(
        name=name,
        ids=np.array([network.ids[i] for i in rows], dtype=np.int64),
        points=network.points[rows],
        covariance=network.points_covariance[np.ix_(at, at)],
        codes=tuple(t.code if t is not None else None for t in own),
        diameters=np.where(np.isfinite(stated), stated, measured),
        polarity=file.polarity,
        normals=done.normals[rows] if np.isfinite(done.normals[rows]).any() else None,
    )
