"""The dots that a body's expected pose explains: matched and refined with the smaller uncertainties, round by round.

Where a body is expected before a camera, and what its image then is: places, search radii, sizes of the dots.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from robcal.imaging.detections import Detections, TargetKind
from robcal.imaging.ring_code import ring_segments
from robcal.photogrammetry.core.bodies import Body, IntArray
from robcal.photogrammetry.core.camera import Camera, project_with_jacobians
from robcal.photogrammetry.core.eccentricity import effective_point
from robcal.photogrammetry.identify.dots import match_dots
from robcal.photogrammetry.identify.grow import View
from robcal.photogrammetry.orientation.resection import PoseFit, TargetMarks, refine_poses
from robcal.transforms import Array, skew, transform

_GATE = 5.0
"""Search radius in standard deviations of a predicted place."""
_INSIDE_RING = 1.2
"""Search radius of a dot within a code ring by its radius: parts of the ring lie from two radii on, less if tilted."""
_LEAST_GATE = 3.0
"""px"""


@dataclass(frozen=True)
class Prediction:
    """Where the body is expected before the camera: ``camera_T_body`` (4, 4), ``covariance`` (6, 6) or None and the
    error in the image (px) beyond that covariance."""

    camera_T_body: Array
    covariance: Array | None = None
    error_px: float = 3.0


def predict_dots(
    camera: Camera, pose: Array, covariance: Array | None, body: Body, targets: IntArray, error_px: float
) -> tuple[Array, Array, Array]:
    """Where a pose puts targets in the image.

    Returns
    -------
    Places (n, 2) px, NaN where they cannot be seen; search radii (n,) px; expected semi-axes (n,) px, NaN where the
    diameter is not known.
    """
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
    ringed = np.array([ring_segments(code) is not None for code in body.codes], dtype=bool)[targets] & np.isfinite(size)
    gate = np.where(ringed, np.minimum(gate, np.maximum(_INSIDE_RING * size, _LEAST_GATE)), gate)
    return xy, gate, size


IdentificationMethod = Literal["codes", "prediction", "search", "rows", "none"]


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
    method: IdentificationMethod
    alternatives: tuple[Array, ...] = ()
    reason: str = ""
    view: View | None = None


@dataclass(frozen=True)
class Start:
    """An image with the dots identified by code and where its body is expected."""

    detections: Detections
    rows: IntArray
    ids: IntArray
    prediction: Prediction
    method: IdentificationMethod


class _Growth:
    """One image between two rounds: the pose as known, and what it explains."""

    def __init__(self, start: Start, body: Body) -> None:
        self.start = start
        self.pose, self.covariance = start.prediction.camera_T_body, start.prediction.covariance
        self.error = start.prediction.error_px
        self.rows, self.ids = start.rows, start.ids
        self.others = np.flatnonzero(body.known & ~np.isin(body.ids, start.ids))
        # a code that was seen twice or unreadable is a dot like the others
        dots = np.setdiff1d(np.arange(len(start.detections.xy)), start.rows)
        self.dots = dots[start.detections.kind[dots] != TargetKind.ARUCO]
        self.done = len(self.others) == 0 and len(start.rows) > 0
        self._before: tuple[int, ...] | None = None

    def match(self, body: Body, camera: Camera) -> tuple[IntArray, IntArray] | None:
        """Rows and ids that the pose explains; None where nothing is to be refined any more."""
        d = self.start.detections
        predicted, gate, size = predict_dots(camera, self.pose, self.covariance, body, self.others, self.error)
        blob, readable = d.semi_axes[self.dots, 0], d.code[self.dots]
        with np.errstate(invalid="ignore"):
            like = ~((blob[None] > 1.6 * size[:, None] + 1.0) | (blob[None] < size[:, None] / 1.6 - 1.0))
        # a dot that carries another valid code of this body is not an uncoded target
        other_code = np.isin(readable, body.ids) & (readable >= 0)
        like &= ~other_code[None] | (readable[None] == body.ids[self.others][:, None])
        targets, found = match_dots(predicted, gate, d.xy[self.dots], like)
        rows = np.concatenate([self.start.rows, self.dots[found]])
        ids = np.concatenate([self.start.ids, body.ids[self.others[targets]]])
        now = (*rows.tolist(), *ids.tolist())
        if now == self._before:
            self.done = True
            return None
        self._before = now
        if (body.known[body.index(ids)].sum() if len(ids) else 0) < 4:
            self.rows, self.ids, self.done = rows, ids, True
            return None
        return rows, ids

    def take(self, rows: IntArray, ids: IntArray, fit: PoseFit, k: int) -> None:
        """The refined pose and its matches; nothing if the pose is singular."""
        if not np.isfinite(fit.covariance[k]).all():
            self.done = True
            return
        spread = float(np.sqrt(fit.cost[k] / max(1, fit.redundancy[k])))
        self.pose, self.covariance = fit.reference_T_body[k], fit.covariance[k] * max(1.0, spread) ** 2
        self.error = float(np.clip(self.error * spread, 0.1, self.error))
        self.rows, self.ids = rows, ids


def extended(body: Body, camera: Camera, starts: Sequence[Start]) -> list[IdentifiedImage]:
    """Add the dots that the poses predict, refine all poses, and match again with the smaller uncertainties."""
    images = [_Growth(start, body) for start in starts]
    normals = body.estimated_normals()
    for _ in range(3):
        matched = [(g, found) for g in images if not g.done and (found := g.match(body, camera)) is not None]
        if not matched:
            break
        usable = [body.known[body.index(ids)] for _, (_, ids) in matched]
        pose = np.repeat(np.arange(len(matched)), [int(mask.sum()) for mask in usable])
        at = np.concatenate([body.index(ids[mask]) for (_, (_, ids)), mask in zip(matched, usable, strict=True)])
        xy, covariance = [], []
        for (g, (rows, _)), mask in zip(matched, usable, strict=True):
            xy.append(g.start.detections.xy[rows[mask]])
            covariance.append(g.start.detections.covariance[rows[mask]] + g.error**2 * np.eye(2))
        radius = 0.5 * body.diameters[at]
        marks = TargetMarks(body.points[at], np.concatenate(xy), np.concatenate(covariance), radius, normals[at])
        fit = refine_poses(np.array([g.pose for g, _ in matched]), pose, marks, camera)
        for k, (g, (rows, ids)) in enumerate(matched):
            g.take(rows, ids, fit, k)
    return [IdentifiedImage(g.rows, g.ids, g.pose, g.start.method) for g in images]
