"""One chain of a URDF as a robot.

The file format is yourdfpy's business; here is only the geometry. URDF turns a child about an arbitrary axis of its own
frame, this project about the line of roll, pitch or yaw: most joints translate directly, the others by turning the
child's frame so that the axis is its x (kept track of, undone behind the last joint).
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

from robcal.errors import InvalidInput
from robcal.robot.model import Frame, RobotModel
from robcal.robot.urdf_chain import UrdfStep, chain_steps, parse_urdf
from robcal.transforms import Array, frame, invert, rotation_from_rpy, rpy_from_rotation

_ALIGNED = 1e-9
_FIXED_NAMES = {"base": "base_mount", "tool": "tool_mount", "gravity": "gravity_mount", "payload": "payload_mount"}


def model_from_urdf(text: str, base: str | None = None, tip: str | None = None) -> RobotModel:
    """Robot of the chain from link ``base`` (default the root) to link ``tip`` (default the only end with most joints,
    grippers left out).

    Masses and centres of gravity come from the inertial elements, those of side branches (cameras, grippers, drives) at
    their zero position included; gravity along -z of the base.

    Raises
    ------
    InvalidInput : no readable URDF, unknown links, several possible tips, or joints of another kind than revolute,
        continuous, prismatic and fixed.
    """
    robot = parse_urdf(text)
    steps = chain_steps(robot, base, tip)
    if not any(s.kind != "fixed" for s in steps):
        raise InvalidInput(f"URDF '{robot.name}': the chain to '{steps[-1].child if steps else tip}' has no joint")
    return model_from_steps(str(robot.name or "robot"), steps)


def model_from_steps(name: str, steps: Sequence[UrdfStep]) -> RobotModel:
    """Robot of joints about arbitrary axes, in order from the base; its last frame is the fixed ``flange``."""
    frames: list[Frame] = []
    carry = np.eye(4)
    used: set[str] = set()
    for step in steps:
        G = carry @ step.origin
        if step.kind == "fixed":
            # its link's mass hangs on the frame before (or stands still)
            carry = G
            if step.mass > 0 and frames:
                frames[-1] = _with_mass(frames[-1], step.mass, (G @ np.append(step.cog, 1.0))[:3])
            continue
        made, carry = _frames_of(step, G, used)
        cog = (carry @ np.append(step.cog, 1.0))[:3]
        frames += [*made[:-1], _with_mass(made[-1], step.mass, cog)]
    rpy = _triple(rpy_from_rotation(carry[:3, :3]))
    end = Frame(_free_name("flange", used), None, xyz=_triple(carry[:3, 3]), rpy=rpy)
    return RobotModel(name, (*frames, end))


def _frames_of(step: UrdfStep, G: Array, used: set[str]) -> tuple[list[Frame], Array]:
    """Frames for a joint whose URDF frame is G in the frame before, and the link as seen from the last of them."""
    R, name = G[:3, :3], _free_name(step.name, used)
    xyz, rpy = _triple(G[:3, 3]), rpy_from_rotation(R)
    sliding = step.kind == "prismatic"
    # the line in parent coordinates, and the three lines that roll, pitch and yaw turn about (or sliding goes along)
    line = R @ step.axis
    yawed = rotation_from_rpy([0.0, 0.0, rpy[2]])
    rotary = {"z": np.eye(3)[2], "x": R[:, 0], "y": yawed[:, 1]}
    for axis, direction in (dict(zip("xyz", np.eye(3), strict=True)) if sliding else rotary).items():
        for sign in (1, -1):
            if np.linalg.norm(line - sign * direction) < _ALIGNED:
                return [Frame(name, axis, sliding, sign, step.limits, xyz, _triple(rpy))], np.eye(4)
    if sliding:
        # a fixed frame before it whose x is the direction
        M = frame(turn_x_to(line), np.zeros(3))
        rest = invert(M) @ G
        mount = Frame(_free_name(f"{step.name}_mount", used), None, rpy=_triple(rpy_from_rotation(M[:3, :3])))
        slide = Frame(name, "x", True, 1, step.limits, _triple(rest[:3, 3]), _triple(rpy_from_rotation(rest[:3, :3])))
        return [mount, slide], np.eye(4)
    Q = turn_x_to(step.axis)
    made = Frame(name, "x", False, 1, step.limits, xyz, _triple(rpy_from_rotation(R @ Q)))
    return [made], frame(Q.T, np.zeros(3))


def turn_x_to(a: Array) -> Array:
    """A rotation whose first column is the direction a."""
    other = np.eye(3)[np.argmin(np.abs(a))]
    y = np.cross(other, a)
    y = y / np.linalg.norm(y)
    return np.stack([a, y, np.cross(a, y)], axis=1)


def _with_mass(f: Frame, mass: float, cog: Array) -> Frame:
    """A mass added to a frame: total mass and common centre of gravity."""
    total = f.mass + mass
    if total == 0:
        return f
    centre = (f.mass * np.array(f.cog) + mass * cog) / total
    return Frame(f.name, f.axis, f.prismatic, f.sign, f.limits, f.xyz, f.rpy, total, _triple(centre))


def _free_name(name: str, used: set[str]) -> str:
    word = _FIXED_NAMES.get(name, name.replace(".", "_")) or "frame"
    candidate, k = word, 2
    while candidate in used:
        candidate, k = f"{word}_{k}", k + 1
    used.add(candidate)
    return candidate


def _triple(values: Any) -> tuple[float, float, float]:
    x, y, z = (float(v) for v in values)
    return x, y, z
