"""Which dot is which target: ring codes and markers first, then geometry, in one image of a station."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from robcal.imaging.detections import Detections, TargetKind
from robcal.imaging.ring_code import ring_segments
from robcal.photogrammetry.boards.layout import CIRCLE, CORNER
from robcal.photogrammetry.core.bodies import Body, IntArray
from robcal.photogrammetry.core.camera import Camera
from robcal.photogrammetry.identify.dots import Dots
from robcal.photogrammetry.identify.extension import IdentifiedImage, Prediction, Start, extended
from robcal.photogrammetry.identify.grid import has_rows, search_grid
from robcal.photogrammetry.identify.grow import View, view_of
from robcal.photogrammetry.identify.search import search_body
from robcal.photogrammetry.orientation.resection import Resection, TargetMarks, refine_poses, resect_images

_CROWD = 100
"""Dots in an image above which triples of dots are tried but briefly: they would not be enough in any time."""


def identify_targets(
    detections: Detections,
    body: Body,
    camera: Camera,
    *,
    predictions: Sequence[Prediction] = (),
    model_error_px: float = 3.0,
    search: bool = True,
    others: Sequence[View] = (),
) -> IdentifiedImage:
    """Identify the targets of a body in one image.

    Codes give ids at once; with four or more of known coordinates they also give a pose, which removes misread codes
    and predicts the uncoded and unread dots. Without enough codes a prediction (from another camera or the last pose)
    is tried, then a search by geometry.

    Parameters
    ----------
    predictions : expected poses, each tried; the one that explains most dots wins.
    model_error_px : error in the image that the camera's start values may cause.
    search : allow the search without prediction (refused where the numbering is not unique).
    others : what other cameras see of the body at this moment (by rows of its uncoded targets with coordinates); they
        may decide between numberings of a regular body.
    """
    return identify_images(
        [detections],
        body,
        camera,
        predictions=[predictions],
        model_error_px=model_error_px,
        search=search,
        others=others,
    )[0]


def identify_images(
    images: Sequence[Detections],
    body: Body,
    camera: Camera,
    *,
    predictions: Sequence[Sequence[Prediction]] | None = None,
    model_error_px: float = 3.0,
    search: bool = True,
    others: Sequence[View] = (),
) -> list[IdentifiedImage]:
    """Identify the targets in many images of one camera: as :func:`identify_targets` does, many poses at once.

    ``predictions`` per image, None for none.
    """
    expected = [()] * len(images) if predictions is None else predictions
    coded = [coded_rows(detections, body) for detections in images]
    placed = [body.known[body.index(ids)] if len(ids) else np.zeros(0, dtype=bool) for _, ids in coded]
    tasks: list[tuple[int, Start]] = []
    for k, fit in _resected(images, coded, placed, body, camera, model_error_px).items():
        if fit.inliers.sum() >= 4 and fit.chi2 < 50.0 * max(1, fit.redundancy):
            keep = np.ones(len(coded[k][0]), dtype=bool)
            keep[np.flatnonzero(placed[k])[~fit.inliers]] = False
            prediction = Prediction(fit.camera_T_body, fit.covariance, model_error_px)
            tasks.append((k, Start(images[k], coded[k][0][keep], coded[k][1][keep], prediction, "codes")))
    out: list[IdentifiedImage | None] = [None] * len(images)
    for (k, _), image in zip(tasks, extended(body, camera, [start for _, start in tasks]), strict=True):
        out[k] = image
    return [
        image
        if image is not None
        else _without_codes(images[k], body, camera, coded[k], expected[k], model_error_px, others if search else None)
        for k, image in enumerate(out)
    ]


def _resected(
    images: Sequence[Detections],
    coded: Sequence[tuple[IntArray, IntArray]],
    placed: Sequence[NDArray[np.bool_]],
    body: Body,
    camera: Camera,
    model_error_px: float,
) -> dict[int, Resection]:
    """Poses of the images with four or more coded targets of known place, by number of the image; ``inliers`` count
    the image's own ``placed`` codes."""
    several = [k for k, mask in enumerate(placed) if mask.sum() >= 4]
    if not several:
        return {}
    rows = [coded[k][0][placed[k]] for k in several]
    number = np.repeat(np.arange(len(several)), [len(own) for own in rows])
    ids = np.concatenate([coded[k][1][placed[k]] for k in several])
    xy = np.concatenate([images[k].xy[own] for k, own in zip(several, rows, strict=True)])
    covariance = np.concatenate([images[k].covariance[own] for k, own in zip(several, rows, strict=True)])
    found = resect_images(camera, number, ids, xy, covariance + model_error_px**2 * np.eye(2), body)
    return {
        k: replace(fit, inliers=fit.inliers[number == i])
        for i, (k, fit) in enumerate(zip(several, found, strict=True))
        if isinstance(fit, Resection)
    }


