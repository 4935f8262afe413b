"""The page of a fleet: outlying robots, batches, a histogram for each parameter. Self-contained, without scripts."""

from collections.abc import Mapping, Sequence
from html import escape
from typing import Any

import numpy as np

WIDTH, HEIGHT, FOOT = 260, 96, 16
_STYLE = """
:root { color-scheme: light dark; --ink: #1c2430; --dim: #5d6b7d; --page: #fff; --bar: #4a7bb5; --mark: #c2452d; }
@media (prefers-color-scheme: dark) {
  :root { --ink: #e3e8ef; --dim: #9aa7b8; --page: #161b22; --bar: #6f9fd8; --mark: #ff8a70; }
}
body { font: 15px/1.5 system-ui, sans-serif; color: var(--ink); background: var(--page); max-width: 1160px;
  margin: 2rem auto; padding: 0 1rem; }
h1, h2 { line-height: 1.2; } p.lead { font-size: 1.1rem; } .dim { color: var(--dim); }
table { border-collapse: collapse; width: 100%; } th, td { text-align: left; padding: .25rem .6rem .25rem 0;
  border-bottom: 1px solid color-mix(in srgb, var(--dim) 30%, transparent); vertical-align: top; }
.grid { display: grid; grid-template-columns: repeat(auto-fill, minmax(270px, 1fr)); gap: 1rem; }
figure { margin: 0; break-inside: avoid; } figcaption { font-size: .85rem; }
svg { width: 100%; height: auto; } rect { fill: var(--bar); } .out { fill: var(--mark); }
text { fill: var(--dim); font: 10px system-ui, sans-serif; }
"""


def fleet_page(data: Mapping[str, Any], batch: Mapping[str, str]) -> str:
    """HTML of a fleet from the content of fleet.json; ``batch`` is that of each robot."""
    outlying: Sequence[Mapping[str, Any]] = data["outlying"]
    count = len(outlying)
    lead = f"{data['robots']} robots, {len(data['parameters'])} parameters; " + (
        f"{count} robot{'s are' if count > 1 else ' is'} out of the ordinary."
        if count
        else "none is out of the ordinary."
    )
    parts = [
        "<!doctype html><html lang='en'><head><meta charset='utf-8'><title>Fleet</title>",
        "<meta name='viewport' content='width=device-width, initial-scale=1'>",
        f"<style>{_STYLE}</style></head><body><main><h1>Fleet</h1><p class='lead'>{escape(lead)}</p>",
        _outlying(outlying, batch),
        _differences(data["differences"], data["batches"], data["parameters"]),
        "<h2>Parameters</h2><p class='dim'>Robots by value; spread is that between robots, without the uncertainty of "
        "the estimates; marked: robots out of the ordinary in this parameter.</p><div class='grid'>",
        *[_histogram(name, p) for name, p in data["parameters"].items()],
        "</div></main></body></html>",
    ]
    return "\n".join(parts)


def _outlying(outlying: Sequence[Mapping[str, Any]], batch: Mapping[str, str]) -> str:
    if not outlying:
        return ""
    rows = [
        f"<tr><td>{escape(o['run'])}</td><td>{escape(batch.get(o['run'], ''))}</td><td>{o['p_value']:.1e}</td><td>"
        + ", ".join(f"{escape(name)} ({z:+.1f} sigma)" for name, z in o["z"].items())
        + "</td></tr>"
        for o in outlying
    ]
    head = "<tr><th>robot</th><th>batch</th><th>by chance</th><th>where</th></tr>"
    return f"<h2>Out of the ordinary</h2><table>{head}{''.join(rows)}</table>"


def _differences(
    differences: Sequence[Mapping[str, Any]], batches: Mapping[str, int], parameters: Mapping[str, Any]
) -> str:
    if len(batches) < 2:
        return ""
    listed = ", ".join(f"{escape(name or 'no batch')} ({n})" for name, n in batches.items())
    if not differences:
        return f"<h2>Batches</h2><p>{listed}: no parameter differs between them.</p>"
    rows = []
    for d in differences:
        unit = parameters[d["parameter"]]["unit"]
        medians = ", ".join(f"{escape(name)} {v:.4g} {escape(unit)}" for name, v in d["medians"].items())
        cells = (escape(d["parameter"]), d["kind"], f"{d['p_value']:.1e}", medians)
        rows.append("<tr>" + "".join(f"<td>{c}</td>" for c in cells) + "</tr>")
    head = "<tr><th>parameter</th><th>differs in</th><th>by chance</th><th>medians</th></tr>"
    return f"<h2>Batches</h2><p>{listed}</p><table>{head}{''.join(rows)}</table>"


def _histogram(name: str, p: Mapping[str, Any]) -> str:
    values = np.array(list(p["values"].values()))
    marked = np.array([o["value"] for o in p["outliers"]])
    low, high = float(values.min()), float(values.max())
    high = high if high > low else low + 1e-9
    counts, edges = np.histogram(values, bins=min(24, max(6, int(np.sqrt(len(values)) * 1.5))), range=(low, high))
    bars = []
    step = WIDTH / len(counts)
    for k, count in enumerate(counts):
        if not count:
            continue
        tall = (HEIGHT - FOOT - 4) * count / counts.max()
        last = k == len(counts) - 1
        out = np.any((marked >= edges[k]) & ((marked < edges[k + 1]) | last))
        kind = " class='out'" if out else ""
        bars.append(
            f"<rect{kind} x='{k * step:.1f}' y='{HEIGHT - FOOT - tall:.1f}' width='{step - 1:.1f}' "
            f"height='{tall:.1f}'/>"
        )
    label = f"{name}: median {p['median']:.4g} {p['unit']}, spread {p['spread']:.3g} {p['unit']}"
    return (
        f"<figure><svg viewBox='0 0 {WIDTH} {HEIGHT}' role='img' aria-label='{escape(label)}'>{''.join(bars)}"
        f"<text x='0' y='{HEIGHT - 3}'>{low:.3g}</text>"
        f"<text x='{WIDTH}' y='{HEIGHT - 3}' text-anchor='end'>{high:.3g}</text>"
        f"</svg><figcaption><b>{escape(name)}</b><br>median {p['median']:.4g} {escape(p['unit'])}, spread "
        f"{p['spread']:.3g} <span class='dim'>(estimate ±{p['sigma']:.2g}, {p['robots']} robots)</span>"
        "</figcaption></figure>"
    )
