"""Colours and layouts of the plots: the palette of Okabe and Ito (2008), told apart by all kinds of colour vision."""

from __future__ import annotations

import html
from collections.abc import Mapping
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
CATEGORIES = (AFTER, BEFORE, GREEN, PURPLE, SKY, ACCENT, "#6B7280", "#B8A200")
SYMBOLS = ("circle", "diamond", "square", "triangle-up", "cross", "x")


def label(text: object) -> str:
    """Text for a plot: Plotly reads a little HTML in every text, names of the user must not be taken for it."""
    return html.escape(str(text), quote=True)


def layout(x: str = "", y: str = "", **more: Any) -> dict[str, Any]:
    """Layout of a plane plot with titled axes."""
    axis: dict[str, Any] = {"gridcolor": GRID, "zerolinecolor": "#9AA5B1", "linecolor": "#9AA5B1", "ticks": "outside"}
    axis["automargin"] = True
    out: dict[str, Any] = {
        "font": {"family": "system-ui, sans-serif", "size": 13, "color": INK},
        "paper_bgcolor": "#FFFFFF",
        "plot_bgcolor": "#FFFFFF",
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


def scene(up: Any = (0.0, 0.0, 1.0), **more: Any) -> dict[str, Any]:
    """Layout of a plot in space, axes in metres with equal scale, seen from the side and a little from above.

    `up` is the direction (3,) that is to point upwards on the screen.
    """
    z = np.asarray(up, dtype=float) / np.linalg.norm(up)
    helper = np.eye(3)[int(np.argmin(np.abs(z)))]
    side = np.cross(helper, z)
    side /= np.linalg.norm(side)
    eye = 1.6 * (0.62 * side + 0.62 * np.cross(side, z)) + 0.6 * z
    xyz = ("x", "y", "z")
    axis = {"backgroundcolor": "#FFFFFF", "gridcolor": GRID, "zerolinecolor": GRID, "showspikes": False}
    view = {
        "aspectmode": "data",
        "xaxis": axis | {"title": {"text": "x (m)"}},
        "yaxis": axis | {"title": {"text": "y (m)"}},
        "zaxis": axis | {"title": {"text": "z (m)"}},
        "camera": {
            "eye": dict(zip(xyz, eye.tolist(), strict=True)),
            "up": dict(zip(xyz, z.tolist(), strict=True)),
        },
    }
    out = layout(margin={"l": 0, "r": 0, "t": 0, "b": 0}, scene=view | more.pop("scene", {}))
    del out["xaxis"], out["yaxis"]
    return out | more


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
