"""Which dot is which target: ring codes and markers first, then geometry, in one image of a station."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from robcal.errors import DegenerateGeometry
from robcal.imaging.detections import Detections, TargetKind
from robcal.photogrammetry.bodies import Body, IntArray
from robcal.photogrammetry.camera import Camera, project_with_jacobians
from robcal.photogrammetry.eccentric_circle import effective_point
from robcal.photogrammetry.identify_grid import has_rows, search_grid
from robcal.photogrammetry.identify_grow import View, view_of
from robcal.photogrammetry.identify_search import match_dots, search_body
from robcal.photogrammetry.resection import refine_poses, resect
from robcal.transforms import Array, skew, transform

_GATE = 5.0
_CROWD = 100
"""Dots in an image above which triples of dots are tried but briefly: they would not be enough in any time."""


@dataclass(frozen=True)
class Prediction:
    """Where the body is expected before the camera: ``camera_T_body`` (4, 4), ``covariance`` (6, 6) or None and the
    error in the image (px) beyond that covariance."""

    camera_T_body: Array
    covariance: Array | None = None
    error_px: float = 3.0


@dataclass(frozen=True)
class IdentifiedImage:
    """Targets identified in one image.

    Attributes
    ----------
    rows : (k,) rows of the detections; ids : (k,) target ids.
    camera_T_body : pose found on the way, None where only codes were read.
    method : 'codes', 'prediction', 'search', 'rows' (search by rows of dots) or 'none'.
    alternatives : other poses (with other numberings) that fit as well; then nothing is identified.
    reason : why nothing was identified, else empty.
    view : where rows of dots were identified, what this camera sees, as evidence for others.
    """

    rows: IntArray
    ids: IntArray
    camera_T_body: Array | None
    method: str
    alternatives: tuple[Array, ...] = ()
    reason: str = ""
    view: View | None = None


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
    rows, ids = _coded(detections, body)
    at = body.index(ids)
    placed = body.known[at] if len(at) else np.zeros(0, dtype=bool)
    if placed.sum() >= 4:
        try:
            fit = resect(
                camera, ids[placed], detections.xy[rows[placed]], detections.covariance[rows[placed]], body,
                model_error_px=model_error_px,
            )  # fmt: skip
        except DegenerateGeometry:
            fit = None
        if fit is not None and fit.inliers.sum() >= 4 and fit.chi2 < 50.0 * max(1, fit.redundancy):
            keep = np.ones(len(rows), dtype=bool)
            keep[np.flatnonzero(placed)[~fit.inliers]] = False
            prediction = Prediction(fit.camera_T_body, fit.covariance, model_error_px)
            return _extended(detections, body, camera, rows[keep], ids[keep], prediction, "codes")
    best: IdentifiedImage | None = None
    for prediction in predictions:
        trial = _extended(detections, body, camera, rows, ids, prediction, "prediction")
        if len(trial.rows) >= 4 and (best is None or len(trial.rows) > len(best.rows)):
            best = trial
    if best is not None:
        return best
    none = np.empty(0, dtype=np.int64)
    dots = _free_dots(detections, rows)
    candidates = np.flatnonzero(body.known & ~np.isin(body.ids, ids) & _uncoded(body))
    reason = f"{len(ids)} coded targets read, too few for a pose"
    if search and len(candidates) >= 4:
        if has_rows(body.points[candidates]) and len(dots) > len(candidates) // 2:
            grid = _from_rows(detections, body, camera, candidates, dots, model_error_px, others)
            if grid.method != "none" or grid.alternatives:
                return _joined(rows, ids, grid)
        found, why = search_body(
            camera, detections.xy[dots], detections.covariance[dots], detections.semi_axes[dots, 0], body, candidates,
            model_error_px=model_error_px, max_hypotheses=120_000 if len(dots) <= _CROWD else 30_000,
        )  # fmt: skip
        if len(found) == 1:
            single = IdentifiedImage(
                dots[found[0].rows], body.ids[found[0].targets], found[0].camera_T_body, "search"
            )
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
    detections: Detections, body: Body, camera: Camera, candidates: IntArray, dots: IntArray, model_error_px: float,
    others: Sequence[View],
) -> IdentifiedImage:  # fmt: skip
    """The search by rows of dots: one numbering, several (refused), or nothing with a reason."""
    size = np.sqrt(detections.semi_axes[dots].prod(axis=1))
    found, why = search_grid(
        camera, detections.xy[dots], size, detections.contrast[dots], body, candidates,
        model_error_px=model_error_px, others=others,
    )  # fmt: skip
    none = np.empty(0, dtype=np.int64)
    if len(found) != 1:
        poses = tuple(f.camera_T_body for f in found)
        return IdentifiedImage(none, none, None, "none", poses, _symmetric(len(found)) if found else why)
    best = found[0]
    rows, targets = dots[best.dots], candidates[best.targets]
    zero = np.zeros(len(rows), dtype=np.int64)
    covariance = detections.covariance[rows] + best.rms**2 * np.eye(2)
    # the pose that belongs to the camera as given, not to the lens adjusted on the way
    fit = refine_poses(
        best.camera_T_body[None], zero, zero, [camera], np.eye(4)[None], body.points[targets], detections.xy[rows],
        covariance,
    )  # fmt: skip
    view = view_of(best, body.points[candidates])
    return IdentifiedImage(rows, body.ids[targets], fit.reference_T_body[0], "rows", view=view)


def _uncoded(body: Body) -> NDArray[np.bool_]:
    return np.array([code is None for code in body.codes], dtype=bool)


def _coded(detections: Detections, body: Body) -> tuple[IntArray, IntArray]:
    """Rows and ids of dots whose code belongs to the body; a code seen twice is no identification."""
    ring = np.array([c == "ring12" for c in body.codes], dtype=bool)
    marker = np.array([c is not None and c.startswith("aruco") for c in body.codes], dtype=bool)
    code = detections.code
    ok = np.zeros(len(code), dtype=bool)
    ok |= (detections.kind == TargetKind.RING12) & np.isin(code, body.ids[ring])
    ok |= (detections.kind == TargetKind.ARUCO) & np.isin(code, body.ids[marker])
    values, counts = np.unique(code[ok], return_counts=True)
    ok &= ~np.isin(code, values[counts > 1])
    rows = np.flatnonzero(ok)
    return rows, code[rows].astype(np.int64)


def _free_dots(detections: Detections, used: IntArray) -> IntArray:
    free = detections.kind == TargetKind.DOT
    free |= (detections.kind == TargetKind.RING12) & (detections.code < 0)
    free[used] = False
    return np.flatnonzero(free)


def _extended(
    detections: Detections, body: Body, camera: Camera, rows: IntArray, ids: IntArray, prediction: Prediction,
    method: str,
) -> IdentifiedImage:  # fmt: skip
    """Add the dots that the pose predicts, refine, and look again with the smaller uncertainty."""
    pose, C, error = prediction.camera_T_body, prediction.covariance, prediction.error_px
    coded, coded_ids = rows, ids
    others = np.flatnonzero(body.known & ~np.isin(body.ids, coded_ids))
    # a code that was seen twice or unreadable is a dot like the others
    dots = np.setdiff1d(np.arange(len(detections.xy)), coded)
    dots = dots[detections.kind[dots] != TargetKind.ARUCO]
    readable = detections.code[dots]
    if len(others) == 0 and len(rows):
        return IdentifiedImage(rows, ids, pose, method)
    before: tuple[int, ...] | None = None
    for _ in range(3):
        predicted, gate, size = _predict(camera, pose, C, body, others, error)
        blob = detections.semi_axes[dots, 0]
        with np.errstate(invalid="ignore"):
            like = ~((blob[None] > 1.6 * size[:, None] + 1.0) | (blob[None] < size[:, None] / 1.6 - 1.0))
        # a dot that carries another valid code of this body is not an uncoded target
        other_code = np.isin(readable, body.ids) & (readable >= 0)
        like &= ~other_code[None] | (readable[None] == body.ids[others][:, None])
        targets, found = match_dots(predicted, gate, detections.xy[dots], like)
        new_rows = np.concatenate([coded, dots[found]])
        new_ids = np.concatenate([coded_ids, body.ids[others[targets]]])
        now = (*new_rows.tolist(), *new_ids.tolist())
        if now == before:
            break
        before = now
        usable = body.known[body.index(new_ids)] if len(new_ids) else np.zeros(0, dtype=bool)
        if usable.sum() < 4:
            return IdentifiedImage(new_rows, new_ids, pose, method)
        at = body.index(new_ids[usable])
        k = len(at)
        zero = np.zeros(k, dtype=np.int64)
        cov = detections.covariance[new_rows[usable]] + error**2 * np.eye(2)
        fit = refine_poses(
            pose[None], zero, zero, [camera], np.eye(4)[None], body.points[at], detections.xy[new_rows[usable]], cov,
            radius=0.5 * body.diameters[at], normals=body.estimated_normals()[at],
        )  # fmt: skip
        if not np.isfinite(fit.covariance[0]).all():
            break
        spread = float(np.sqrt(fit.cost[0] / max(1, 2 * k - 6)))
        pose, C = fit.reference_T_body[0], fit.covariance[0] * max(1.0, spread) ** 2
        error = float(np.clip(error * spread, 0.1, error))
        rows, ids = new_rows, new_ids
    return IdentifiedImage(rows, ids, pose, method)


def _predict(
    camera: Camera, pose: Array, covariance: Array | None, body: Body, targets: IntArray, error_px: float
) -> tuple[Array, Array, Array]:
    """Image places (n, 2) of targets, search radii (n,) px and expected semi-axes (n,) px (NaN where not known)."""
    X = body.points[targets]
    normals = body.estimated_normals()[targets] @ pose[:3, :3].T
    p = transform(pose, X)
    xy, d_point, _ = project_with_jacobians(camera, effective_point(p, normals, 0.5 * body.diameters[targets]))
    variance = np.full(len(targets), error_px**2)
    if covariance is not None:
        J = d_point @ np.concatenate([np.broadcast_to(pose[:3, :3], (len(X), 3, 3)), -pose[:3, :3] @ skew(X)], axis=-1)
        S = J @ covariance @ np.swapaxes(J, -1, -2)
        variance = variance + np.linalg.eigvalsh(0.5 * (S + np.swapaxes(S, -1, -2)))[..., -1]
    inside = (xy > -20).all(axis=1) & (xy[:, 0] < camera.width + 20) & (xy[:, 1] < camera.height + 20)
    if body.normals is not None:
        facing = np.sum(normals * p, axis=1) < 0
        inside &= facing | ~np.isfinite(normals).all(axis=1)
    xy = np.where(inside[:, None], xy, np.nan)
    with np.errstate(invalid="ignore", divide="ignore"):
        size = camera.fx * 0.5 * body.diameters[targets] / p[:, 2]
    gate = np.where(np.isfinite(variance), _GATE * np.sqrt(np.maximum(variance, 0.01)), 0.0)
    return xy, gate, size

