"""The plot that convinces: what each pose says on its own about a cause, against its covariate, with the fitted law."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from pipeline.report.blocks import Figure
from pipeline.report.style import ACCENT, AFTER, BEFORE, GREEN, GREY, INK, label, layout, rounded, trace
from robcal.recipe.evidence import CauseEvidence
from robcal.transforms import Array

_STATES = {-1.0: (BEFORE, "moved down"), 0.0: (GREY, "approach unknown"), 1.0: (AFTER, "moved up")}
_BINS = 14


def evidence_figure(evidence: CauseEvidence, cause: str, poses: Mapping[str, int]) -> Figure:
    """Points of single poses, means of groups of them, and the fitted law."""
    factor, unit, what = coordinate(evidence.coordinate)
    names = list(evidence.variables)
    x, title = abscissa(names[0], evidence.variables[names[0]])
    state = next((evidence.variables[n] for n in names[1:] if n.startswith("approach")), None)
    data: list[dict[str, Any]] = []
    groups: list[tuple[Array, str, str]] = [(np.ones(len(x), dtype=bool), "", AFTER)]
    if state is not None:
        groups = [
            (state == s, f", {message}", colour) for s, (colour, message) in _STATES.items() if np.any(state == s)
        ]
    for which, message, colour in groups:
        for out, symbol, name in ((False, "circle", "single pose"), (True, "diamond-open", "kept-out pose")):
            mine = which & (evidence.kept_out == out)
            if mine.any():
                point = _points(evidence, mine, x, factor, (colour, symbol), f"{name}{message}", unit)
                rows = [poses.get(p) for p, m in zip(evidence.poses, mine, strict=True) if m]
                data.append({**point, "customdata": rows})
        means = _means(x[which], evidence.measured[which] * factor, evidence.sigma[which] * factor)
        if means is not None:
            data.append(
                trace(
                    "scatter markers",
                    (rounded(means[0]), rounded(means[1])),
                    f"mean of neighbours{message}",
                    error_y={"type": "data", "array": rounded(means[2]), "color": colour, "thickness": 2, "width": 4},
                    marker={"color": colour, "size": 11, "line": {"color": "#fff", "width": 1.5}, "symbol": "square"},
                )
            )
    data += _law(evidence, x, factor)
    label_y = f"{what} ({unit})" if unit else what
    spread = np.concatenate([evidence.measured, evidence.fitted]) * factor
    low, high = np.percentile(spread, (0.5, 99.5))
    pad = 0.25 * max(high - low, 1e-12)
    kept = "; open diamonds: poses that took no part" if evidence.kept_out.any() else ""
    caption = (
        f"{cause[:1].upper()}{cause[1:]}, {evidence.where}: what every pose says on its own (bars: one sigma), and the "
        f"fitted law{kept}. "
        + ("One means as strong as fitted, zero not there." if evidence.coordinate == "share" else "")
    )
    return Figure(
        tuple(data),
        layout(title, label_y, yaxis={"range": [low - pad, high + pad]}),
        caption,
        f"Evidence for {cause} at {evidence.where}",
        height=400,
    )


def coordinate(name: str) -> tuple[float, str, str]:
    """Factor to people's units, unit and words of a coordinate ``<frame>.<kind>``."""
    if name == "share":
        return 1.0, "", "share of the fitted effect"
    frame, _, kind = name.rpartition(".")
    if kind in ("x", "y", "z"):
        return 1e3, "mm", f"shift of {label(frame)} along {kind}"
    if kind == "q":
        return 180 / np.pi, "deg", f"turn of {label(frame)} about its axis"
    return 180 / np.pi, "deg", f"turn of {label(frame)} ({kind})"


def abscissa(name: str, values: Array) -> tuple[Array, str]:
    """Values of a covariate in people's units, and its title."""
    if name.startswith("q") and name[1:].isdigit():
        return np.degrees(values), f"joint angle {name[1:]} (deg)"
    if name.startswith("torque") and name[6:].isdigit():
        return values, f"static torque of axis {name[6:]} (N m)"
    if "_m" in name and name.rsplit("_m", 1)[-1] in ("roll", "pitch", "yaw", "x", "y", "z"):
        return values, f"static moment {label(name)} (N m)"
    if name == "time_s":
        return values / 3600, "time (h)"
    if name == "index":
        return values + 1, "pose in the order in which it was driven"
    if name.startswith("temp_") and name.endswith("_c"):
        return values, f"temperature {label(name[5:-2])} (°C)"
    if name.startswith("approach"):
        return values, f"direction from which axis {name[8:]} came"
    return values, label(name)


def _points(
    e: CauseEvidence, mine: Array, x: Array, factor: float, style: tuple[str, str], name: str, unit: str
) -> dict[str, Any]:
    colour, symbol = style
    return trace(
        "scatter markers",
        (rounded(x[mine]), rounded(e.measured[mine] * factor)),
        name,
        error_y={
            "type": "data",
            "array": rounded(e.sigma[mine] * factor),
            "color": colour,
            "thickness": 0.6,
            "width": 0,
        },
        marker={"color": colour, "size": 6, "symbol": symbol, "opacity": 0.55},
        text=[label(p) for p, m in zip(e.poses, mine, strict=True) if m],
        hovertemplate="%{text}: %{y:.4g} " + unit + "<extra></extra>",
        showlegend=symbol == "circle",
    )


def _means(x: Array, y: Array, sigma: Array) -> tuple[Array, Array, Array] | None:
    """Weighted means of groups of neighbours over x, where single poses scatter too much to be read."""
    if len(x) < 3 * _BINS // 2:
        return None
    values = np.unique(x)
    if len(values) <= 6:
        groups = [x == v for v in values]
    else:
        edges = np.unique(np.quantile(x, np.linspace(0, 1, min(_BINS, len(x) // 3) + 1)))
        bins = np.clip(np.searchsorted(edges, x, side="right") - 1, 0, len(edges) - 2)
        groups = [bins == k for k in range(len(edges) - 1)]
    groups = [g for g in groups if g.sum() >= 2]
    if not groups:
        return None
    w = 1 / sigma**2
    total = np.array([w[g].sum() for g in groups])
    return (
        np.array([np.sum(w[g] * x[g]) for g in groups]) / total,
        np.array([np.sum(w[g] * y[g]) for g in groups]) / total,
        1 / np.sqrt(total),
    )


def _law(e: CauseEvidence, x: Array, factor: float) -> list[dict[str, Any]]:
    """The fitted law as lines, or as a mark at every pose where it is no line over the abscissa."""
    out: list[dict[str, Any]] = []
    first = next(iter(e.variables))
    dashes = ("solid", "dash", "dot")
    for k, (name, (grid, value)) in enumerate(e.curves.items()):
        shown, _ = abscissa(first, grid)
        state = name.split()[-1] if name.startswith("approach") else ""
        message = f"fitted law, {_STATES[float(state)][1]}" if state else "fitted law"
        colour = _STATES[float(state)][0] if state else ACCENT
        line = {"color": INK if not state else colour, "width": 3, "dash": dashes[k % 3]}
        out.append(trace("scatter lines", (rounded(shown, 5), rounded(value * factor)), message, line=line))
    if not out:
        order = np.argsort(x, kind="stable")
        mark = {"color": GREEN, "symbol": "line-ew-open", "size": 12, "line": {"width": 2.5}}
        out.append(
            trace(
                "scatter markers",
                (rounded(x[order]), rounded(e.fitted[order] * factor)),
                "fitted law at the pose",
                marker=mark,
            )
        )
    return out
