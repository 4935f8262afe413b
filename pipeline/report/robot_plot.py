"""The robot as a stick figure with the places marked where something was found."""

from typing import Any

import numpy as np

from pipeline.report.blocks import Figure
from pipeline.report.material import Material
from pipeline.report.style import ACCENT, AFTER, GREEN, INK, label, rounded, scene, trace
from robcal.robot.chain import Chain, chain_of, cumulative_motions
from robcal.robot.model import RobotModel
from robcal.transforms import Array, invert

_AXIS = {"x": 0, "y": 1, "z": 2}


def robot_figure(material: Material, causes: list[dict[str, Any]]) -> Figure | None:
    """The robot in the recorded pose that carries most of what was found; None where no place is on it."""
    calibrated = material.calibrated
    if calibrated is None or calibrated.q is None:
        return None
    model: RobotModel = calibrated.model
    chain = chain_of(model)
    row, pose = _pose(material, causes)
    motion = cumulative_motions(chain, calibrated.q[row : row + 1])[0]
    frames = np.array([motion[m + 1] @ T for m, T in zip(chain.moved_by, chain.frames_home, strict=True)])
    tool = motion[-1] @ chain.home @ (np.eye(4) if model.flange_T_tool is None else np.asarray(model.flange_T_tool))
    stick = np.vstack([np.zeros(3), frames[:, :3, 3], tool[:3, 3]])
    size = float(np.linalg.norm(np.ptp(stick, axis=0)))
    data: list[dict[str, Any]] = []
    data.append(_line(stick, "robot", INK, 12))
    data += _triad(tool, 0.08 * size)
    lines = chain.line_of_joint
    joints = np.array([motion[k][:3, :3] @ chain.points[k] + motion[k][:3, 3] for k in lines])
    data.append(_dots(joints, "joints", AFTER, 7, [f"axis {k + 1}: {n}" for k, n in enumerate(chain.names)]))
    marked = []
    for cause in causes:
        found = _place(cause, model, chain, motion, frames, tool)
        if found is None:
            continue
        centre, line, name = found
        marked.append(name)
        if line is not None:
            ends = np.vstack([centre - 0.14 * size * line, centre + 0.14 * size * line])
            data.append(_line(ends, name, ACCENT, 8))
        data.append(_dots(centre[None], name, ACCENT, 11, [name]))
    if not marked:
        return None
    return Figure(
        tuple(data),
        scene(data, scene={"annotations": [_note(data, n) for n in dict.fromkeys(marked)]}),
        f"Where it acts: {', '.join(dict.fromkeys(marked))}. The robot in pose {pose}, base coordinates.",
        "The robot as a stick figure with the place marked",
        height=460,
    )


def _triad(frame: Array, size: float) -> list[dict[str, Any]]:
    """The tool's axes, so that the eye finds the robot's end."""
    colours = (ACCENT, GREEN, AFTER)
    ends = [np.vstack([frame[:3, 3], frame[:3, 3] + size * frame[:3, k]]) for k in range(3)]
    return [_line(end, f"tool {'xyz'[k]}", colours[k], 5) for k, end in enumerate(ends)]


def _pose(material: Material, causes: list[dict[str, Any]]) -> tuple[int, str]:
    for cause in causes:
        for name in cause.get("poses") or []:
            if name in material.pose_names:
                return material.pose_names.index(name), name
    return 0, material.pose_name(0)


def _place(
    cause: dict[str, Any], model: RobotModel, chain: Chain, motion: Array, frames: Array, tool: Array
) -> tuple[Array, Array | None, str] | None:
    """Centre, direction and name of a place in base coordinates."""
    where, direction, stage = str(cause.get("where")), cause.get("direction"), cause.get("stage")
    if where.startswith("axis") and where[4:].isdigit() and 0 < int(where[4:]) <= chain.n_joints:
        joint = int(where[4:]) - 1
        k = int(chain.line_of_joint[joint])
        centre = motion[k][:3, :3] @ chain.points[k] + motion[k][:3, 3]
        own = model.joints[joint]
        if direction in _AXIS and direction != own.axis:
            at = [f.name for f in model.frames].index(own.name)
            return centre, frames[at][:3, _AXIS[direction]], f"axis {joint + 1}, direction {direction}"
        return centre, motion[k][:3, :3] @ chain.axes[k], f"axis {joint + 1}"
    if where == "base":
        return np.zeros(3), np.array([0.0, 0.0, 1.0]), "base"
    if stage == "body" or where in model.payloads or where == "tool":
        return tool[:3, 3], None, "load" if where in model.payloads else f"body: {where}"
    if stage == "camera" and model.world_T_base is not None and where == "station":
        return invert(np.asarray(model.world_T_base))[:3, 3], None, "station (origin of the measuring system)"
    return None


def _line(points: Array, name: str, colour: str, width: int) -> dict[str, Any]:
    return trace(
        "scatter3d lines",
        (rounded(points[:, 0], 5), rounded(points[:, 1], 5), rounded(points[:, 2], 5)),
        label(name),
        line={"color": colour, "width": width},
        hoverinfo="skip",
        showlegend=False,
    )


def _dots(points: Array, name: str, colour: str, size: float, text: list[str] | None = None) -> dict[str, Any]:
    return trace(
        "scatter3d markers",
        (rounded(points[:, 0], 5), rounded(points[:, 1], 5), rounded(points[:, 2], 5)),
        label(name),
        marker={"color": colour, "size": size},
        text=[label(t) for t in text or [name] * len(points)],
        hovertemplate="%{text}<extra></extra>",
        showlegend=False,
    )


def _note(data: list[dict[str, Any]], name: str) -> dict[str, Any]:
    mark = next(d for d in data if d["name"] == label(name) and d["mode"] == "markers")
    at = {axis: mark[axis][0] for axis in ("x", "y", "z")}
    return {
        **at,
        "text": f"<b>{label(name)}</b>",
        "ax": 60,
        "ay": -50,
        "font": {"color": ACCENT, "size": 15},
        "arrowcolor": ACCENT,
        "bgcolor": "rgba(255,255,255,0.85)",
    }
