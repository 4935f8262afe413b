"""Colours and layouts of the plots: the palette of Okabe and Ito (2008), told apart by all kinds of colour vision."""

import html
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

BEFORE = "#E69F00"
AFTER = "#0072B2"
ACCENT = "#D55E00"
GREEN = "#009E73"
SKY = "#56B4E9"
PURPLE = "#CC79A7"
GREY = "#8A929C"
INK = "#1F2933"
GRID = "#E4E7EB"
PAPER = "#FFFFFF"
NIGHT = {
    INK: "#E6EAEE",
    GRID: "#333D48",
    PAPER: "#181D23",
    "#FFF": "#181D23",
    AFTER: "#4DA6E8",
    GREY: "#8A929C",
    "RGBA(255,255,255,0.85)": "rgba(24,29,35,0.85)",
    "#6B7280": "#A8B0BA",
    "#9AA5B1": "#66717D",
}
"""Colours of a plot on paper and on a dark screen, keys in capitals."""
CATEGORIES = (AFTER, BEFORE, GREEN, PURPLE, SKY, ACCENT, "#6B7280", "#B8A200")


def label(text: object) -> str:
    """Text for a plot: Plotly reads a little HTML in every text, names of the user must not be taken for it."""
    return html.escape(str(text), quote=True)


def layout(x: str = "", y: str = "", **more: Any) -> dict[str, Any]:
    """Layout of a plane plot with titled axes."""
    axis: dict[str, Any] = {"gridcolor": GRID, "zerolinecolor": "#9AA5B1", "linecolor": "#9AA5B1", "ticks": "outside"}
    axis["automargin"] = True
    out: dict[str, Any] = {
        "font": {"family": "system-ui, sans-serif", "size": 13, "color": INK},
        "paper_bgcolor": PAPER,
        "plot_bgcolor": PAPER,
        "margin": {"l": 60, "r": 20, "t": 12, "b": 50},
        "xaxis": axis | {"title": {"text": x}},
        "yaxis": axis | {"title": {"text": y}},
        "legend": {"orientation": "h", "yanchor": "bottom", "y": 1.02, "x": 0},
        "hoverlabel": {"font": {"size": 13}},
    }
    for name, value in more.items():
        known = out.get(name)
        out[name] = {**known, **value} if isinstance(known, Mapping) and isinstance(value, Mapping) else value
    return out


def scene(data: Iterable[Mapping[str, Any]], up: Any = (0.0, 0.0, 1.0), **more: Any) -> dict[str, Any]:
    """Layout of a plot in space, axes in metres with equal scale, seen from the side and a little from above.

    `data` are the traces, which the view holds as a whole; `up` (3,) is the direction that points upwards.
    """
    z = np.asarray(up, dtype=float) / np.linalg.norm(up)
    helper = np.eye(3)[int(np.argmin(np.abs(z)))]
    side = np.cross(helper, z)
    side /= np.linalg.norm(side)
    eye = 1.6 * (0.62 * side + 0.62 * np.cross(side, z)) + 0.6 * z
    xyz = ("x", "y", "z")
    axis = {"backgroundcolor": PAPER, "gridcolor": GRID, "zerolinecolor": GRID, "showspikes": False}
    ranges = _ranges(list(data))
    span = ranges[:, 1] - ranges[:, 0]
    view = {
        "aspectmode": "manual",
        # the diagonal of the box has the same length on the screen whatever its shape, so nothing is cut off
        "aspectratio": dict(zip(xyz, rounded(_DIAGONAL * span / np.linalg.norm(span)), strict=True)),
        **{
            f"{k}axis": axis | {"title": {"text": f"{k} (m)"}, "range": ends.tolist(), "nticks": 6}
            for k, ends in zip(xyz, ranges, strict=True)
        },
        "camera": {
            "center": dict(zip(xyz, (-0.03 * z).tolist(), strict=True)),
            "eye": dict(zip(xyz, eye.tolist(), strict=True)),
            "up": dict(zip(xyz, z.tolist(), strict=True)),
        },
    }
    out = layout(margin={"l": 0, "r": 0, "t": 0, "b": 0}, scene=view | more.pop("scene", {}))
    del out["xaxis"], out["yaxis"]
    return out | more


_DIAGONAL = 1.27
"""Length of the diagonal of a plot in space, in units of Plotly's camera."""


def _ranges(data: list[Mapping[str, Any]]) -> np.ndarray:
    """Ranges (3, 2) that hold all points of the traces, with a margin; a flat set gets some depth."""
    ends = []
    for k in "xyz":
        values = np.array([v for trace in data for v in trace.get(k, ()) if v is not None], dtype=float)
        ends.append((values.min(), values.max()) if len(values) else (0.0, 1.0))
    ranges = np.array(ends)
    span = ranges[:, 1] - ranges[:, 0]
    least = max(0.35 * float(span.max()), 1e-3)
    half = 0.5 * np.maximum(span * 1.1, least)
    middle = ranges.mean(axis=1)
    return np.stack([middle - half, middle + half], axis=1)


def trace(form: str, coordinates: Sequence[Any], name: str, **more: Any) -> dict[str, Any]:
    """A trace of a plot: Plotly's type and mode (``"scatter lines"``, ``"bar"``), x, y (and z), its other entries."""
    kind, _, mode = form.partition(" ")
    head = {"type": kind, "mode": mode} if mode else {"type": kind}
    return {**head, **dict(zip("xyz", coordinates, strict=False)), "name": name, **more}


def linked(rows: Any, count: int) -> list[int]:
    """`customdata` of a trace of ``count`` points: the pose of each; empty where they are not one a pose."""
    return [int(row) for row in rows] if len(rows) == count else []


def level_line(axis: str, value: object) -> dict[str, Any]:
    """A dashed line across the whole plot at a value of ``axis``, "x" or "y"."""
    other = "y" if axis == "x" else "x"
    ends = {f"{axis}0": value, f"{axis}1": value, f"{other}0": 0, f"{other}1": 1}
    return {"type": "line", f"{other}ref": "paper", **ends, "line": {"color": GREY, "dash": "dash"}}


def percent(share: float) -> str:
    """A share as text."""
    return f"{100 * share:.0f} %"


def probability(p: object) -> str:
    """A probability as text; what is too small to matter is told as a bound."""
    if isinstance(p, int | float) and np.isfinite(p) and p < 1e-12:
        return "below 1e-12"
    return number(p, 2)


def rounded(values: Any, digits: int = 4) -> list[Any]:
    """Values with few digits (the file stays small); not finite ones become gaps."""
    flat = np.asarray(values, dtype=float)
    out: list[Any] = []
    for v in flat:
        out.append(float(f"{v:.{digits}g}") if np.isfinite(v) else None)
    return out


def number(value: object, digits: int = 3) -> str:
    """A number for a table: `digits` significant figures without exponent where that is readable; dash where none."""
    if value is None:
        return "–"
    try:
        v = float(str(value))
    except ValueError:
        return str(value)
    if not np.isfinite(v):
        return "–"
    if v == 0:
        return "0"
    magnitude = int(np.floor(np.log10(abs(v))))
    if magnitude < -7 or magnitude > 6:
        return f"{v:.{digits - 1}e}"
    return f"{v:.{max(digits - 1 - magnitude, 0)}f}"


def to_sigma(value: float, sigma: float) -> str:
    """A value with as many decimals as two figures of its standard deviation have."""
    if not (np.isfinite(value) and np.isfinite(sigma) and sigma > 0):
        return number(value, 4)
    decimals = 1 - int(np.floor(np.log10(sigma)))
    return f"{value:.{min(max(decimals, 0), 9)}f}"
