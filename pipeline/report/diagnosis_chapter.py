"""Chapter: what the model left out, how it is known, and what would settle what is open."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from pipeline.report.blocks import Block, Chapter, Figure, Table, Text, table
from pipeline.report.evidence_plots import evidence_figure
from pipeline.report.image_cause_plots import gains_figure, lens_figure
from pipeline.report.material import Material
from pipeline.report.robot_plot import robot_figure
from pipeline.report.style import (
    AFTER,
    BEFORE,
    GREY,
    label,
    layout,
    level_line,
    number,
    percent,
    probability,
    rounded,
    to_sigma,
    trace,
)
from robcal.calibration.observations import PointObservations
from robcal.photogrammetry.core.camera import Camera
from robcal.photogrammetry.station.contradictions import LENS_RADIAL
from robcal.physics.library import words_of
from robcal.transforms import Array

LEVEL = 0.01
LONGEST_FORMULA = 100
LAWS = {"gaussian_process": "smooth law", "spline": "smooth law", "harmonic": "harmonics"}


def diagnosis_chapter(material: Material) -> Chapter:
    """The statement, one part for every cause, the gain, what is left, what to measure next."""
    blocks: list[Block] = []
    d = material.diagnosis
    if d is not None:
        causes = d.get("causes", [])
        blocks.append(Text(short_statement(d), "lead"))
        blocks.append(Text(_how_sure(d)))
        if causes:
            blocks.append(_causes(causes))
        blocks += _plots(material, causes)
        gain = _gain(material, d)
        blocks += gain
        for cause in causes:
            blocks += _rivals(cause)
        blocks += _next_poses(d.get("next_poses") or [])
    return Chapter("diagnosis", "What the model left out", "", tuple(blocks))


def short_statement(d: Mapping[str, Any], most: int = 3) -> str:
    """The statement of a diagnosis; of many causes the first ones."""
    causes = d.get("causes") or []
    if len(causes) <= most:
        return str(d.get("statement") or "")
    message = ". ".join(str(c.get("statement") or said(c.get("cause"))) for c in causes[:most])
    return f"{message}. And {len(causes) - most} more, see below."


def said(name: object) -> str:
    """A cause's name in words."""
    return words_of(str(name))


def _how_sure(d: Mapping[str, Any]) -> str:
    p = d.get("p_value")
    if d.get("mismatch"):
        text = (
            f"Were nothing missing, data like these would come with probability {probability(p)}; every candidate of "
            "the library at every place was tried and the level holds for all of them together."
        )
    else:
        text = (
            "Every candidate of the library at every place was tried; the strongest of them is as strong as chance "
            f"alone makes it with probability {probability(p)}. Nothing was added to the model."
        )
    noise = d.get("noise") or {}
    factor = noise.get("estimated")
    if factor is not None:
        text += f" The data scatter {number(factor)} times what their covariance says"
        text += "; that alone is no mismatch." if not 0.85 < float(factor) < 1.15 else "."
    repeat = noise.get("joint_repeatability_deg")
    if repeat:
        text += f" The joints repeat to {number(repeat, 2)} deg, which was estimated and taken into account."
    left = (d.get("unexplained") or {}).get("p_value")
    if left is not None and d.get("mismatch"):
        pattern = (d.get("unexplained") or {}).get("pattern")
        text += (
            f" After that nothing significant is left (p = {probability(left)})."
            if left > LEVEL
            else f" Something stays unexplained (p = {probability(left)}{', ' + str(pattern) if pattern else ''})."
        )
    if d.get("blunders"):
        text += f" {len(d['blunders'])} observations are gross errors and took no part."
    return text


def _causes(causes: list[dict[str, Any]]) -> Table:
    rows = []
    for k, c in enumerate(causes, 1):
        sigma = c.get("sigma") or {}
        numbers = "; ".join(_parameter(n, v, sigma.get(n)) for n, v in (c.get("parameters") or {}).items())
        held = c.get("heldout_mm") or c.get("heldout_px") or {}
        unit = "mm" if c.get("heldout_mm") else "px"
        place = f"{c.get('where')}" + (f", direction {c['direction']}" if c.get("direction") else "")
        change = f"{number(held.get('before'))} → {number(held.get('after'))} {unit}" if held else "–"
        explained = _share(c.get("explained"))
        force = "–" if c.get("in_force") is None else "yes" if c["in_force"] else f"no: {c['in_force_reason']}"
        rows.append([k, said(c.get("cause")), place, numbers, probability(c.get("p_value")), explained, change, force])
    return table(
        ["", "Cause", "Where", "Parameters ± sigma", "p", "Explains", "Error on kept-out data", "In force"],
        rows,
        "In the order in which they were accepted, each beside those before it and with all that the recording knows "
        "(approach directions, times); the delivered robot has those that are in force.",
        text=(0, 1, 2, 3, 7),
    )


