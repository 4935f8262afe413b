"""Chapter: the measured points and frames, judged by the lengths between the body's targets."""

import numpy as np

from pipeline.report.blocks import Block, Chapter, Figure, Text, table
from pipeline.report.material import Material
from pipeline.report.style import ACCENT, AFTER, layout, level_line, number, rounded, trace
from robcal.photogrammetry.measure.frames import MeasuredFrames, PairDeviations


def measurement_chapter(material: Material) -> Chapter:
    """Length deviations against tolerance, measured frames and their sigmas."""
    blocks: list[Block] = []
    frames, points = material.frames, material.points
    if frames is not None:
        if len(frames.pairs.pose):
            blocks.append(_lengths(frames.pairs))
        blocks.append(_numbers(frames, 0 if points is None else len(points.pose)))
        if frames.recurring.pairs or frames.recurring.scale_ppm is not None:
            blocks.append(Text(f"Recurring over the poses, evidence for the diagnosis: {frames.recurring.statement}"))
    return Chapter(
        "measurement",
        "Measured poses",
        "Each pose is accepted if the distances between its measured targets agree with those of the body.",
        tuple(blocks),
    )


def _lengths(pairs: PairDeviations) -> Figure:
    deviation = pairs.deviation * 1000
    limit = float(np.median(pairs.tolerance)) * 1000
    top = max(float(np.percentile(np.abs(deviation), 99.5)) * 1.15, limit * 1.15)
    edges = np.linspace(-top, top, 61)
    data: list[dict[str, object]] = []
    for name, which, colour in (("accepted", pairs.accepted, AFTER), ("rejected", ~pairs.accepted, ACCENT)):
        if not which.any():
            continue
        counts, _ = np.histogram(np.clip(deviation[which], -top, top), edges)
        data.append(
            trace(
                "bar",
                (rounded(0.5 * (edges[1:] + edges[:-1])), counts.tolist()),
                name,
                width=float(edges[1] - edges[0]),
                marker={"color": colour},
            )
        )
    lines = [level_line("x", x) for x in (-limit, limit)]
    beyond = int(np.sum(np.abs(deviation) > top))
    clipped = f" {beyond} beyond the plot are counted in the outermost bars." if beyond else ""
    return Figure(
        tuple(data),
        layout("measured minus expected length (mm)", "pairs of targets", barmode="stack", shapes=lines),
        f"Deviations of {len(deviation)} lengths. Dashed: tolerance of the median pair, {number(limit)} mm.{clipped}",
        "Histogram of length deviations with tolerance",
    )


def _numbers(frames: MeasuredFrames, points: int) -> Block:
    total = frames.covariance + frames.common_covariance
    own = np.sqrt(np.trace(frames.covariance[:, :3, :3], axis1=1, axis2=2) / 3) * 1e3
    both = np.sqrt(np.trace(total[:, :3, :3], axis1=1, axis2=2) / 3) * 1e3
    turn = np.degrees(np.sqrt(np.trace(frames.covariance[:, 3:, 3:], axis1=1, axis2=2) / 3))
    methods = {m: frames.method.count(m) for m in dict.fromkeys(frames.method)}
    deviation = np.abs(frames.pairs.deviation) * 1000
    rows = [
        ["points measured", str(points), f"{len(frames.rejected_points)} rejected"],
        ["poses measured", str(len(frames.pose)), f"{len(frames.rejected_poses)} rejected"],
        ["method", ", ".join(f"{k}: {v}" for k, v in methods.items()), ""],
        [
            "length deviation (mm)",
            number(deviation.mean()) if len(deviation) else "–",
            f"largest {number(deviation.max())}" if len(deviation) else "",
        ],
        ["sigma of a position (mm)", number(np.median(own)), f"with what all poses share {number(np.median(both))}"],
        ["sigma of an orientation (deg)", number(np.median(turn)), ""],
        ["scatter of lengths / stated", number(frames.noise_factor), "one where the stated covariance holds"],
    ]
    return table(["Measured poses", "Value", ""], rows, text=(0, 2))
