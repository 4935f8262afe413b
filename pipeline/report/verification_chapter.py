"""Chapter: how good the calibrated robot is where it was not identified."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from pipeline.report.blocks import Block, Chapter, Figure, Table, Text, table
from pipeline.report.material import Material
from pipeline.report.style import AFTER, BEFORE, GREY, label, layout, number, rounded
from robcal.calibration.observations import FrameObservations
from robcal.calibration.verification import TEST_VECTORS, Verification
from robcal.transforms import Array, skew


def noise_by_tool(material: Material) -> dict[str, float]:
    """Root mean square error (m) that the measurement alone would show, by test vector; empty without frames.

    A point t of the tool is displaced by rho + omega x t (right perturbation); turning it into the world does not
    change its length.
    """
    found = material.verification
    if found is None or material.identification is None:
        return {}
    rows = found[1]
    covariance = [
        o.covariance[np.isin(o.pose, rows)]
        for o in material.identification.recording.observations
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
    """Errors before and after by tool, as in Table 5.1 of the thesis; `full` with extremes and spread."""
    mm = 1000.0
    rows = []
    for name, after in verification.tools.items():
        before = verification.nominal[name] if verification.nominal else None
        row: list[object] = [_tool(name, verification)]
        for kind in ("mean", "max", "min", "std") if full else ("mean", "max"):
            row += [number(getattr(before, kind) * mm) if before else "–", number(getattr(after, kind) * mm)]
        row.append(number(after.rms * mm))
        row.append(number(noise[name] * mm) if name in noise else "–")
        rows.append(row)
    kinds = ("Mean", "Largest", "Smallest", "Spread") if full else ("Mean", "Largest")
    columns = ["Error in mm at"]
    for kind in kinds:
        columns += [f"{kind} before", f"{kind} after"]
    columns += ["RMS after", "Noise of the measurement (RMS)"]
    after_columns = [2 * k + 2 for k in range(len(kinds))]
    return table(columns, rows, emphasis=after_columns)


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
        blocks += [_bars(verification, names), _histogram(verification)]
        blocks += [_iso(verification)] if verification.iso is not None else []
        blocks += [_calibration_of_uncertainty(verification, names), Text(_honesty(verification))]
    return Chapter("verification", "Pose errors before and after", _lead(material), tuple(blocks))


def _lead(material: Material) -> str:
    if material.verification is None:
        return ""
    v = material.verification[0]
    how = (
        f"{v.poses} poses that took no part in the identification or in any choice"
        if v.kind == "verify-set"
        else f"{v.poses} poses, each predicted by a robot identified without it (cross-validation: the campaign keeps no "
        "pose out)"
    )
    return (
        f"Measured minus modelled place on {how}. Before: the nominal robot after the best fit of base and tool on the "
        "identification poses, so that only the robot itself is compared."
    )


def _bars(v: Verification, names: list[str]) -> Figure:
    errors = v.errors["0"] * 1000
    order = [label(n) for n in names]
    data = []
    if v.nominal_errors is not None and len(v.nominal_errors["0"]) == len(errors):
        data.append(_bar(order, v.nominal_errors["0"] * 1000, "before (nominal, best cell)", BEFORE))
    data.append(_bar(order, errors, "after (calibrated)", AFTER))
    return Figure(
        tuple(data),
        layout("pose", "error (mm)", barmode="group", bargap=0.25, xaxis={"type": "category", "nticks": 30}),
        "Error at the tool's origin, pose by pose.",
        "Bars: error of each pose before and after calibration",
    )


def _bar(x: list[str], y: Array, name: str, colour: str) -> dict[str, object]:
    # several points of one pose follow one another: each gets a bar of its own place
    x = x if len(x) == len(y) else [str(i + 1) for i in range(len(y))]
    return {"type": "bar", "x": x, "y": rounded(y), "name": name, "marker": {"color": colour},
            "hovertemplate": "%{x}: %{y:.3f} mm<extra>" + name + "</extra>"}  # fmt: skip


def _histogram(v: Verification) -> Figure:
    groups = [("after", v.errors, AFTER)]
    if v.nominal_errors is not None:
        groups.insert(0, ("before", v.nominal_errors, BEFORE))
    data: list[dict[str, object]] = []
    tools = list(v.errors)
    largest = max(float(np.max(e["0"])) for _, e, _ in groups) * 1000
    for k, tool in enumerate(tools):
        for name, errors, colour in groups:
            top = max(float(np.max(errors[tool])) * 1000, 1e-9)
            edges = np.linspace(0, top, 13)
            counts, _ = np.histogram(errors[tool] * 1000, edges)
            data.append(
                {
                    "type": "bar", "x": rounded(0.5 * (edges[1:] + edges[:-1])), "y": counts.tolist(),
                    "width": [float(edges[1])] * len(counts), "name": f"{name}, {_tool(tool, v)}",
                    "marker": {"color": colour, "opacity": 0.75, "line": {"width": 0.5, "color": "#fff"}},
                    "visible": True if k == 0 else "legendonly",
                }
            )  # fmt: skip
    return Figure(
        tuple(data),
        layout("error (mm)", "poses", barmode="overlay", xaxis={"range": [0, largest * 1.05]}),
        "Distribution of the errors; other tool points by a click in the legend.",
        "Histogram of pose errors before and after calibration",
    )


def _iso(v: Verification) -> Table:
    iso = v.iso
    if iso is None:
        raise ValueError("no ISO terms")
    rows = [
        ["AP, pose accuracy of position", number(iso.ap_mean * 1e3), number(iso.ap_max * 1e3), "mm"],
        ["AP, pose accuracy of orientation", number(np.degrees(iso.ap_orientation_mean)),
         number(np.degrees(iso.ap_orientation_max)), "deg"],
        ["RP, repeatability of position", number(iso.rp_mean * 1e3), number(iso.rp_max * 1e3), "mm"],
    ]  # fmt: skip
    note = "" if np.isfinite(iso.rp_mean) else " RP needs repeated poses, there are none."
    return table(
        ["Term of ISO 9283", "Mean of the poses", "Largest", "Unit"], rows,
        f"Model against the barycentre of what was attained in {iso.groups} distinct poses.{note}", text=(0, 3),
    )  # fmt: skip


def _calibration_of_uncertainty(v: Verification, names: list[str]) -> Figure:
    size = np.sqrt(v.normalised)
    x = [label(n) for n in names] if len(names) == len(size) else list(range(len(size)))
    data = [
        {"type": "scatter", "mode": "markers", "x": x, "y": rounded(size), "name": "pose",
         "marker": {"color": AFTER, "size": 8}, "hovertemplate": "%{x}: %{y:.2f}<extra></extra>"},
    ]  # fmt: skip
    lines = [
        {"type": "line", "xref": "paper", "x0": 0, "x1": 1, "y0": 1, "y1": 1, "line": {"color": GREY, "dash": "dash"}}
    ]
    return Figure(
        tuple(data),
        layout("pose", "error / predicted error", shapes=lines, yaxis={"rangemode": "tozero"},
               xaxis={"type": "category", "nticks": 30}, showlegend=False),
        "Predicted against actual: error of each pose divided by what the covariance of model and measurement predicts. "
        "Around one: the stated uncertainties hold.",
        "Normalised error of each pose",
        height=280,
    )  # fmt: skip


def _honesty(v: Verification) -> str:
    inside = f"{v.coverage_95:.0%} of the poses lie inside their 95 % region"
    if v.p_value < 0.01:
        return (
            f"{inside}; the errors are larger than predicted (p = {number(v.p_value, 2)}): some error is left that "
            "neither model nor noise explains, so take the stated sigmas as too small."
        )
    return f"{inside}; errors and predictions agree (p = {number(v.p_value, 2)})."
