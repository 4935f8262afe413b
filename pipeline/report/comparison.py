"""Two runs side by side: their errors, and which parameters of the robot changed, with significance."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.history import compare_runs
from pipeline.report.blocks import Block, Chapter, Figure, Text, Verdict, table
from pipeline.report.material import Material
from pipeline.report.page import provenance, render
from pipeline.report.style import AFTER, BEFORE, label, layout, level_line, number, probability, rounded, trace
from pipeline.runs import Run
from robcal.files.storage import write_text

_ROWS = (
    ("poses that tested it", ("verification", "poses"), ""),
    ("mean error", ("verification", "tools", "0", "mean"), "mm"),
    ("largest error", ("verification", "tools", "0", "max"), "mm"),
    ("RMS error", ("verification", "tools", "0", "rms"), "mm"),
    ("mean error before calibration", ("verification", "nominal", "0", "mean"), "mm"),
    ("noise of the measurement", ("noise", "measurement_mm"), "mm"),
    ("what the model misses beyond it", ("noise", "lack_of_fit_mm"), "mm"),
    ("share inside the 95 % region", ("verification", "coverage_95"), ""),
    ("poses identified from", ("identification", "poses"), ""),
    ("parameters", ("identification", "parameters"), ""),
    ("sigma0", ("identification", "sigma0"), ""),
    ("verdict", ("verdict", "text"), ""),
)


def write_comparison(run: Run, other: Run) -> Path:
    """Write comparison.html into a run: what is other than in an earlier one; returns its path.

    Raises
    ------
    InvalidInput : a run has no calibrated robot, or they share no parameter. StorageError : it cannot be written.
    """
    found = compare_runs("", str(other.folder), str(run.folder))
    now, then = Material(run), Material(other)
    chapters = [
        Chapter("figures", "Figures of both runs", "", (_figures(then, now), *_errors(then, now))),
        Chapter(
            "parameters",
            "What changed in the robot",
            "Change of each parameter that both runs identified, by the standard deviation of the change. Errors of "
            "the two runs count as independent; probabilities are corrected for the number of parameters (Holm 1979).",
            (_changes(found), _table(found)),
        ),
    ]
    verdict = Verdict(
        "none",
        "Comparison",
        f"{str(found['statement'])[:1].upper()}{str(found['statement'])[1:]}.",
        f"Before: {then.name}, {other.folder}. After: {now.name}, {run.folder}. Probability that "
        f"chance alone changes as much: {probability(found['p_value'])}.",
        "Nothing from here: this page compares two runs.",
        "; ".join(found["warnings"]),
    )
    path = run.folder / "comparison.html"
    write_text(path, render(f"{now.name} against {then.name}", verdict, chapters, provenance(now), now.all_poses))
    return path


def _value(result: Mapping[str, Any], keys: tuple[str, ...]) -> object:
    found: Any = result
    for key in keys:
        found = found.get(key) if isinstance(found, Mapping) else None
    return found


def _figures(then: Material, now: Material) -> Block:
    rows = []
    for name, keys, unit in _ROWS:
        pair = [_value(m.result, keys) for m in (then, now)]
        if any(v is not None for v in pair):
            rows.append([name, *(str(v) if isinstance(v, int) else number(v) for v in pair), unit])
    return table(["", "Before", "After", "Unit"], rows, text=(0, 3))


def _errors(then: Material, now: Material) -> list[Block]:
    """Errors of the poses that were kept out of both, by their names."""
    both = [_by_pose(m) for m in (then, now)]
    names = [name for name in both[1] if name in both[0]]
    if len(names) < 2:
        return [Text("The two runs have no kept-out poses of the same names: no plot pose by pose.")]
    row = {name: k for k, name in enumerate(now.all_poses)}
    data = tuple(
        trace(
            "scatter markers",
            ([label(n) for n in names], rounded([errors[n] for n in names])),
            told,
            marker={"color": colour, "size": 9},
            customdata=[row[n] for n in names],
            hovertemplate="%{x}: %{y:.3g} mm<extra>" + told + "</extra>",
        )
        for told, errors, colour in (("before", both[0], BEFORE), ("after", both[1], AFTER))
    )
    shown = layout("pose", "error (mm), logarithmic", xaxis={"type": "category"}, yaxis={"type": "log", "dtick": "D2"})
    told = "Error of both calibrated robots at poses of the same name, each against its own measurement."
    return [Figure(data, shown, told, "Errors of both runs, pose by pose")]


def _by_pose(material: Material) -> dict[str, float]:
    if material.verification is None:
        return {}
    v, rows = material.verification
    size = v.errors["0"] * 1e3
    at = np.asarray(rows)[v.rows]
    return {material.pose_name(int(r)): float(e) for r, e in zip(at, size, strict=True)} if len(at) == len(size) else {}


def _sorted(found: Mapping[str, Any]) -> list[tuple[str, Mapping[str, Any]]]:
    return sorted(found["parameters"].items(), key=lambda item: float(item[1]["p_value"]))


def _changes(found: Mapping[str, Any]) -> Figure:
    shown = [(name, p) for name, p in _sorted(found) if p["sigma"] > 0][:40]
    ratio = [p["change"] / p["sigma"] for _, p in shown]
    data = trace(
        "bar",
        ([label(name) for name, _ in shown], rounded(ratio)),
        "change by its sigma",
        marker={"color": [AFTER if p["p_value"] < 0.01 else BEFORE for _, p in shown]},
        text=[f"{p['change']:+.4g} {p['unit']}" for _, p in shown],
        textposition="none",
        hovertemplate="%{x}: %{text}, %{y:.1f} sigma<extra></extra>",
    )
    return Figure(
        (data,),
        layout("", "change / sigma", shapes=[level_line("y", s) for s in (-3, 3)], showlegend=False),
        "Changes by their standard deviation, the surest first; blue: significant at 1 %; dashed: three sigma.",
        "Changes of the parameters by their standard deviations",
    )


def _table(found: Mapping[str, Any]) -> Block:
    rows = [
        [name, f"{p['change']:+.4g}", number(p["sigma"], 2), p["unit"], probability(p["p_value"])]
        for name, p in _sorted(found)
    ]
    return table(["Parameter", "Change", "Sigma", "Unit", "By chance (p)"], rows, text=(0, 3), shown=15)
