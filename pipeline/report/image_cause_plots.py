"""Plots for causes found in images: the lens' curve with its uncertainty, and what each cause gains."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from pipeline.report.blocks import Figure
from pipeline.report.style import AFTER, BEFORE, label, layout, level_line, number, rounded, trace
from robcal.photogrammetry.core.camera import INTRINSIC_NAMES, Camera
from robcal.transforms import Array

_RADIAL = tuple(INTRINSIC_NAMES.index(name) for name in ("k1", "k2", "k3"))


def lens_figure(name: str, camera: Camera, covariance: Array, marks: Array) -> Figure:
    """Radial distortion (px) over the radius, with the band of two sigma from the covariance of k1, k2, k3.

    `marks` (n, 2) in pixels: the curve ends with the outermost, beyond it nothing was seen.
    """
    corner = np.array([max(camera.cx, camera.width - camera.cx), max(camera.cy, camera.height - camera.cy)])
    end = float(np.hypot(*(corner / [camera.fx, camera.fy])))
    if len(marks):
        away = np.linalg.norm((marks - [camera.cx, camera.cy]) / [camera.fx, camera.fy], axis=1)
        end = min(end, float(away.max()))
    r = np.linspace(0, end, 80)
    f = 0.5 * (camera.fx + camera.fy)
    J = np.stack([r**3, r**5, r**7], axis=1) * f
    shift = J @ np.array([camera.k1, camera.k2, camera.k3])
    sigma = np.sqrt(np.clip(np.einsum("ni,ij,nj->n", J, covariance[np.ix_(_RADIAL, _RADIAL)], J), 0, None))
    x = rounded(r * f)
    band = {"type": "scatter", "mode": "lines", "line": {"width": 0}, "showlegend": False, "hoverinfo": "skip"}
    data: list[dict[str, Any]] = [
        {**band, "x": x, "y": rounded(shift - 2 * sigma)},
        {
            **band,
            "x": x,
            "y": rounded(shift + 2 * sigma),
            "fill": "tonexty",
            "fillcolor": "rgba(0,114,178,0.22)",
            "name": "two sigma",
            "showlegend": True,
        },
        trace("scatter lines", (x, rounded(shift)), "identified", line={"color": AFTER, "width": 3}),
        trace(
            "scatter lines", ([x[0], x[-1]], [0, 0]), "camera file", line={"color": BEFORE, "width": 2, "dash": "dash"}
        ),
    ]
    message = (
        f"Radial distortion of {label(name)} out to the outermost target: the camera file has none, the images do."
    )
    return Figure(
        tuple(data),
        layout("distance from the principal point (px)", "radial shift (px)"),
        message,
        f"Radial distortion of {name}",
        height=320,
    )


def gains_figure(
    causes: Sequence[dict[str, Any]], names: Sequence[str], key: str, floor: float | None
) -> Figure | None:
    """Error on kept-out data without and with each cause, those before it in the list included."""
    unit = key.removeprefix("heldout_")
    held = [(n, c[key]) for c, n in zip(causes, names, strict=True) if c.get(key)]
    if not held or any(h.get("before") is None or h.get("after") is None for _, h in held):
        return None
    y = [f"{k}. {label(n)}" for k, (n, _) in enumerate(held, 1)]
    data = tuple(
        trace(
            "bar",
            (rounded([h[kind] for _, h in held]), y),
            name,
            orientation="h",
            marker={"color": colour},
            text=[number(h[kind]) for _, h in held],
            textposition="outside",
            cliponaxis=False,
        )
        for kind, name, colour in (("after", "with it", AFTER), ("before", "without it", BEFORE))
    )
    shapes = []
    if floor:
        shapes = [level_line("x", floor)]
    return Figure(
        data,
        layout(
            f"error ({unit}, RMS)",
            "",
            shapes=shapes,
            barmode="group",
            legend={"traceorder": "reversed"},
            margin={"r": 60},
            yaxis={"type": "category", "autorange": "reversed"},
        ),
        "Error on kept-out data without and with each cause. Dashed: noise of the measurement.",
        "Error on kept-out data without and with each cause",
        height=130 + 62 * len(held),
    )
