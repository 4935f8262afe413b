"""Chapters: detected targets on sample images, and image residuals."""

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from pipeline.detected_images import DetectionIndex, ImageEntry
from pipeline.report.blocks import Block, Chapter, Figure, Picture, Pictures, table
from pipeline.report.material import Material
from pipeline.report.seen_images import SeenImages
from pipeline.report.style import AFTER, GREY, label, layout, number, trace
from robcal.transforms import Array

MOST_ARROWS = 2500
MOST_EXTRA = 60
BUDGET = 2_400_000
"""Letters that pictures and their marks may take in the page."""


def image_chapter(material: Material) -> Chapter:
    """Two sample images of every source with what was found in them."""
    blocks: list[Block] = []
    index = material.detections
    if index is not None:
        rows = []
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
        pictures = _pictures(material, index)
        blocks += [pictures] if pictures is not None else []
    return Chapter("images", "Detected targets", "", tuple(blocks))


def _worst_poses(material: Material) -> list[int]:
    """Poses by their error where they were kept out, the worst first; then those with the worst residuals."""
    order: list[int] = []
    if material.verification is not None:
        v, rows = material.verification
        size = v.errors["0"]
        if len(size) == len(v.rows):
            order += [int(np.asarray(rows)[v.rows][i]) for i in np.argsort(-size, kind="stable")]
    station = material.station
    if station is not None:
        square = np.bincount(station.marks.pose, np.sum(station.w**2, axis=1), minlength=len(station.poses))
        count = np.maximum(np.bincount(station.marks.pose, minlength=len(station.poses)), 1)
        order += [int(station.poses[i]) for i in np.argsort(-square / count, kind="stable")]
    return list(dict.fromkeys(order))


def _pictures(material: Material, index: DetectionIndex) -> Pictures | None:
    """Samples of every source, and the images of the worst poses as far as the page may grow."""
    seen = SeenImages(material)
    sources = dict.fromkeys(e.source for e in index.entries)
    chosen = [(e, why, False) for source in sources for e, why in seen.samples(index.of(source))]
    known = {id(e) for e, _, _ in chosen}
    by_pose: dict[int, list[ImageEntry]] = {}
    for entry in index.entries:
        pose = seen.pose_of(entry)
        if pose is not None and id(entry) not in known:
            by_pose.setdefault(pose, []).append(entry)
    worst = [e for pose in _worst_poses(material) for e in by_pose.get(pose, ())][:MOST_EXTRA]
    pictures: list[Picture] = []
    left = BUDGET
    for entry, why, extra in [*chosen, *((e, "chosen pose", True) for e in worst)]:
        picture = seen.picture(entry, why, extra=extra) if left > 0 else None
        if picture is not None:
            left -= len(picture.jpeg_base64) + 300 * len(picture.marks)
            pictures.append(picture)
    if not pictures:
        return None
    more = sum(p.extra for p in pictures)
    told = (
        f" Choose a pose to see its images: those of the worst poses ({more} images) lie in this page." if more else ""
    )
    return Pictures(
        tuple(pictures),
        "Blue: ellipse with a code read, and its id. Orange: dot without code. Light blue: a ring that could not be "
        "read. Small vermilion crosses: candidates that were refused. Green: residuals (measured minus projected), "
        f"drawn large. Open a picture to read each mark.{told}",
    )


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
