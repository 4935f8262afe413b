"""Chapter: how good the calibrated robot is where it was not identified."""

from collections.abc import Mapping

import numpy as np

from pipeline.report.blocks import Block, Chapter, Figure, Table, Text, table
from pipeline.report.material import Material
from pipeline.report.style import (
    AFTER,
    BEFORE,
    PAPER,
    label,
    layout,
    level_line,
    linked,
    number,
    percent,
    probability,
    rounded,
    trace,
)
from robcal.calibration.identifiability import repetitions
from robcal.calibration.iso9283 import CYCLES, characteristics
from robcal.calibration.measurements import Rows
from robcal.calibration.observations import FrameObservations
from robcal.calibration.verification import TEST_VECTORS, Verification
from robcal.transforms import Array, skew


def noise_by_tool(material: Material) -> dict[str, float]:
    """Root mean square error (m) that the scatter of the measurement alone would show, by test vector.

    Empty without frames. What all poses share (place of the station, coordinates of the body) is no scatter.

    A point t of the tool is displaced by rho + omega x t (right perturbation); turning it into the world does not
    change its length.
    """
    found = material.verification
    if found is None or material.identification is None:
        return {}
    rows = found[1]
    recording = material.identification.recording
    # frames of the own station carry their own noise alone among the detailed observations
    alone = any(isinstance(o, FrameObservations) for o in recording.detailed)
    covariance = [
        o.covariance[np.isin(o.pose, rows)]
        for o in (recording.detailed if alone else recording.observations)
        if isinstance(o, FrameObservations)
    ]
    if not covariance or not len(C := np.concatenate(covariance)):
        return {}
    out = {}
    for name, vector in TEST_VECTORS.items():
        J = np.hstack([np.eye(3), -skew(np.array(vector))])
        out[name] = float(np.sqrt(np.mean(np.trace(J @ C @ J.T, axis1=1, axis2=2))))
    return out


def error_table(verification: Verification, noise: Mapping[str, float], *, full: bool) -> Table:
    """Errors before and after by tool; `full` with extremes and spread."""
    mm = 1000.0
    rows: list[list[object]] = []
    for name, after in verification.tools.items():
        before = verification.nominal[name] if verification.nominal else None
        place = _tool(name, verification)
        floor = number(noise[name] * mm) if name in noise else "–"
        if full:
            for message, errors in (("before", before), ("after", after)):
                if errors is not None:
                    kinds = (errors.mean, errors.min, errors.max, errors.std, errors.rms)
                    rows.append([place, message, *(number(v * mm) for v in kinds)])
            if name in noise:
                rows.append([place, "noise of the measurement alone", "", "", "", "", floor])
            continue
        pair = [
            (number(getattr(before, k) * mm) if before else "–", number(getattr(after, k) * mm))
            for k in ("mean", "max", "rms")
        ]
        rows.append([place, *(v for both in pair for v in both), floor])
    if full:
        return table(
            ["Error in mm at", "", "Mean", "Smallest", "Largest", "Spread", "RMS"], rows, text=(0, 1), emphasis=(2,)
        )
    pairs = [c for kind in ("Mean", "Largest", "RMS") for c in (f"{kind} before", "after")]
    columns = ["Error in mm at", *pairs, "noise (RMS)"]
    return table(columns, rows, emphasis=(2, 4, 6))


def _tool(name: str, verification: Verification) -> str:
    if len(verification.tools) == 1:
        return "the measured points"
    return "tool origin" if name == "0" else f"tool point {name} mm away"


def verification_chapter(material: Material) -> Chapter:
    """Errors on kept-out poses, ISO terms, and whether the stated uncertainties hold."""
    blocks: list[Block] = []
    found = material.verification
    if found is not None:
        verification = found[0]
        rows = np.asarray(found[1])[verification.rows]
        names = [material.pose_name(int(r)) for r in rows]
        noise = noise_by_tool(material)
        blocks += [error_table(verification, noise, full=True)]
        blocks += [_errors(verification, names, rows, tolerance_mm(material)), _histogram(verification, rows)]
        blocks.append(_pose_table(verification, names, rows))
        blocks += [_iso(verification)] if verification.iso is not None else []
        blocks += _repeated(material)
        blocks += [_calibration_of_uncertainty(verification, names, rows), Text(_calibration_words(verification))]
    return Chapter("verification", "Pose errors before and after", _lead(material), tuple(blocks))


def _lead(material: Material) -> str:
    if material.verification is None:
        return ""
    v = material.verification[0]
    how = (
        f"{v.poses} poses that took no part in the identification or in any choice"
        if v.kind == "verify-set"
        else f"{v.poses} poses, each predicted by a robot identified without it (cross-validation: the campaign keeps "
        "no pose out)"
    )
    return (
        f"Measured minus modelled place on {how}. Before: the nominal robot after the best fit of base and tool on the "
        "identification poses, so that only the robot itself is compared."
    )


