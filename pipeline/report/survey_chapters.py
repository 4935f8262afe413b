"""Chapters: the survey's numbers, and all networks in space."""

import numpy as np

from pipeline.report import projection_map
from pipeline.report.blocks import Block, Chapter, Figure, Table, Text, table
from pipeline.report.material import Material
from pipeline.report.style import ACCENT, AFTER, BEFORE, CATEGORIES, GREEN, GREY, label, number, rounded, scene, trace
from robcal.calibration.measurements import Rows
from robcal.photogrammetry.core.camera import INTRINSIC_NAMES, Camera
from robcal.photogrammetry.core.network import CameraNetwork, LengthResult
from robcal.photogrammetry.station.network import StationOrientation
from robcal.photogrammetry.survey.types import SurveyResult
from robcal.transforms import Array, invert

ASKED = 35
"""Lengths that VDI/VDE 2634 part 1 asks for: seven lines with five each."""


def survey_chapter(material: Material) -> Chapter:
    """Numbers of every surveyed body and of the station's cameras."""
    blocks: list[Block] = []
    for name, survey in material.surveys.items():
        blocks += _survey(name, survey)
    if material.station is not None:
        blocks += _station(material.station)
    return Chapter(
        "survey",
        "Survey and cameras",
        "Bundle adjustments with their own check: known lengths that took no part, redundancy, and correlations.",
        tuple(blocks),
    )


def _survey(name: str, survey: SurveyResult) -> list[Block]:
    n = survey.network
    sigma = np.asarray(n.points_sigma) * 1e3
    rows = [
        ["images", str(len(n.image_names)), f"{len(survey.unused_images)} not used"],
        ["targets", str(len(n.ids)), f"{len(survey.unseen_ids)} listed but not seen, {len(survey.new_ids)} new"],
        ["marks", str(len(n.marks)), f"{len(n.rejected)} rejected"],
        ["sigma0", number(n.sigma0), f"{number(n.sigma0_px)} px a coordinate"],
        ["redundancy", str(n.redundancy_total), f"weakest mark {np.min(n.redundancy):.2f}" if len(n.marks) else ""],
        ["rank", str(n.rank), f"of {n.unknowns} unknowns, the datum adds the rest; condition {n.condition:.1e}"],
        ["sigma of a target (mm)", number(np.sqrt(np.mean(sigma**2))), f"largest {number(np.max(sigma))}"],
        ["datum", n.datum, survey.frame],
        ["scale", survey.scale, ""],
        ["engine", survey.engine, f"{n.summary.iterations} iterations"],
    ]
    blocks: list[Block] = [table([f"Survey of {name}", "Value", ""], rows, text=(0, 1, 2))]
    blocks += _lengths([*n.check_lengths, *n.scale_bars])
    interior = np.sqrt(np.clip(np.diag(n.intrinsics_covariance), 0, None))
    blocks.append(_interior({f"survey of {name}": (n.camera, interior)}))
    blocks += projection_map.of_survey(name, n)
    if n.correlations:
        pairs = [[c.first, c.second, f"{c.value:+.3f}"] for c in sorted(n.correlations, key=lambda c: -abs(c.value))]
        blocks.append(
            table(
                ["Unknown", "Hard to tell from", "Correlation"], pairs, "Correlations above 0.95.", text=(0, 1), shown=8
            )
        )
    if any(d > 1e-9 for _, d in survey.deviations):
        worst = sorted(survey.deviations, key=lambda d: -d[1])[:5]
        text = ", ".join(f"{number(d * 1e3)} mm at target {i}" for i, d in worst)
        blocks.append(Text(f"Given coordinates against surveyed ones after the fit; largest deviations: {text}."))
    return blocks


