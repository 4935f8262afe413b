"""Chapter: how far the robot may be off where it was not measured, how the joints were covered, and what would help."""

from typing import Any

import numpy as np

from pipeline.report.blocks import Block, Chapter, Figure, Text, table
from pipeline.report.material import Material
from pipeline.report.style import ACCENT, AFTER, GREEN, GREY, PAPER, label, layout, number, percent, rounded, trace
from pipeline.report.verification_chapter import tolerance_mm
from robcal.calibration.calibrated import CalibratedRobot
from robcal.calibration.measurements import Rows
from robcal.calibration.observations import FrameObservations
from robcal.calibration.workspace import (
    Proposals,
    WorkspaceMap,
    cylindrical,
    helpful_poses,
    joint_limits,
    largest_gaps,
    loads_of,
    sampled,
    workspace_map,
)
from robcal.transforms import Array

MOST_LOADS = 4


def workspace_chapter(material: Material) -> Chapter:
    """Map of the predicted error by load, coverage of the joints, proposals."""
    blocks: list[Block] = []
    robot = material.calibrated
    if robot is not None and len(robot.names) and robot.q is not None and len(robot.q) and material.verification:
        q = sampled(robot)
        campaign = material.campaign
        log = None if campaign is None else campaign.poses
        loads = (None,) if log is None else loads_of(log.payload)[:MOST_LOADS]
        maps = [workspace_map(robot, load, q) for load in loads]
        blocks.append(_numbers(maps, tolerance_mm(material)))
        ends = min(float(np.nanmin(m.worst)) for m in maps), max(float(np.nanpercentile(m.worst, 99)) for m in maps)
        blocks += [_map(material, robot, m, ends, wide=len(maps) == 1) for m in maps]
        proposals = helpful_poses(robot, loads[0], _accuracy(material, robot), q)
        blocks += [_coverage(material, robot, proposals), *_proposed(robot, proposals)]
    return Chapter(
        "workspace",
        "Predicted error over the workspace",
        "How far the tool may be from where the model says, from the covariance of the parameters: small where the "
        "measured poses tell, larger beyond. What no model explains is not in it; the errors above test that.",
        tuple(blocks),
    )


def _accuracy(material: Material, robot: CalibratedRobot) -> Array:
    """Covariance (6, 6) of a measured frame: the median of those recorded, else what the noise suggests."""
    found = material.identification
    frames = [o for o in found.recording.observations if isinstance(o, FrameObservations)] if found else []
    if frames:
        return np.asarray(np.median(np.concatenate([o.covariance for o in frames]), axis=0)) * robot.covariance_scale
    noise = float((material.result.get("noise") or {}).get("measurement_mm") or 0.05) / 1e3 / np.sqrt(3)
    return np.diag([noise**2] * 3 + [(noise / 0.2) ** 2] * 3)


def _load(payload: str | None) -> str:
    return payload or "no load"


def _numbers(maps: list[WorkspaceMap], tolerance: float | None) -> Block:
    rows = []
    for m in maps:
        worst = int(np.argmax(m.error))
        row = [
            _load(m.payload),
            *(number(1e3 * v) for v in (np.median(m.error), np.percentile(m.error, 95), m.error[worst])),
            ", ".join(f"{v:.0f}" for v in np.degrees(m.q[worst])),
        ]
        rows.append(row + ([] if tolerance is None else [percent(float(np.mean(1e3 * m.error <= tolerance)))]))
    columns = ["Load", "Median (mm)", "95 % below (mm)", "Worst (mm)", "Worst at joint angles (deg)"]
    if tolerance is not None:
        columns.append(f"Poses within {number(tolerance)} mm")
    return table(
        columns,
        rows,
        f"Predicted error (one sigma, in space) at {len(maps[0].q)} poses spread over the ranges of the joints.",
        text=(0, 4),
        emphasis=(3,),
    )


def _map(
    material: Material, robot: CalibratedRobot, m: WorkspaceMap, ends: tuple[float, float], *, wide: bool
) -> Figure:
    heat = trace(
        "heatmap",
        (rounded(m.radius), rounded(m.height), [rounded(1e3 * row, 3) for row in m.worst]),
        "worst predicted error",
        colorscale="Viridis",
        zmin=1e3 * ends[0],
        zmax=1e3 * ends[1],
        colorbar={"title": {"text": "mm"}, "thickness": 12},
        hovertemplate="%{x:.2f} m out, %{y:.2f} m up: %{z:.3g} mm<extra></extra>",
    )
    rows = _driven(material, robot, m.payload)
    tools = robot.tools if robot.tools is not None else np.zeros((0, 4, 4))
    rows = rows[rows < len(tools)]
    radius, height = cylindrical(robot, tools[rows])
    dots = trace(
        "scatter markers",
        (rounded(radius), rounded(height)),
        "measured poses",
        marker={"size": 6, "color": "rgba(0,0,0,0)", "line": {"color": PAPER, "width": 1.5}},
        text=[label(material.pose_name(int(r))) for r in rows],
        customdata=[int(r) for r in rows],
        hovertemplate="%{text}<extra></extra>",
    )
    return Figure(
        (heat, dots),
        layout(
            "distance from the base's axis (m)",
            "height above the base (m)",
            yaxis={"scaleanchor": "x", "constrain": "domain"},
            xaxis={"constrain": "domain"},
            showlegend=False,
        ),
        f"Load: {_load(m.payload)}. The worst predicted error in each cell around the base's axis; rings: measured "
        "poses. Empty cells are out of reach.",
        f"Map of the predicted error, {_load(m.payload)}",
        height=430,
        wide=wide,
    )