def _parameter(name: str, value: Any, sigma: Any) -> str:
    unit = ""
    shown = name
    for suffix, message in (
        ("_deg_per_kNm3", "deg/kNm³"),
        ("_deg_per_kNm", "deg/kNm"),
        ("_um_per_m_K", "µm/(m K)"),
        ("um_per_m_K", "µm/(m K)"),
        ("_deg", "deg"),
        ("_mm", "mm"),
        ("_Nm", "N m"),
        ("_kg", "kg"),
        ("_ppm", "ppm"),
        ("_px", "px"),
    ):
        if name.endswith(suffix) and name != suffix:
            shown, unit = name.removesuffix(suffix).replace("_", " ") or "amount", f" {message}"
            break
    if isinstance(value, dict):
        formula = str(value.get("formula") or value.get("kind") or value)
        if len(formula) <= LONGEST_FORMULA:
            return f"{shown}: {formula}"
        variables = ", ".join(map(str, value.get("variables") or ()))
        return f"{LAWS.get(str(value.get('kind')), 'law')} of {variables} (formula in diagnosis.json)"
    if isinstance(value, list):
        spread = sigma if isinstance(sigma, list) else [None] * len(value)
        return f"{shown} " + ", ".join(_with_sigma(v, s) for v, s in zip(value, spread, strict=False)) + unit
    return f"{shown} {_with_sigma(value, sigma)}{unit}"


def _with_sigma(value: Any, sigma: Any) -> str:
    if isinstance(value, str) or not sigma:
        return number(value)
    return f"{to_sigma(float(value), float(sigma))} ± {number(sigma, 2)}"


def _plots(material: Material, causes: list[dict[str, Any]]) -> list[Block]:
    blocks: list[Block] = []
    evidence = material.evidence
    poses = {name: row for row, name in enumerate(material.all_poses)}
    for one in evidence.causes if evidence else ():
        blocks.append(evidence_figure(one, said(one.cause), poses))
    blocks += _image_plots(material, causes)
    robot_causes = [c for c in causes if c.get("stage") in ("robot", "body", "sensor", "wire", "camera")]
    if material.calibrated is not None and robot_causes:
        figure = robot_figure(material, robot_causes)
        blocks += [figure] if figure is not None else []
    return blocks


def _image_plots(material: Material, causes: list[dict[str, Any]]) -> list[Block]:
    """The lens' curve where radial distortion was found; what each gains where there are several."""
    blocks: list[Block] = []
    lenses = {str(c.get("where")) for c in causes if c.get("cause") == LENS_RADIAL.name}
    for name, (camera, covariance, marks) in _cameras(material).items():
        if name in lenses:
            blocks.append(lens_figure(f"camera {name}", camera, covariance, marks))
    d = material.diagnosis or {}
    for key in ("heldout_px", "heldout_mm"):
        mine = [c for c in causes if c.get(key)]
        if len(mine) > 1 or (mine and key == "heldout_px"):
            names = [f"{said(c.get('cause'))}, {c.get('where')}" for c in mine]
            figure = gains_figure(mine, names, key, (d.get(key) or {}).get("noise_floor"))
            blocks += [figure] if figure is not None else []
    return blocks


def _cameras(material: Material) -> dict[str, tuple[Camera, Any, Array]]:
    """Adjusted cameras with the covariance of their interior orientation and their marks (n, 2) in pixels.

    By the names the diagnosis gives them.
    """
    out: dict[str, tuple[Camera, Any, Array]] = {}
    for name, survey in material.surveys.items():
        known = material.campaign.bodies.get(name) if material.campaign is not None else None
        source = known.survey if known is not None else None
        path = source.start_path if source is not None else None
        network = survey.network
        out[path.stem if path is not None else f"survey_{name}"] = (
            network.camera,
            network.intrinsics_covariance,
            network.marks.xy,
        )
    if material.station is not None:
        marks = material.station.marks
        for c, (name, camera) in enumerate(zip(material.station.names, material.station.cameras, strict=True)):
            out[name] = (camera, material.station.camera_covariance(name)[1], marks.xy[marks.camera == c])
    return out