def _lengths(lengths: list[LengthResult]) -> list[Block]:
    if not lengths:
        return []
    rows = [
        [
            "check length" if c.kind == "check" else "scale bar",
            f"{c.ids[0]} – {c.ids[1]}",
            f"{c.expected * 1e3:.3f}",
            f"{c.error * 1e3:+.4f}",
            number(c.sigma * 1e3, 2) if c.sigma > 0 else "–",
            f"{c.w:+.1f}" if c.sigma > 0 else "–",
        ]
        for c in lengths
    ]
    checks = [abs(c.error) * 1e3 for c in lengths if c.kind == "check"]
    word = (
        f"Length measurement error E after VDI/VDE 2634-1: {number(max(checks))} mm over {len(checks)} check lengths."
        if checks
        else "There are no check lengths: give some to have the scale verified after VDI/VDE 2634-1."
    )
    if checks and len(checks) < ASKED:
        word += f" The guideline asks for seven lines of five lengths ({ASKED}): E is told by these alone."
    return [
        table(
            ["Length", "Targets", "Known (mm)", "Error (mm)", "Sigma (mm)", "Error / sigma"],
            rows,
            word,
            text=(0, 1),
            shown=20,
        )
    ]


def _station(station: StationOrientation) -> list[Block]:
    rows = []
    for c, name in enumerate(station.names):
        marks = int(np.sum(station.marks.camera == c))
        epochs = int(np.sum(station.exterior_camera == c))
        refined = ", ".join(station.free_interior.get(name, ())) or "–"
        rows.append(
            [
                name,
                str(marks),
                number(station.noise.get(name)),
                refined,
                "stood still" if epochs == 1 else f"moved {epochs - 1} times",
            ]
        )
    message = (
        f"Station: {len(station.poses)} poses, redundancy {station.redundancy_total:.0f}, "
        f"sigma0 {number(station.sigma0)}, residuals {number(station.rms_px)} px RMS."
    )
    blocks: list[Block] = [
        table(["Camera", "Marks", "Scatter / stated", "Refined", "Stand"], rows, message, text=(0, 3, 4))
    ]
    sigmas = {
        name: (camera, np.sqrt(np.clip(np.diag(station.camera_covariance(name)[1]), 0, None)))
        for name, camera in zip(station.names, station.cameras, strict=True)
    }
    blocks.append(_interior(sigmas))
    blocks += projection_map.of_station(station)
    return blocks


def _interior(cameras: dict[str, tuple[Camera, Array]]) -> Table:
    rows: list[list[str]] = []
    for k, name in enumerate(INTRINSIC_NAMES):
        row = [f"{name} (px)" if k < 4 else name]
        for camera, sigma in cameras.values():
            value, s = float(getattr(camera, name)), float(sigma[k])
            row += [f"{value:.3f}" if k < 4 else f"{value:.6f}", number(s, 2) if s > 0 else "held"]
        rows.append(row)
    columns = ["Interior orientation", *(c for name in cameras for c in (name, "sigma"))]
    return table(columns, rows, "OpenCV's convention, centre of the first pixel at (0, 0).")


def network_chapter(material: Material) -> Chapter:
    """Cameras, targets and poses in space."""
    blocks: list[Block] = [_network(name, s.network) for name, s in material.surveys.items()]
    frames = material.frames
    if material.station is not None:
        blocks.append(_station_scene(material.station, material))
    elif frames is not None and len(frames.pose):
        blocks.append(_poses_scene(frames.world_T_body, frames.pose, material))
    return Chapter("network", "The network in space", "Drag to turn, scroll to come nearer.", tuple(blocks))


def _camera_lines(world_T_camera: Array, size: float) -> tuple[list[float | None], ...]:
    """Outlines of pyramids for cameras (n, 4, 4), in one broken line."""
    s = size
    corners = s * np.array([[-1, -0.75, 1.5], [1, -0.75, 1.5], [1, 0.75, 1.5], [-1, 0.75, 1.5]])
    path = [None, 0, 1, None, 2, 3, None, 0, 3, 2, 1, 0]
    out: tuple[list[float | None], ...] = ([], [], [])
    for T in world_T_camera:
        tip = T[:3, 3]
        outline = corners @ T[:3, :3].T + tip
        for at in path:
            p = tip if at is None else outline[at]
            for axis, line in enumerate(out):
                line.append(float(f"{p[axis]:.5g}"))
        for line in out:
            line.append(None)
    return out


def _lines(xyz: tuple[list[float | None], ...], name: str, colour: str, width: int = 2) -> dict[str, object]:
    return trace(
        "scatter3d lines", (xyz[0], xyz[1], xyz[2]), name, line={"color": colour, "width": width}, hoverinfo="skip"
    )


