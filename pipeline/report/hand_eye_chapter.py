"""Chapter: a camera in the hand or beside the robot, how well it is known, image by image."""

import numpy as np

from pipeline.artifacts import HAND_EYE
from pipeline.report.blocks import Block, Chapter, Figure, KeyFigure, Text, Verdict, table
from pipeline.report.material import Material
from pipeline.report.style import ACCENT, AFTER, GREY, layout, number, rounded, trace
from pipeline.stages.hand_eye import HandEyeRun, frames_of
from robcal.files.hand_eye_files import SCALE, in_ros
from robcal.files.ros_files import static_transform
from robcal.handeye.motion import turns
from robcal.transforms import xyzrpy_from_frame

_GOOD, _CARE = 1.0, 5.0
"""mm at kept-out images up to which a calibration is called good, and usable."""


def hand_eye_chapter(material: Material) -> Chapter:
    """Camera and board, errors image by image, images over the sensor, what to load."""
    kept = material.find(HAND_EYE)
    blocks: list[Block] = []
    if kept is not None:
        blocks += [Text(_lead(kept), "lead"), _frames(kept), _errors(kept), _arrows(kept), _numbers(kept)]
        if kept.found.rejected:
            rows = [[kept.poses[r.image], r.reason.format(*kept.poses)] for r in kept.found.rejected]
            blocks.append(table(["Image left out", "Why"], rows, text=(0, 1)))
        blocks.append(
            Text("To load: " + static_transform(in_ros(frames_of(kept.found)[0], material_camera(material))), "note")
        )
    return Chapter("hand-eye", "Hand-eye calibration", "", tuple(blocks))


def material_camera(material: Material) -> str:
    """Name of the camera."""
    return str(material.result.get("hand_eye", {}).get("camera", "camera"))


def hand_eye_verdict(material: Material, kept: HandEyeRun) -> Verdict:
    """The top of the report for a campaign whose result is a hand-eye calibration."""
    found = kept.found
    held, sigma = found.heldout, found.sigma * np.tile(SCALE, 2)
    mm = float("nan") if held is None else held.mm
    grade = "good" if mm <= _GOOD else "care" if mm <= _CARE else "bad"
    word = {"good": "Good", "care": "Usable, with care", "bad": "Not usable"}[grade]
    where = "flange" if found.mounted == "hand" else "base"
    place = number(float(np.linalg.norm(sigma[:3])))
    turn = number(float(np.linalg.norm(sigma[3:6])))
    sentence = f"The camera's place at the {where} is known to {place} mm, its direction to {turn} degrees (1 sigma)."
    reason = "No image was kept out." if held is None else _kept_out(kept)
    keys = [
        KeyFigure(place, "mm", "Sigma of the camera's place", f"at the {where}"),
        KeyFigure(turn, "deg", "Sigma of its direction", ""),
        KeyFigure(number(found.variances.place * 1e3), "mm", "Robot's misses", "a coordinate, from pose to pose"),
    ]
    if held is not None:
        keys.insert(2, KeyFigure(number(held.mm), "mm", "Miss at the board", f"{number(held.px)} px, kept-out images"))
    load = "hand_eye/ (ROS, URDF, OpenCV, matrices) and cameras/*.yaml."
    told = str((material.diagnosis or {}).get("statement", ""))
    return Verdict(grade, word, sentence, reason, load, told, tuple(keys))  # type: ignore[arg-type]


def _kept_out(kept: HandEyeRun) -> str:
    held = kept.found.heldout
    assert held is not None
    how = "each image in turn kept out" if held.folds else f"{held.images} images kept out"
    return f"With {how}, the board is seen {number(held.mm)} mm ({number(held.px)} px, RMS) from where it is predicted."


def _lead(kept: HandEyeRun) -> str:
    found = kept.found
    size, _ = turns(kept.data.base_T_flange[found.used])
    text = (
        f"{int(found.used.sum())} images with {int(found.marks.sum())} marks; the flange turns by "
        f"{np.degrees(size[0]):.0f}, {np.degrees(size[1]):.0f} and {np.degrees(size[2]):.0f} degrees about three "
        "directions. "
    )
    if found.variances.place > 0:
        text += (
            f"The robot misses where it was commanded to be by {number(found.variances.place * 1e3)} mm and "
            f"{number(np.degrees(found.variances.turn))} degrees a coordinate from pose to pose; that is in all sigmas."
        )
    else:
        text += "No miss of the robot shows beyond the noise of the marks."
    return text


