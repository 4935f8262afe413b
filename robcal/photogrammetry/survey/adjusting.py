"""Start and adjustments of a survey's network from the table of assignments."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from robcal.photogrammetry.bundle.adjustment import AdjustSettings, adjust
from robcal.photogrammetry.bundle.body_frame import Similarity
from robcal.photogrammetry.bundle.datum import DatumSpec
from robcal.photogrammetry.bundle.start_network import Approximate, approximate_network
from robcal.photogrammetry.core.discs import Discs, discs_from_ellipses, modelled_discs, size_ratio
from robcal.photogrammetry.core.network import CameraNetwork
from robcal.photogrammetry.survey.assignments import Assignments, exclude_rejected, set_aside
from robcal.photogrammetry.survey.types import SurveyInput


@dataclass(frozen=True)
class Adjusted:
    """An adjusted network and the discs of its targets as estimated from the ellipses.

    ``discs`` (of the targets ``network.ids``) and ``size_ratio`` (their diameters, in the scale of the approximate
    values, by stated ones) are None where the eccentricity is not modelled or nothing can be compared.
    """

    network: CameraNetwork
    discs: Discs | None
    size_ratio: float | None


@dataclass(frozen=True)
class Step:
    """What distinguishes one adjustment of a survey from the others; see :func:`adjust`."""

    settings: AdjustSettings
    free_intrinsics: Sequence[str]
    datum: DatumSpec = "free"
    with_lengths: bool = False


def first_adjustment(given: SurveyInput) -> tuple[Assignments, Adjusted]:
    """Adjust the identified targets alone; what they cannot determine yet is held until more is known."""
    table = Assignments.of(given.detections)
    settings = given.adjust_settings
    if table.has_free():
        settings = replace(settings, hold_focal=True)
    table, start = _start(given, table)
    return _adjust(given, table, start, Step(settings, given.settings.free_intrinsics))


def readjust(
    given: SurveyInput, table: Assignments, network: CameraNetwork, step: Step, frame: Similarity | None = None
) -> tuple[Assignments, Adjusted]:
    """Adjust all assigned detections, starting from a network (brought to ``frame``) and the table's start values.

    Targets of a fixed datum start at their given coordinates.
    """
    start = _spread(table, given.detections.names, network)
    if frame is not None:
        start = replace(start, camera_T_body=frame.stations(start.camera_T_body), points=frame.points(start.points))
    if isinstance(step.datum, tuple):
        held = np.isin(table.ids, step.datum)
        start = replace(start, points=np.where(held[:, None], given.given_points(table.ids), start.points))
    return _adjust(given, table, start, step)


def _start(given: SurveyInput, table: Assignments) -> tuple[Assignments, Approximate]:
    """Approximate values from the identified detections."""
    detections = given.detections
    rows = np.flatnonzero(table.target >= 0)
    marks = detections.marks(rows, table.target[rows], np.ones(len(rows)))
    known = given.given_points(table.ids)
    start = approximate_network(
        marks,
        len(detections.names),
        len(table.ids),
        given.camera,
        focal_known=given.camera_known,
        known_points=known if np.isfinite(known).any() else None,
    )
    unplaced = []
    for j in np.flatnonzero(~start.placed):
        count = int(np.count_nonzero(marks.image == j))
        few = f"only {count} identified targets"
        unplaced.append((detections.names[j], few if count < 4 else "its targets do not fit those of the other images"))
    # a mark far off its place is no mark of that target; it may still be one of another
    misfits = rows[~start.fits & start.placed[marks.image] & start.located[marks.target]]
    table = set_aside(table, detections, misfits, "far from where the other images place this target (wrong id?)")
    return replace(table, unplaced=tuple(unplaced)), start


def _spread(table: Assignments, names: Sequence[str], network: CameraNetwork) -> Approximate:
    """Values of a network over all images and targets, with the table's start values where it has them."""
    image_of, row_of = {name: i for i, name in enumerate(names)}, table.row_of()
    poses, points = table.late_stations.copy(), np.full((len(table.ids), 3), np.nan)
    poses[[image_of[name] for name in network.image_names]] = network.camera_T_body
    points[[row_of[int(i)] for i in network.ids]] = network.points
    started = np.isfinite(table.start_points[:, :1])
    return Approximate(network.camera, poses, np.where(started, table.start_points, points))


def _adjust(given: SurveyInput, table: Assignments, start: Approximate, step: Step) -> tuple[Assignments, Adjusted]:
    """Adjust the assigned detections of placed images and located targets."""
    detections = given.detections
    images, targets = np.flatnonzero(start.placed), np.flatnonzero(start.located)
    rows = np.flatnonzero(
        (table.target >= 0) & start.placed[detections.image] & start.located[np.maximum(table.target, 0)]
    )
    marks = detections.marks(rows, table.target[rows])
    marks = replace(marks, image=np.searchsorted(images, marks.image), target=np.searchsorted(targets, marks.target))
    poses, points, ids = start.camera_T_body[images], start.points[targets], table.ids[targets]
    stated = given.modelled_diameters(ids, table.new[targets])
    diameters, normals, seen, ratio = None, None, None, None
    if stated is not None:
        axes, angle = detections.semi_axes[rows], detections.angle[rows]
        seen = discs_from_ellipses(start.camera, poses, points, marks.image, marks.target, axes, angle)
        ratio = size_ratio(seen, stated)
        diameters, normals = modelled_discs(seen, stated, points)
    network = adjust(
        marks,
        start.camera,
        poses,
        points,
        ids=ids,
        image_names=[detections.names[i] for i in images],
        lengths=given.bars if step.with_lengths else None,
        check_lengths=given.checks if step.with_lengths else None,
        datum=step.datum,
        diameters=diameters,
        normals=normals,
        free_intrinsics=step.free_intrinsics,
        settings=step.settings,
    )
    if seen is not None:
        row_of = {int(i): row for row, i in enumerate(ids)}
        seen = seen.select(np.array([row_of[int(i)] for i in network.ids], dtype=np.int64))
    return exclude_rejected(table, detections, network), Adjusted(network, seen, ratio)