def _gain(material: Material, d: Mapping[str, Any]) -> list[Block]:
    held, unit = (d.get("heldout_mm"), "mm") if d.get("heldout_mm") else (d.get("heldout_px"), "px")
    if not held:
        return []
    kept = "kept-out poses" if held.get("kind") == "verify" else "blocks of poses kept out in turn"
    kept = "marks, each predicted without itself," if unit == "px" else kept
    floor = held.get("noise_floor")
    before, after = number(held.get("before")), number(held.get("after"))
    what = "error of single measured points" if unit == "mm" and _on_points(material) else "error"
    same = _same(held)  # what was found lies in the images, and the measured poses are freed of it already
    text = f"On {kept} the {what} is {before} {unit} (RMS)" + ("" if same else f" before and {after} after")
    text += f"; the noise of the measurement alone gives {number(floor)} {unit}." if floor else "."
    region = held.get("region")
    if region and d.get("mismatch") and not same:
        text += (
            f" At one end of the measured space, predicted from all other poses, it is {number(region.get('before'))} "
            f"{unit} before and {number(region.get('after'))} after: what parameters absorb shows there first."
        )
    blocks: list[Block] = [Text(text)]
    evidence = material.evidence
    if evidence and d.get("mismatch") and len(evidence.poses) and not same:
        order = np.argsort(-evidence.before, kind="stable")[:80]
        names = [label(evidence.poses[i]) for i in order]
        data = tuple(
            trace("bar", (names, rounded(values[order] * 1e3)), name, marker={"color": colour})
            for name, values, colour in (("before", evidence.before, BEFORE), ("after", evidence.after, AFTER))
        )
        lines, notes = [], []
        if floor:
            lines.append(level_line("y", floor))
            notes.append(
                {
                    "xref": "paper",
                    "x": 1,
                    "y": floor,
                    "text": "noise",
                    "showarrow": False,
                    "yanchor": "bottom",
                    "xanchor": "right",
                    "font": {"color": GREY},
                }
            )
        blocks.append(
            Figure(
                data,
                layout(
                    "pose, the worst first",
                    "error (mm)",
                    barmode="group",
                    shapes=lines,
                    annotations=notes,
                    xaxis={"type": "category", "nticks": 24},
                ),
                f"What the diagnosis gains on {kept}: error of each pose with and without the causes found.",
                "Errors of kept-out poses before and after the diagnosis",
                height=300,
            )
        )
    return blocks


def _same(held: Mapping[str, Any]) -> bool:
    """Whether the errors before and after are equal."""
    before, after = held.get("before"), held.get("after")
    return before is not None and after is not None and abs(before - after) <= 1e-6 * abs(before)


def _on_points(material: Material) -> bool:
    """Whether the diagnosis worked on single points; the verification tells of whole poses, whose noise is less."""
    found = material.identification
    return found is not None and any(isinstance(o, PointObservations) for o in found.recording.detailed)


def _rivals(cause: Mapping[str, Any]) -> list[Block]:
    rivals = cause.get("indistinguishable_from") or []
    if not rivals:
        return []
    rows = [[said(r.get("cause")), str(r.get("where")), r.get("direction") or ""] for r in rivals]
    columns = ["Rival", "Where", "Direction"]
    message = f"These explain the recording (nearly) as well as {said(cause.get('cause'))} at {cause.get('where')}. "
    for key in ("probability", "overlap"):
        if any(r.get(key) is not None for r in rivals):
            columns.append(key.capitalize())
            rows = [[*row, _share(r.get(key))] for row, r in zip(rows, rivals, strict=True)]
    if "Overlap" in columns:
        message += "Overlap is the share of its signature that the rival can reproduce. "
    message += "Predictions within the measured range are the same, whichever it is."
    return [table(columns, rows, message, text=(0, 1, 2))]


def _share(value: Any) -> str:
    return "–" if value is None else percent(float(value))


def _next_poses(rows: list[dict[str, Any]]) -> list[Block]:
    if not rows:
        return []
    columns = list(dict.fromkeys(key for row in rows for key in row))
    cells = [[number(v, 5) if isinstance(v, float) else v for v in (row.get(c, "") for c in columns)] for row in rows]
    return [table(columns, cells, "Poses that would separate the rivals best; as a table in next_poses.csv.", shown=8)]