def _frames(kept: HandEyeRun) -> Block:
    rows = []
    for f in frames_of(kept.found):
        six = xyzrpy_from_frame(f.T) * SCALE
        sigma = np.sqrt(np.diag(f.covariance)) * SCALE
        for part, unit in ((slice(0, 3), "mm"), (slice(3, 6), "deg")):
            shown = [f"{v:.4f}" for v in six[part]]
            rows.append([f.name, f"{'x, y, z' if unit == 'mm' else 'roll, pitch, yaw'} ({unit})", *shown])
            rows.append(["", "sigma along its axes", *(number(float(v)) for v in sigma[part])])
    return table(["Frame", "", "", "", ""], rows, text=(0, 1))


def _errors(kept: HandEyeRun) -> Figure:
    found = kept.found
    order = np.flatnonzero(np.isfinite(found.image_px))
    data = []
    for name, which, colour in (("used", found.used, AFTER), ("left out", ~found.used, ACCENT)):
        rows = order[which[order]]
        if len(rows):
            bars = ([kept.poses[i] for i in rows], rounded(found.image_px[rows]))
            data.append(trace("bar", bars, name, marker={"color": colour}))
    return Figure(
        tuple(data),
        layout("pose", "miss of the marks (px)"),
        "Root mean square distance of each image's marks from where robot and calibration put them; the robot's misses "
        "are in it, so they are larger than the noise of a mark.",
        "Bars of the error of every image",
    )


def _arrows(kept: HandEyeRun) -> Figure:
    """Residuals over the sensor, enlarged, with the robot's misses taken out: what the lens model leaves."""
    found, data = kept.found, kept.data
    rows = np.flatnonzero(found.marks)
    if len(rows) > 1500:
        rows = rows[np.linspace(0, len(rows) - 1, 1500).astype(int)]
    r = found.residuals[rows]
    longest = float(np.percentile(np.linalg.norm(r, axis=1), 95)) if len(rows) else 1.0
    factor = 0.03 * data.camera.width / max(longest, 1e-9)
    ends = data.xy[rows] + factor * r
    gap = np.full(len(rows), np.nan)
    x, y = (np.column_stack([data.xy[rows, k], ends[:, k], gap]).ravel() for k in range(2))
    lines = trace("scatter", (_gaps(x), _gaps(y)), "residual", mode="lines", line={"color": AFTER, "width": 1})
    plan = layout("x (px)", "y (px)", showlegend=False)
    plan["yaxis"] = {**plan.get("yaxis", {}), "autorange": "reversed", "scaleanchor": "x"}
    frame = {
        "type": "rect",
        "x0": 0,
        "y0": 0,
        "x1": data.camera.width,
        "y1": data.camera.height,
        "line": {"color": GREY, "width": 1},
    }
    plan["shapes"] = [*plan.get("shapes", []), frame]
    return Figure(
        (lines,),
        plan,
        f"Residuals of the marks over the sensor, {number(factor)} times enlarged: even in all directions where the "
        "lens model is right; corners without marks are not tested.",
        "Residual vectors over the image",
        height=460,
    )


def _gaps(values: np.ndarray) -> list[float | None]:
    return [None if not np.isfinite(v) else round(float(v), 2) for v in values]


def _numbers(kept: HandEyeRun) -> Block:
    found = kept.found
    rows = [
        [n, f"{v:.6g}", number(found.camera_sigma.get(n, float("nan"))) if n in found.camera_sigma else "held"]
        for n, v in zip(found.camera.names, found.camera.vector.tolist(), strict=True)
    ]
    for name, value in found.shape.items():
        unit = "" if name == "scale" else " (1/m)"
        rows.append([f"board: {name}{unit}", f"{value:.5g}", number(found.shape_sigma[name])])
    for name, value, variance in zip(found.robot_names, found.robot, np.diag(found.robot_covariance), strict=True):
        factor, unit = (1e3, "mm") if name.rsplit(".", 1)[1] in "xyz" else (180 / np.pi, "deg")
        rows.append([f"{name} ({unit})", f"{factor * value:.4g}", number(factor * float(np.sqrt(variance)))])
    return table(["Camera, board, robot", "Value", "Sigma"], rows)