def tolerance_mm(material: Material) -> float | None:
    """The tolerance that the run was judged by."""
    tolerance = (material.result.get("verdict") or {}).get("tolerance")
    return None if tolerance is None else float(tolerance["tolerance_mm"])


def _errors(v: Verification, names: list[str], rows: Rows, tolerance: float | None) -> Figure:
    """Both errors of every pose, on one axis by their logarithm: they lie a factor of ten or more apart."""
    size = v.errors["0"] * 1000
    # several points of one pose follow one another: each gets a place of its own
    order = [label(n) for n in names] if len(names) == len(size) else [str(i + 1) for i in range(len(size))]
    data = []
    if v.nominal_errors is not None and len(v.nominal_errors["0"]) == len(size):
        data.append(_dots(order, v.nominal_errors["0"] * 1000, "before (nominal, best cell)", BEFORE, rows))
    data.append(_dots(order, size, "after (calibrated)", AFTER, rows))
    lines = [] if tolerance is None else [level_line("y", tolerance)]
    message = "" if tolerance is None else f" Dashed: tolerance, {number(tolerance)} mm."
    return Figure(
        tuple(data),
        layout(
            "pose",
            "error (mm), logarithmic",
            xaxis={"type": "category", "nticks": 30},
            yaxis={"type": "log", "dtick": "D2"},
            shapes=lines,
        ),
        f"Error at the tool's origin, pose by pose.{message} Click a pose to see it in all plots, rows and images.",
        "Error of each pose before and after calibration",
    )


def _dots(x: list[str], y: Array, name: str, colour: str, rows: Rows) -> dict[str, object]:
    return trace(
        "scatter markers",
        (x, rounded(y)),
        name,
        marker={"color": colour, "size": 9},
        customdata=linked(rows, len(x)),
        hovertemplate="%{x}: %{y:.3g} mm<extra>" + name + "</extra>",
    )


def _histogram(v: Verification, rows: Rows) -> Figure:
    groups = [("after", v.errors, AFTER)]
    if v.nominal_errors is not None:
        groups.insert(0, ("before", v.nominal_errors, BEFORE))
    every = np.concatenate([e for _, errors, _ in groups for e in errors.values()]) * 1000
    positive = every[every > 0]
    low, high = (np.log10(positive.min()), np.log10(positive.max())) if len(positive) else (-3.0, 0.0)
    # bins of equal ratio: before and after lie a factor of ten or more apart
    edges = np.logspace(low - 0.02, high + 0.02, max(8, min(40, int(12 * (high - low)) + 4)))
    data: list[dict[str, object]] = []
    for k, tool in enumerate(v.errors):
        for name, errors, colour in groups:
            shown = np.clip(errors[tool] * 1000, edges[0], edges[-1])
            counts, _ = np.histogram(shown, edges)
            inside = np.clip(np.searchsorted(edges, shown, side="right") - 1, 0, len(edges) - 2)
            poses = linked(rows, len(shown))
            data.append(
                trace(
                    "bar",
                    (rounded(np.sqrt(edges[1:] * edges[:-1])), counts.tolist()),
                    f"{name}, {_tool(tool, v)}",
                    width=rounded(np.diff(edges)),
                    marker={"color": colour, "opacity": 0.8, "line": {"width": 0.5, "color": PAPER}},
                    visible=True if k == 0 else "legendonly",
                    customdata=[[poses[i] for i in np.flatnonzero(inside == b)] for b in range(len(counts))]
                    if poses
                    else [],
                )
            )
    more = "; other tool points by a click in the legend" if len(v.errors) > 1 else ""
    return Figure(
        tuple(data),
        layout(
            "error (mm), logarithmic",
            "poses",
            barmode="overlay",
            xaxis={"type": "log", "dtick": "D2" if high - low < 1.5 else 1},
        ),
        f"Distribution of the errors{more}.",
        "Histogram of pose errors before and after calibration",
        height=320,
    )


def _pose_table(v: Verification, names: list[str], rows: Rows) -> Table | Text:
    """The poses, the largest error first."""
    size = v.errors["0"] * 1000
    if len(size) != len(names):
        return Text("")
    before = None if v.nominal_errors is None else v.nominal_errors["0"] * 1000
    normalised = np.sqrt(v.normalised)
    order = [int(i) for i in np.argsort(-size, kind="stable")]
    cells = [
        [
            names[i],
            "–" if before is None else number(before[i]),
            number(size[i]),
            number(1e3 * v.predicted[i]),
            number(normalised[i], 2),
        ]
        for i in order
    ]
    return table(
        ["Pose", "Error before (mm)", "after", "Predicted sigma of the place (mm)", "Error / predicted"],
        cells,
        "The poses kept out, the largest error first. Choose one to see it in all plots and images.",
        shown=8,
        poses=[int(rows[i]) for i in order],
    )


