"""Chapters: detected targets on sample images, and image residuals."""

import base64
from collections.abc import Mapping

import cv2
import numpy as np
from numpy.typing import NDArray

from pipeline.artifacts import detections
from pipeline.report.blocks import Block, Chapter, Figure, Picture, Pictures, table
from pipeline.report.material import Material
from pipeline.report.style import AFTER, GREY, label, layout, number, trace
from robcal.errors import RobcalError
from robcal.files.images import read_image
from robcal.imaging.detections import CodeState, Detections
from robcal.transforms import Array

WIDTH = 900
"""Width of the embedded pictures, px."""
MOST_ARROWS = 2500
JPEG_QUALITY = 78
_ORANGE, _BLUE, _VERMILION, _SKY = (0, 159, 230), (178, 114, 0), (0, 94, 213), (233, 180, 86)


def image_chapter(material: Material) -> Chapter:
    """Two sample images of every source with what was found in them."""
    blocks: list[Block] = []
    index = material.detections
    if index is not None:
        rows, pictures = [], []
        for source in dict.fromkeys(e.source for e in index.entries):
            entries = index.of(source)
            counts = np.array([e.targets for e in entries])
            rows.append(
                [
                    source,
                    str(len(entries)),
                    f"{entries[0].size[0]} x {entries[0].size[1]}",
                    f"{np.median(counts):.0f}",
                    str(int(counts.min())),
                    f"{np.median([e.codes for e in entries]):.0f}",
                    str(sum(e.saturated for e in entries)),
                    str(int(np.sum(counts == 0))),
                ]
            )
            order = np.argsort(counts, kind="stable")
            usual, poor = entries[int(order[len(order) // 2])], entries[int(order[0])]
            for entry, why in ((usual, "usual"), (poor, "fewest targets")):
                if why == "usual" or entry is not usual:
                    picture = _picture(material, entry, why)
                    pictures += [picture] if picture is not None else []
        blocks.append(
            table(
                [
                    "Images",
                    "Number",
                    "Size (px)",
                    "Targets (median)",
                    "fewest",
                    "Codes read (median)",
                    "Saturated targets",
                    "Empty",
                ],
                rows,
                text=(0, 2),
            )
        )
        if pictures:
            blocks.append(
                Pictures(
                    tuple(pictures),
                    "Blue: ellipse with a code read, and its id. Orange: dot without code. Light blue: a ring that "
                    "could not be read. Small vermilion crosses: candidates that were refused.",
                )
            )
    return Chapter("images", "Detected targets", "", tuple(blocks))


def _picture(material: Material, entry: object, why: str) -> Picture | None:
    """A sample image with its targets; None where the image or its detections are gone."""
    name, path, key, source = (getattr(entry, n) for n in ("name", "path", "key", "source"))
    campaign = material.campaign
    if campaign is not None and not path.is_file():
        return None
    try:
        grey = read_image(path)
        found = material.run.load(detections(key))
    except (RobcalError, OSError):
        return None
    jpeg, width, height = drawn(grey, found)
    told = f"{source}, {name} ({why}): {len(found)} targets, {int(np.sum(found.code >= 0))} codes"
    refused = sorted(found.rejected.counts.items(), key=lambda item: -item[1])[:3]
    if refused:
        # the examples in brackets belong to the table of reasons, not under every picture
        told += "; refused: " + ", ".join(f"{count} {str(reason).split(' (')[0]}" for reason, count in refused)
    return Picture(base64.b64encode(jpeg).decode("ascii"), told, width, height)


def drawn(grey: NDArray[np.uint8 | np.uint16], found: Detections, width: int = WIDTH) -> tuple[bytes, int, int]:
    """JPEG of an image with ellipses and ids, its width and height."""
    low, high = (float(v) for v in np.percentile(grey[::4, ::4], (1, 99.9)))
    bright = np.clip((grey.astype(np.float32) - low) * (235.0 / max(high - low, 1.0)), 0, 235).astype(np.uint8)
    scale = min(1.0, width / grey.shape[1])
    size = (max(1, round(grey.shape[1] * scale)), max(1, round(grey.shape[0] * scale)))
    canvas = cv2.cvtColor(cv2.resize(bright, size, interpolation=cv2.INTER_AREA), cv2.COLOR_GRAY2BGR)
    # sub-pixel drawing: OpenCV takes coordinates with four binary places
    for x, y in found.rejected.xy[:300]:
        at = (round((x + 0.5) * scale - 0.5), round((y + 0.5) * scale - 0.5))
        cv2.drawMarker(canvas, at, _VERMILION, cv2.MARKER_TILTED_CROSS, 4, 1)
    for i in range(len(found)):
        x, y = (found.xy[i] + 0.5) * scale - 0.5
        axes = np.maximum(found.semi_axes[i] * scale * 1.25, 3.0)
        read = found.code[i] >= 0
        colour = _BLUE if read else _SKY if found.code_state[i] == CodeState.UNREADABLE else _ORANGE
        cv2.ellipse(
            canvas,
            (round(x * 16), round(y * 16)),
            (round(axes[0] * 16), round(axes[1] * 16)),
            float(np.degrees(found.angle[i])),
            0,
            360,
            colour,
            2,
            cv2.LINE_AA,
            4,
        )
        if read:
            at = (round(x + axes[0] + 3), round(y - axes[1] - 2))
            for ink, thick in (((0, 0, 0), 3), ((255, 255, 255), 1)):
                text = str(int(found.code[i]))
                cv2.putText(canvas, text, at, cv2.FONT_HERSHEY_SIMPLEX, 0.5, ink, thick, cv2.LINE_AA)
    _, encoded = cv2.imencode(".jpg", canvas, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    return encoded.tobytes(), size[0], size[1]


def residual_chapter(material: Material) -> Chapter:
    """Residual vectors on the image plane of each camera."""
    blocks: list[Block] = []
    for name, survey in material.surveys.items():
        n = survey.network
        blocks.append(_vectors(f"survey of {name}", n.marks.xy, n.residuals, (n.camera.width, n.camera.height)))
    station = material.station
    if station is not None:
        pixels = np.linalg.solve(station.design.whitening, station.design.residual[..., None])[..., 0]
        for c, name in enumerate(station.names):
            mine = station.marks.camera == c
            camera = station.cameras[c]
            size = (camera.width, camera.height)
            blocks.append(
                _vectors(
                    f"camera {name}",
                    station.marks.xy[mine],
                    pixels[mine],
                    size,
                    station.poses[station.marks.pose[mine]],
                )
            )
    return Chapter(
        "residuals",
        "Image residuals",
        "Measured minus projected, drawn large. Vectors that point about at random are noise; vectors that run "
        "together over a region show something that the camera model does not know.",
        tuple(blocks),
    )


def _vectors(
    name: str, xy: Array, residual: Array, size: tuple[int, int], poses: NDArray[np.int64] | None = None
) -> Figure:
    rms = float(np.sqrt(np.mean(residual**2))) if len(residual) else 0.0
    length = 0.025 * max(size)
    factor = length / max(rms * 2.0, 1e-12)
    magnification = float(f"{factor:.1g}")
    rows = np.arange(len(xy))
    if len(rows) > MOST_ARROWS:
        rows = np.sort(np.random.default_rng(0).choice(rows, MOST_ARROWS, replace=False))
    tips = xy[rows] + magnification * residual[rows]
    centres, means, counts = _field(xy, residual, size)
    told = [f"{c} marks, mean {number(m[0], 2)}, {number(m[1], 2)} px" for c, m in zip(counts, means, strict=True)]
    data: tuple[Mapping[str, object], ...] = (
        trace(
            "scatter lines",
            _arrows(xy[rows], tips),
            f"residuals x {magnification:g}",
            line={"color": GREY, "width": 1},
            hoverinfo="skip" if poses is None else "none",
            customdata=[] if poses is None else np.repeat(poses[rows], 3).tolist(),
            opacity=0.55,
        ),
        trace(
            "scatter lines",
            _arrows(centres, centres + 2 * magnification * means),
            f"mean of a region x {2 * magnification:g}",
            line={"color": AFTER, "width": 3},
            hoverinfo="skip",
        ),
        {
            "type": "scatter",
            "mode": "markers",
            "x": centres[:, 0].tolist(),
            "y": centres[:, 1].tolist(),
            "text": told,
            "marker": {"size": 6, "color": AFTER},
            "showlegend": False,
            "hovertemplate": "%{text}<extra></extra>",
        },
    )
    shown = "" if len(rows) == len(xy) else f" ({len(rows)} of {len(xy)} drawn)"
    return Figure(
        data,
        layout(
            "x (px)",
            "y (px)",
            xaxis={"range": [0, size[0]], "constrain": "domain"},
            yaxis={"range": [size[1], 0], "scaleanchor": "x", "constrain": "domain"},
        ),
        f"{label(name)[:1].upper() + name[1:]}: {len(xy)} marks{shown}, {number(rms)} px RMS a coordinate.",
        f"Residual vectors of {name}",
        height=460,
        wide=False,
    )


def _arrows(starts: Array, tips: Array) -> tuple[list[float | None], list[float | None]]:
    """x and y of lines from starts to tips, with a gap after each."""
    ends = np.round(np.stack([starts, tips], axis=1), 1).tolist()
    x, y = ([v for pair in ends for v in (pair[0][k], pair[1][k], None)] for k in range(2))
    return x, y


def _field(xy: Array, residual: Array, size: tuple[int, int], across: int = 8) -> tuple[Array, Array, list[int]]:
    """Centres, mean residuals and numbers of marks of square regions with eight marks or more."""
    step = size[0] / across
    cell = np.floor(xy / step).astype(int)
    keys, inverse, counts = np.unique(cell, axis=0, return_inverse=True, return_counts=True)
    means = np.stack([np.bincount(inverse.ravel(), residual[:, k]) / counts for k in range(2)], axis=1)
    keep = counts >= 8
    return (keys[keep] + 0.5) * step, means[keep], [int(c) for c in counts[keep]]