def _without_codes(
    detections: Detections,
    body: Body,
    camera: Camera,
    coded: tuple[IntArray, IntArray],
    predictions: Sequence[Prediction],
    model_error_px: float,
    others: Sequence[View] | None,
) -> IdentifiedImage:
    """One image whose codes give no pose: by predictions, then by its geometry (not with ``others`` None)."""
    rows, ids = coded
    placed = body.known[body.index(ids)] if len(ids) else np.zeros(0, dtype=bool)
    best: IdentifiedImage | None = None
    starts = [Start(detections, rows, ids, prediction, "prediction") for prediction in predictions]
    for trial in extended(body, camera, starts):
        if len(trial.rows) >= 4 and (best is None or len(trial.rows) > len(best.rows)):
            best = trial
    if best is not None:
        return best
    none = np.empty(0, dtype=np.int64)
    dots = _free_dots(detections, rows)
    candidates = np.flatnonzero(body.known & ~np.isin(body.ids, ids) & _uncoded(body))
    reason = f"{len(ids)} coded targets read, too few for a pose"
    if others is not None and len(candidates) >= 4:
        if has_rows(body.points[candidates]) and len(dots) > len(candidates) // 2:
            grid = _from_rows(detections, body, camera, candidates, dots, model_error_px, others)
            if grid.method != "none" or grid.alternatives:
                return _joined(rows, ids, grid)
        found, why = search_body(
            camera,
            Dots.of(detections, dots),
            body,
            candidates,
            model_error_px=model_error_px,
            max_hypotheses=120_000 if len(dots) <= _CROWD else 30_000,
        )
        if len(found) == 1:
            single = IdentifiedImage(dots[found[0].rows], body.ids[found[0].targets], found[0].camera_T_body, "search")
            return _joined(rows, ids, single)
        if len(found) > 1:
            return IdentifiedImage(
                none, none, None, "none", tuple(f.camera_T_body for f in found), _symmetric(len(found))
            )
        reason = why
    if len(rows):
        return IdentifiedImage(rows, ids, None, "codes", (), reason if placed.sum() < 3 else "")
    return IdentifiedImage(none, none, None, "none", (), reason)


def _symmetric(numberings: int) -> str:
    return (
        f"{numberings} numberings of the dots fit equally well (the arrangement is symmetric): "
        "use coded targets or a second camera"
    )


def _joined(rows: IntArray, ids: IntArray, found: IdentifiedImage) -> IdentifiedImage:
    """A result of the search with the coded targets that were read."""
    if found.method == "none":
        return found
    return replace(found, rows=np.concatenate([rows, found.rows]), ids=np.concatenate([ids, found.ids]))


def _from_rows(
    detections: Detections,
    body: Body,
    camera: Camera,
    candidates: IntArray,
    dots: IntArray,
    model_error_px: float,
    others: Sequence[View],
) -> IdentifiedImage:
    """The search by rows of dots: one numbering, several (refused), or nothing with a reason."""
    found, why = search_grid(
        camera, Dots.of(detections, dots), body.points[candidates], model_error_px=model_error_px, others=others
    )
    none = np.empty(0, dtype=np.int64)
    if len(found) != 1:
        poses = tuple(f.camera_T_body for f in found)
        return IdentifiedImage(none, none, None, "none", poses, _symmetric(len(found)) if found else why)
    best = found[0]
    rows, targets = dots[best.dots], candidates[best.targets]
    covariance = detections.covariance[rows] + best.rms**2 * np.eye(2)
    # the pose that belongs to the camera as given, not to the lens adjusted on the way
    marks = TargetMarks(body.points[targets], detections.xy[rows], covariance)
    fit = refine_poses(best.camera_T_body[None], np.zeros(len(rows), dtype=np.int64), marks, camera)
    view = view_of(best, body.points[candidates])
    return IdentifiedImage(rows, body.ids[targets], fit.reference_T_body[0], "rows", view=view)


def _uncoded(body: Body) -> NDArray[np.bool_]:
    return np.array([code is None for code in body.codes], dtype=bool)


def coded_rows(detections: Detections, body: Body) -> tuple[IntArray, IntArray]:
    """Rows and ids of dots whose code belongs to the body; a code seen twice is no identification."""
    ring = np.array([ring_segments(c) is not None for c in body.codes], dtype=bool)
    marker = np.array([c is not None and c.startswith("aruco") for c in body.codes], dtype=bool)
    code = detections.code
    ok = np.zeros(len(code), dtype=bool)
    ok |= (detections.kind == TargetKind.RING12) & np.isin(code, body.ids[ring])
    ok |= (detections.kind == TargetKind.ARUCO) & np.isin(code, body.ids[marker])
    for kind, name in ((TargetKind.CORNER, CORNER), (TargetKind.CIRCLE, CIRCLE)):
        ok |= (detections.kind == kind) & np.isin(code, body.ids[np.array([c == name for c in body.codes], dtype=bool)])
    values, counts = np.unique(code[ok], return_counts=True)
    ok &= ~np.isin(code, values[counts > 1])
    rows = np.flatnonzero(ok)
    return rows, code[rows].astype(np.int64)


def _free_dots(detections: Detections, used: IntArray) -> IntArray:
    free = detections.kind == TargetKind.DOT
    free |= (detections.kind == TargetKind.RING12) & (detections.code < 0)
    free[used] = False
    return np.flatnonzero(free)
