"""Images in the report, each with what was found in it as a drawing of its own over it: ellipses, ids, residuals."""

import base64
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from pipeline.artifacts import detections
from pipeline.detected_images import ImageEntry
from pipeline.report.blocks import Mark, Picture
from pipeline.report.material import Material
from pipeline.report.style import number
from robcal.errors import RobcalError
from robcal.files.images import read_image
from robcal.imaging.detections import CodeState, Detections
from robcal.transforms import Array

WIDTH = 720
"""Largest width of an embedded picture, px."""
JPEG_QUALITY = 70
MOST_REFUSED = 200
SAME = 2.0
"""px; a mark of the adjustment is the detection that lies nearer than this."""
ARROW = 0.03
"""Length of the RMS residual in the drawing, as a share of the picture's width."""


@dataclass(frozen=True)
class Adjusted:
    """Marks of one image after an adjustment: names of targets, places (n, 2) and residuals (n, 2), px."""

    names: tuple[str, ...]
    xy: Array
    residual: Array


@dataclass(frozen=True)
class SeenImages:
    """The images of a run and what the adjustments made of their marks."""

    material: Material

    @cached_property
    def _pixels(self) -> Array:
        station = self.material.station
        if station is None:
            return np.zeros((0, 2))
        return np.asarray(np.linalg.solve(station.design.whitening, station.design.residual[..., None])[..., 0])

    def pose_of(self, entry: ImageEntry) -> int | None:
        """The pose that an image of the station shows."""
        names = self.material.all_poses
        return names.index(entry.name) if entry.source.startswith("station/") and entry.name in names else None

    def adjusted(self, entry: ImageEntry) -> Adjusted | None:
        """What an adjustment made of an image; None where the image took no part."""
        kind, _, name = entry.source.partition("/")
        survey, station = self.material.surveys.get(name), self.material.station
        if kind == "survey" and survey is not None and entry.name in survey.network.image_names:
            n = survey.network
            mine = n.marks.image == n.image_names.index(entry.name)
            ids = tuple(str(n.ids[k]) for k in n.marks.target[mine])
            return Adjusted(ids, n.marks.xy[mine], n.residuals[mine])
        pose = self.pose_of(entry)
        if kind == "station" and station is not None and name in station.names and pose is not None:
            at = np.flatnonzero(station.poses == pose)
            marks = station.marks
            mine = (marks.camera == station.names.index(name)) & np.isin(marks.pose, at)
            ids = tuple(str(station.body.ids[k]) for k in marks.target[mine])
            return Adjusted(ids, marks.xy[mine], self._pixels[mine]) if mine.any() else None
        return None

    def picture(self, entry: ImageEntry, why: str, *, extra: bool = False) -> Picture | None:
        """An image with its marks; None where the image or its detections are gone."""
        if not entry.path.is_file() or entry.key is None:
            return None
        try:
            grey = read_image(entry.path)
            found = self.material.run.load(detections(entry.key))
        except (RobcalError, OSError):
            return None
        adjusted = self.adjusted(entry)
        box = _box(grey.shape[:2], None if adjusted is None else adjusted.xy)
        jpeg, width, height = _jpeg(grey, box)
        marks, magnified = _marks(found, adjusted, box)
        return Picture(
            base64.b64encode(jpeg).decode("ascii"),
            _caption(entry, found, adjusted, why, magnified),
            width,
            height,
            box=box,
            marks=marks,
            refused=_refused(found, box),
            pose=self.pose_of(entry),
            extra=extra,
        )

    def samples(self, entries: Sequence[ImageEntry]) -> Iterator[tuple[ImageEntry, str]]:
        """The usual image of a source, and the one with the fewest targets."""
        order = np.argsort([e.targets for e in entries], kind="stable")
        typical, poor = entries[int(order[len(order) // 2])], entries[int(order[0])]
        yield typical, "usual"
        if poor is not typical:
            yield poor, "fewest targets"


def _box(shape: tuple[int, ...], xy: Array | None) -> tuple[int, int, int, int]:
    """x, y, width, height of the part that is shown: around the marks that were used, the whole image without."""
    height, width = shape
    if xy is None or len(xy) < 3:
        return 0, 0, width, height
    low, high = xy.min(axis=0), xy.max(axis=0)
    margin = 0.12 * float(np.max(high - low)) + 30
    x0, y0 = (int(v) for v in np.maximum(low - margin, 0))
    x1, y1 = (int(v) for v in np.minimum(high + margin, (width - 1, height - 1)))
    return x0, y0, x1 - x0 + 1, y1 - y0 + 1


def _jpeg(grey: NDArray[np.uint8 | np.uint16], box: tuple[int, int, int, int]) -> tuple[bytes, int, int]:
    x, y, w, h = box
    part = grey[y : y + h, x : x + w]
    low, high = (float(v) for v in np.percentile(part[::4, ::4], (1, 99.9)))
    bright = np.clip((part.astype(np.float32) - low) * (235.0 / max(high - low, 1.0)), 0, 235).astype(np.uint8)
    scale = min(1.0, WIDTH / w)
    size = (max(1, round(w * scale)), max(1, round(h * scale)))
    _, encoded = cv2.imencode(
        ".jpg", cv2.resize(bright, size, interpolation=cv2.INTER_AREA), [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY]
    )
    return encoded.tobytes(), size[0], size[1]


def _marks(
    found: Detections, adjusted: Adjusted | None, box: tuple[int, int, int, int]
) -> tuple[tuple[Mark, ...], float]:
    """Marks within the box, and by what factor their residuals are drawn."""
    x, y, w, h = box
    inside = np.flatnonzero(np.all((found.xy >= (x, y)) & (found.xy <= (x + w, y + h)), axis=1))
    factor, near = 0.0, np.full(len(inside), -1)
    if adjusted is not None and len(adjusted.xy) and len(inside):
        rms = float(np.sqrt(np.mean(np.sum(adjusted.residual**2, axis=1))))
        factor = float(f"{ARROW * w / max(rms, 1e-9):.1g}")
        distance, nearest = cKDTree(adjusted.xy).query(found.xy[inside])
        near = np.where(distance < SAME, nearest, -1)
    marks = []
    for i, k in zip(inside, near, strict=True):
        name, residual = str(found.code[i]) if found.code[i] >= 0 else "", None
        if adjusted is not None and k >= 0:
            name, residual = adjusted.names[k], adjusted.residual[k]
        kind = "code" if found.code[i] >= 0 else "ring" if found.code_state[i] == CodeState.UNREADABLE else "dot"
        marks.append(_mark(found, int(i), name, kind, residual, factor))
    return tuple(marks), factor


def _mark(found: Detections, i: int, name: str, kind: str, residual: Array | None, factor: float) -> Mark:
    px, py = (float(v) for v in found.xy[i])
    a, b = (float(v) for v in found.semi_axes[i])
    sigma = float(np.sqrt(np.trace(found.covariance[i]) / 2))
    told = [f"target {name}" if name else "no id", f"at {px:.2f}, {py:.2f} px, sigma {number(sigma, 2)} px"]
    told.append(f"semi-axes {a:.1f}, {b:.1f} px")
    if found.saturated[i]:
        told.append("saturated")
    if residual is None:
        told.append("not used in the adjustment")
        return Mark(px, py, a, b, float(np.degrees(found.angle[i])), name, kind, "; ".join(told))
    told.append(f"residual {residual[0]:+.3f}, {residual[1]:+.3f} px")
    tip = (px + factor * float(residual[0]), py + factor * float(residual[1]))
    return Mark(px, py, a, b, float(np.degrees(found.angle[i])), name, kind, "; ".join(told), tip)


def _refused(found: Detections, box: tuple[int, int, int, int]) -> tuple[tuple[float, float], ...]:
    x, y, w, h = box
    xy = found.rejected.xy
    xy = xy[np.all((xy >= (x, y)) & (xy <= (x + w, y + h)), axis=1)] if len(xy) else xy
    return tuple((float(u), float(v)) for u, v in xy[:MOST_REFUSED])


def _caption(entry: ImageEntry, found: Detections, adjusted: Adjusted | None, why: str, magnified: float) -> str:
    told = f"{entry.source}, {entry.name} ({why}): {len(found)} targets, {int(np.sum(found.code >= 0))} codes"
    if adjusted is not None and len(adjusted.xy):
        rms = float(np.sqrt(np.mean(adjusted.residual**2)))
        told += f", {len(adjusted.xy)} used, residuals {number(rms, 2)} px RMS (drawn x {magnified:g})"
    refused = sorted(found.rejected.counts.items(), key=lambda item: -item[1])[:3]
    if refused:
        # the examples in brackets belong to the table of reasons, not under every picture
        told += "; refused: " + ", ".join(f"{count} {str(reason).split(' (')[0]}" for reason, count in refused)
    return told