def _iso(v: Verification) -> Table:
    iso = v.iso
    if iso is None:
        raise ValueError("no ISO terms")
    rows = [
        ["AP, pose accuracy of position", number(iso.ap_mean * 1e3), number(iso.ap_max * 1e3), "mm"],
        [
            "AP, pose accuracy of orientation",
            number(np.degrees(iso.ap_orientation_mean)),
            number(np.degrees(iso.ap_orientation_max)),
            "deg",
        ],
        ["RP, repeatability of position", number(iso.rp_mean * 1e3), number(iso.rp_max * 1e3), "mm"],
    ]
    note = "" if np.isfinite(iso.rp_mean) else " RP needs repeated poses, there are none."
    return table(
        ["Term of ISO 9283", "Mean of the poses", "Largest", "Unit"],
        rows,
        f"Model against the barycentre of what was attained in {iso.groups} distinct poses.{note}",
        text=(0, 3),
    )


def _repeated(material: Material) -> list[Block]:
    """Terms of ISO 9283 that repeated poses of the whole recording tell."""
    robot, identification, campaign = material.calibrated, material.identification, material.campaign
    if robot is None or robot.q is None or robot.tools is None or identification is None:
        return []
    frames = [o for o in identification.recording.observations if isinstance(o, FrameObservations)]
    if not frames:
        return []
    pose = np.concatenate([o.pose for o in frames])
    order = np.argsort(pose, kind="stable")
    attained = np.concatenate([o.world_T_tool for o in frames])[order, :3, 3]
    pose = pose[order]
    log = None if campaign is None else campaign.poses
    known = log is not None and len(log) == len(robot.q) and not log.inferred and bool(np.any(log.approach))
    directions = [tuple(log.approach[p]) for p in pose] if log is not None and known else None
    found = characteristics(repetitions(robot.q)[pose], robot.tools[pose, :3, 3], attained, directions)
    if found is None:
        return []
    rows = [
        ["AP, pose accuracy, largest", number(found.ap * 1e3)],
        ["RP, pose repeatability, largest", number(found.rp * 1e3)],
        [f"vAP, variation over {found.directions} directions of approach", number(found.vap * 1e3)],
        [f"AD, distance accuracy over {number(found.distance * 1e3, 4)} mm", number(found.ad * 1e3)],
        ["RD, distance repeatability", number(found.rd * 1e3)],
        [f"dAP, drift of AP over {found.looks} looks of 10 cycles", number(found.dap * 1e3)],
        ["dRP, drift of RP", number(found.drp * 1e3)],
    ]
    few = "" if found.complete else f" The standard asks for {CYCLES} cycles: {found.cycles} are an indication."
    return [
        table(
            ["From repeated poses, ISO 9283:1998", "mm"],
            rows,
            f"{found.poses} poses, visited {found.cycles} times or more; commanded is what the calibrated robot "
            f"predicts. A dash: the recording does not tell.{few}",
        )
    ]


def _calibration_of_uncertainty(v: Verification, names: list[str], rows: Rows) -> Figure:
    size = np.sqrt(v.normalised)
    x = [label(n) for n in names] if len(names) == len(size) else list(range(len(size)))
    data = [
        trace(
            "scatter markers",
            (x, rounded(size)),
            "pose",
            marker={"color": AFTER, "size": 8},
            customdata=linked(rows, len(size)),
            hovertemplate="%{x}: %{y:.2f}<extra></extra>",
        )
    ]
    lines = [level_line("y", 1)]
    return Figure(
        tuple(data),
        layout(
            "pose",
            "error / predicted error",
            shapes=lines,
            yaxis={"rangemode": "tozero"},
            xaxis={"type": "category", "nticks": 30},
            showlegend=False,
        ),
        "Predicted against actual: error of each pose divided by what the covariance of model and measurement "
        "predicts. Around one: the stated uncertainties hold.",
        "Normalised error of each pose",
        height=280,
    )


def _calibration_words(v: Verification) -> str:
    inside = f"{percent(v.coverage_95)} of the poses lie inside their 95 % region"
    if v.p_value < 0.01:
        return (
            f"{inside}; the errors are larger than predicted (p = {probability(v.p_value)}): some error is left that "
            "neither model nor noise explains, so take the stated sigmas as too small."
        )
    if v.p_value > 0.999:
        return f"{inside}; the errors are smaller than predicted: the stated sigmas are cautious."
    return f"{inside}; errors and predictions agree (p = {probability(v.p_value)})."
