"""A page with the whole history of a drift control: one self-contained HTML file."""

import html
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import sqlalchemy as sa
from plotly.offline import get_plotlyjs

from pipeline.drift import store
from pipeline.drift.database import ALARMS, MODELS, TOURS, transaction
from robcal.files.storage import write_text
from robcal.transforms import Array

STANDSTILL_H = 0.5


def write_page(place: Path | str, out: Path) -> Path:
    """Write drift, temperatures, standstills, alarms, targets and parameters over time.

    Raises
    ------
    InvalidInput : there is no state. StorageError : the page cannot be written.
    """
    with transaction(place) as connection:
        reference, _ = store.load_reference(connection)
        tours = connection.execute(sa.select(TOURS).order_by(TOURS.c.id)).all()
        alarms = connection.execute(sa.select(ALARMS).order_by(ALARMS.c.id)).all()
        rows = connection.execute(sa.select(MODELS.c.time_s, MODELS.c.change).order_by(MODELS.c.version)).all()
    hours = np.array([t.time_s for t in tours]) / 3600
    changes = np.array([np.frombuffer(row.change) for row in rows])
    figures = [
        ("Drift", "mm", _drift(hours, tours, alarms)),
        ("Temperatures", "C", _temperatures(hours, tours)),
        ("Targets against the model in force", "mm", _targets(hours, tours)),
        ("Parameters: change since the reference", "mm, deg", _parameters(rows, changes, reference.names)),
    ]
    write_text(out, _html(place, tours, alarms, [f for f in figures if f[2]]))
    return out


def _line(x: Array, y: Sequence[float] | Array, name: str, *, dots: bool = False) -> dict[str, Any]:
    mode = "markers" if dots else "lines"
    return {"type": "scattergl", "mode": mode, "name": name, "x": np.round(x, 4).tolist(), "y": np.round(y, 5).tolist()}


def _drift(hours: Array, tours: Sequence[Any], alarms: Sequence[Any]) -> list[dict[str, Any]]:
    lines = [
        _line(hours, [getattr(t, f"{kind}_mm") for t in tours], kind)
        for kind in ("uncorrected", "corrected", "residual")
    ]
    for kind in sorted({a.kind for a in alarms}):
        mine = [a for a in alarms if a.kind == kind]
        marks = _line(np.array([a.time_s for a in mine]) / 3600, [0.0] * len(mine), f"alarm: {kind}", dots=True)
        lines.append({**marks, "text": [a.text for a in mine], "marker": {"size": 10, "symbol": "triangle-up"}})
    pauses = np.flatnonzero(np.diff(hours) > STANDSTILL_H)
    if len(pauses):
        text = [f"standstill of {hours[k + 1] - hours[k]:.1f} h" for k in pauses]
        lines.append({**_line(hours[pauses + 1], [0.0] * len(pauses), "standstill", dots=True), "text": text})
    return lines


def _temperatures(hours: Array, tours: Sequence[Any]) -> list[dict[str, Any]]:
    names = sorted({name for t in tours for name in t.temperatures})
    return [_line(hours, [t.temperatures.get(n, np.nan) for t in tours], n) for n in names]


def _targets(hours: Array, tours: Sequence[Any]) -> list[dict[str, Any]]:
    ids = sorted({int(name) for t in tours for name in t.targets_mm})
    return [_line(hours, [t.targets_mm.get(str(i), np.nan) for t in tours], f"target {i}") for i in ids]


def _parameters(rows: Sequence[Any], changes: Array, names: Sequence[str]) -> list[dict[str, Any]]:
    hours = np.array([row.time_s for row in rows]) / 3600
    factor = [1e3 if name.rsplit(".", 1)[-1] in "xyz" else np.degrees(1.0) for name in names]
    return [_line(hours, f * changes[:, k], name) for k, (name, f) in enumerate(zip(names, factor, strict=True))]


def _html(place: Path | str, tours: Sequence[Any], alarms: Sequence[Any], figures: list[Any]) -> str:
    last = tours[-1] if tours else None
    summary = (
        f"{len(tours)} tours; the last: {last.uncorrected_mm:.3f} mm uncorrected, {last.corrected_mm:.3f} mm corrected"
        if last is not None
        else "no tour is complete yet"
    )
    message = "".join(f"<li>cycle {a.cycle}: <b>{a.kind}</b>: {html.escape(a.text)}</li>" for a in alarms[-100:])
    plots, calls = "", []
    for k, (title, unit, data) in enumerate(figures):
        plots += f'<h2>{html.escape(title)}</h2><div id="p{k}" class="plot"></div>'
        layout = {
            "xaxis": {"title": {"text": "time, h"}},
            "yaxis": {"title": {"text": unit}},
            "height": 420,
            "margin": {"t": 10},
        }
        content = json.dumps([data, layout]).replace("NaN", "null").replace("</", "<\\/")
        calls.append(f"[{json.dumps(f'p{k}')}, {content}]")
    script = (
        f"const figures = [{', '.join(calls)}];"
        "document.documentElement.dataset.plots = String(figures.length);"
        "Promise.all(figures.map(function (f) {"
        "return Plotly.newPlot(f[0], f[1][0], f[1][1], {displaylogo: false, responsive: true}); }))"
        ".then(function () { document.documentElement.dataset.drawn = String(figures.length); });"
    )
    name = html.escape(Path(str(place)).name)
    return (
        f'<!doctype html><html lang="en"><head><meta charset="utf-8"><title>{name}: drift</title>'
        "<style>body{font:16px/1.5 sans-serif;max-width:75rem;margin:2rem auto;padding:0 1rem}</style></head>"
        f"<body><h1>Drift of {name}</h1><p>{summary}</p><h2>Alarms</h2>"
        f"{f'<ul>{message}</ul>' if message else '<p>none</p>'}{plots}"
        f"<script>{get_plotlyjs()}</script><script>{script}</script></body></html>"
    )