def _driven(material: Material, robot: CalibratedRobot, payload: str | None) -> Rows:
    campaign = material.campaign
    every = np.arange(0 if robot.q is None else len(robot.q))
    if campaign is None or campaign.poses is None or len(campaign.poses.payload) != len(every):
        return every
    return every[[(p or None) == payload for p in campaign.poses.payload]]


def _coverage(material: Material, robot: CalibratedRobot, proposals: Proposals | None) -> Figure:
    lower, upper = joint_limits(robot)
    q = np.asarray(robot.q)
    share, start, end = largest_gaps(q, lower, upper)
    scale = upper - lower
    names = [f"joint {k + 1}" for k in range(q.shape[1])]
    campaign = material.campaign
    kept_out = np.zeros(len(q), dtype=bool)
    if campaign is not None and campaign.poses is not None and len(campaign.poses.verify) == len(q):
        kept_out = np.asarray(campaign.poses.verify)
    data: list[dict[str, Any]] = []
    for told, which, style in (
        ("identifies", ~kept_out, {"color": AFTER, "size": 7, "opacity": 0.7}),
        ("kept out", kept_out, {"color": GREEN, "size": 8, "symbol": "diamond-open"}),
    ):
        rows = np.flatnonzero(which)
        if len(rows):
            data.append(_strips(q[rows], names, (lower, scale), told, style) | {"customdata": _each(rows, len(names))})
    if proposals is not None:
        style = {"color": ACCENT, "size": 11, "symbol": "star"}
        data.append(_strips(proposals.q, names, (lower, scale), "would help", style))
    gaps = [
        {
            "type": "rect",
            "x0": float((a - lo) / s),
            "x1": float((b - lo) / s),
            "y0": k - 0.3,
            "y1": k + 0.3,
            "fillcolor": GREY,
            "opacity": 0.25,
            "line": {"width": 0},
        }
        for k, (a, b, lo, s) in enumerate(zip(start, end, lower, scale, strict=True))
    ]
    worst = int(np.argmin(share))
    return Figure(
        tuple(data),
        layout(
            "share of the joint's range, from its lower to its upper limit",
            "",
            xaxis={"range": [-0.02, 1.02], "tickformat": ".0%"},
            yaxis={"autorange": "reversed", "type": "category"},
            shapes=gaps,
        ),
        f"Where the joints were driven. Shaded: the largest part of each range without a pose. Least covered: joint "
        f"{worst + 1}, over {percent(float(share[worst]))} of its range.",
        "Joint angles of all poses, joint by joint",
        height=330,
    )


def _each(rows: Rows, joints: int) -> list[int]:
    return [int(r) for r in rows for _ in range(joints)]


def _strips(
    q: Array, names: list[str], limits: tuple[Array, Array], told: str, style: dict[str, Any]
) -> dict[str, Any]:
    lower, scale = limits
    return trace(
        "scatter markers",
        (rounded(((q - lower) / scale).ravel()), names * len(q)),
        told,
        marker=style,
        text=[f"{v:.1f}" for v in np.degrees(q).ravel()],
        hovertemplate="%{y}: %{text} deg<extra>" + told + "</extra>",
    )


def _proposed(robot: CalibratedRobot, found: Proposals | None) -> list[Block]:
    if found is None:
        return [Text("No further poses are proposed: none of the sampled ones lies and looks like those recorded.")]
    rows = [
        [str(k + 1), *(f"{v:.1f}" for v in np.degrees(q)), number(1e3 * after)]
        for k, (q, after) in enumerate(zip(found.q, found.after, strict=True))
    ]
    lowered = (
        f"Poses that would help, with {_load(found.payload)}: the largest predicted error is now "
        f"{number(1e3 * found.before)} mm, and falls as the last column says when they are measured in this order. "
        "Collisions and sight are not checked here: 'pipeline poses' with this run as its robot does that."
    )
    joints = [f"q{k + 1} (deg)" for k in range(found.q.shape[1])]
    return [table(["", *joints, "Worst then (mm)"], rows, lowered)]