def _dots(
    points: Array, text: list[str], name: str, colour: str, size: float = 3, poses: Rows | tuple[()] = ()
) -> dict[str, object]:
    return trace(
        "scatter3d markers",
        (rounded(points[:, 0], 6), rounded(points[:, 1], 6), rounded(points[:, 2], 6)),
        name,
        text=[label(t) for t in text],
        marker={"size": size, "color": colour},
        customdata=[int(p) for p in poses],
        hovertemplate="%{text}<extra>" + label(name) + "</extra>",
    )


def _network(name: str, network: CameraNetwork) -> Figure:
    body_T_camera = invert(network.camera_T_body)
    extent = float(np.max(np.linalg.norm(network.points - network.points.mean(axis=0), axis=1)))
    sigma = np.asarray(network.points_sigma) * 1e6
    sigma = sigma if sigma.ndim == 1 else np.linalg.norm(sigma, axis=1)
    seen = [f"target {i}, sigma {s:.1f} µm" for i, s in zip(network.ids, sigma, strict=True)]
    data = (
        _dots(network.points, seen, "targets", ACCENT, 4),
        _lines(_camera_lines(body_T_camera, 0.06 * extent), "cameras", AFTER),
        _dots(body_T_camera[:, :3, 3], list(network.image_names), "camera positions", AFTER, 2.5),
    )
    message = f"Survey of {name}: {len(network.image_names)} photographs, {len(network.ids)} targets."
    return Figure(data, scene(data), message, "Cameras and targets of the survey in space", height=480)


def _station_scene(station: StationOrientation, material: Material) -> Figure:
    centres = station.world_T_body[:, :3, 3]
    world_T_camera = station.world_T_exterior
    extent = float(np.median(np.linalg.norm(centres - world_T_camera[0][:3, 3], axis=1)))
    data = [
        _lines(
            _camera_lines(world_T_camera[station.exterior_camera == c], 0.06 * extent),
            f"camera {name}",
            CATEGORIES[c % len(CATEGORIES)],
            4,
        )
        for c, name in enumerate(map(label, station.names))
    ]
    body = station.body.points[station.body.known] if hasattr(station.body, "known") else station.body.points
    targets = (body @ np.swapaxes(station.world_T_body[:, :3, :3], 1, 2) + centres[:, None]).reshape(-1, 3)
    per_pose = np.repeat(station.poses, len(body))
    data.append(_dots(targets, [""] * len(targets), "targets in all poses", GREY, 1.5, per_pose))
    names = [material.pose_name(int(p)) for p in station.poses]
    data.append(_dots(centres, names, "measured poses", GREEN, 3, station.poses))
    # the cameras' own upward direction, or the robot's where it is known
    up = -world_T_camera[0][:3, 1]
    if material.calibrated is not None and material.calibrated.model.world_T_base is not None:
        up = np.asarray(material.calibrated.model.world_T_base)[:3, 2]
    return Figure(
        tuple(data),
        scene(data, up),
        "The station: cameras, and the body's place in every pose.",
        "Station cameras and measured poses in space",
        height=520,
    )


def _poses_scene(frames: Array, poses: Rows, material: Material) -> Figure:
    centres = frames[:, :3, 3]
    size = 0.06 * float(np.max(np.ptp(centres, axis=0), initial=1e-3))
    names = [material.pose_name(int(p)) for p in poses]
    data = [_dots(centres, names, "measured poses", AFTER, 3, poses)]
    for k, colour in enumerate((ACCENT, GREEN, BEFORE)):
        ends = centres + size * frames[:, :3, k]
        line: tuple[list[float | None], ...] = tuple(
            [v for a, b in zip(rounded(centres[:, i], 6), rounded(ends[:, i], 6), strict=True) for v in (a, b, None)]
            for i in range(3)
        )
        data.append(_lines(line, f"{'xyz'[k]} axis", colour, 3))
    return Figure(
        tuple(data),
        scene(data),
        "The body's measured poses in the measuring system.",
        "Measured poses in space",
        height=480,
    )
