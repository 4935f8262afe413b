"""URDF in and out: one chain of a description as a robot, and a (calibrated) robot as a description.

The file format is yourdfpy's business; here is only the geometry. URDF turns a child about an arbitrary axis of its own
frame, this project about the line of roll, pitch or yaw: most joints translate directly, the others by turning the
child's frame so that the axis is its x (kept track of, undone behind the last joint).

Weakness: URDF knows neither elasticities nor extra terms; of a calibrated robot it carries the geometry only. Meshes
are neither read nor written: with a template its visual and collision elements stay as they are.
"""

from __future__ import annotations

import math
from typing import Any
from xml.etree import ElementTree

import numpy as np

from robcal.errors import InvalidInput
from robcal.robot.model import Frame, RobotModel
from robcal.robot.urdf_chain import UrdfStep, chain_steps, parse_urdf
from robcal.transforms import Array, frame, frame_from_xyzrpy, invert, rotation_from_rpy, rpy_from_rotation

_ALIGNED = 1e-9
_FIXED_NAMES = {"base": "base_mount", "tool": "tool_mount", "gravity": "gravity_mount", "payload": "payload_mount"}


def model_from_urdf(text: str, base: str | None = None, tip: str | None = None) -> RobotModel:
    """Robot of the chain from link ``base`` (default the root) to link ``tip`` (default the only end with most joints).

    Masses and centres of gravity come from the inertial elements; gravity along -z of the base.

    Raises
    ------
    InvalidInput : no readable URDF, unknown links, several possible tips, or joints of another kind than revolute,
        continuous, prismatic and fixed.
    """
    robot = parse_urdf(text)
    steps = chain_steps(robot, base, tip)
    if not any(s.kind != "fixed" for s in steps):
        raise InvalidInput(f"URDF '{robot.name}': the chain to '{steps[-1].child if steps else tip}' has no joint")
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
    return RobotModel(str(robot.name or "robot"), (*frames, end))


def urdf_text(model: RobotModel, template: str | None = None) -> str:
    """URDF of a robot with its geometric deviations included; elasticities and terms are left out.

    Parameters
    ----------
    template : URDF text whose joint origins and axes are replaced, everything else (meshes, inertias, other links) left
        alone; the robot must come from it (same joints in the same order).

    Raises
    ------
    InvalidInput : the template's joints are not the robot's.
    """
    return _from_template(model, template) if template is not None else _plain(model)


def calibrated_frames(model: RobotModel) -> tuple[Frame, ...]:
    """The chain with its geometric deviations put into the nominal numbers."""
    out = []
    for f in model.frames:
        d = [model.parameters.get(f"{f.name}.{k}", 0.0) for k in ("x", "y", "z", "roll", "pitch", "yaw")]
        xyz, rpy = np.add(f.xyz, d[:3]), np.add(f.rpy, d[3:])
        out.append(Frame(f.name, f.axis, f.prismatic, f.sign, f.limits, _triple(xyz), _triple(rpy), f.mass, f.cog))
    return tuple(out)


def joint_axis_in_child(f: Frame) -> Array:
    """Direction (3,) of positive q in the coordinates of the joint's own frame (URDF's axis)."""
    R = rotation_from_rpy(f.rpy)
    unit = np.eye(3)["xyz".index(f.axis or "z")]
    if f.prismatic or f.axis == "z":
        local = R.T @ unit
    elif f.axis == "y":
        local = R.T @ rotation_from_rpy([0.0, 0.0, f.rpy[2]]) @ unit
    else:
        local = unit
    return f.sign * np.where(np.abs(local) < 1e-15, 0.0, local)


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
        M = frame(_turn_x_to(line), np.zeros(3))
        rest = invert(M) @ G
        mount = Frame(_free_name(f"{step.name}_mount", used), None, rpy=_triple(rpy_from_rotation(M[:3, :3])))
        slide = Frame(name, "x", True, 1, step.limits, _triple(rest[:3, 3]), _triple(rpy_from_rotation(rest[:3, :3])))
        return [mount, slide], np.eye(4)
    Q = _turn_x_to(step.axis)
    made = Frame(name, "x", False, 1, step.limits, xyz, _triple(rpy_from_rotation(R @ Q)))
    return [made], frame(Q.T, np.zeros(3))


def _turn_x_to(a: Array) -> Array:
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


def _plain(model: RobotModel) -> str:
    root = ElementTree.Element("robot", name=model.name)
    root.append(ElementTree.Comment(" geometry with identified deviations; elasticities and extra terms left out "))
    frames = calibrated_frames(model)
    parent = "base_link"
    ElementTree.SubElement(root, "link", name=parent)
    for f in frames:
        link = f"{f.name}_link"
        element = ElementTree.SubElement(root, "link", name=link)
        if f.mass > 0:
            inertial = ElementTree.SubElement(element, "inertial")
            ElementTree.SubElement(inertial, "origin", xyz=_text(f.cog), rpy="0 0 0")
            ElementTree.SubElement(inertial, "mass", value=repr(float(f.mass)))
            # moments of inertia are not known here and play no part in statics
            ElementTree.SubElement(inertial, "inertia", ixx="0", ixy="0", ixz="0", iyy="0", iyz="0", izz="0")
        kind = "fixed" if f.axis is None else "prismatic" if f.prismatic else "revolute" if f.limits else "continuous"
        joint = ElementTree.SubElement(root, "joint", name=f.name, type=kind)
        ElementTree.SubElement(joint, "parent", link=parent)
        ElementTree.SubElement(joint, "child", link=link)
        ElementTree.SubElement(joint, "origin", xyz=_text(f.xyz), rpy=_text(f.rpy))
        if f.axis is not None:
            ElementTree.SubElement(joint, "axis", xyz=_text(joint_axis_in_child(f)))
        if kind in ("revolute", "prismatic"):
            low, high = f.limits or (-1e3, 1e3)
            ElementTree.SubElement(
                joint, "limit", lower=repr(float(low)), upper=repr(float(high)), effort="0", velocity="0"
            )
        parent = link
    if model.flange_T_tool is not None:
        ElementTree.SubElement(root, "link", name="tool_link")
        joint = ElementTree.SubElement(root, "joint", name="tool", type="fixed")
        ElementTree.SubElement(joint, "parent", link=parent)
        ElementTree.SubElement(joint, "child", link="tool_link")
        rpy = rpy_from_rotation(model.flange_T_tool[:3, :3])
        ElementTree.SubElement(joint, "origin", xyz=_text(model.flange_T_tool[:3, 3]), rpy=_text(rpy))
    ElementTree.indent(root)
    return '<?xml version="1.0"?>\n' + ElementTree.tostring(root, encoding="unicode") + "\n"


def _from_template(model: RobotModel, template: str) -> str:
    robot = parse_urdf(template)
    steps = [s for s in chain_steps(robot, None, None) if s.kind != "fixed"]
    nominal = model_from_urdf(template)
    if [f.name for f in nominal.joints] != [f.name for f in model.joints] or len(nominal.frames) != len(model.frames):
        raise InvalidInput(
            f"the URDF template has the joints {', '.join(s.name for s in steps)}, the robot "
            f"{', '.join(f.name for f in model.joints)}; give the description the robot was read from"
        )
    builder = ElementTree.TreeBuilder(insert_comments=True)
    root = ElementTree.fromstring(template, parser=ElementTree.XMLParser(target=builder))
    elements = {e.get("name"): e for e in root.iter("joint") if e.find("parent") is not None}
    frames = list(zip(nominal.frames, calibrated_frames(model), strict=True))
    old, new = np.eye(4), np.eye(4)  # from the joint frame before, fixed frames between included
    moving = iter(steps)
    for before, after in frames:
        old, new = (T @ frame_from_xyzrpy([*f.xyz, *f.rpy]) for T, f in ((old, before), (new, after)))
        if before.axis is None:
            continue
        step = next(moving)
        link_T_frame = _link_T_frame(step, before)
        # old = carry origin link_T_frame; what stands before the joint's own origin stays
        carry = old @ invert(link_T_frame) @ invert(step.origin)
        origin = invert(carry) @ new @ invert(link_T_frame)
        axis = link_T_frame[:3, :3] @ joint_axis_in_child(after)
        _replace(elements[step.name], "origin", xyz=_text(origin[:3, 3]), rpy=_text(rpy_from_rotation(origin[:3, :3])))
        _replace(elements[step.name], "axis", xyz=_text(axis))
        old, new = np.eye(4), np.eye(4)
    return '<?xml version="1.0"?>\n' + ElementTree.tostring(root, encoding="unicode") + "\n"


def _link_T_frame(step: UrdfStep, before: Frame) -> Array:
    """How the project's frame of a joint is turned against URDF's child link (identity for direct joints)."""
    direct = joint_axis_in_child(before)
    if np.linalg.norm(direct - step.axis) < 1e-6:
        return np.eye(4)
    return frame(_turn_x_to(step.axis), np.zeros(3))


def _replace(joint: ElementTree.Element, tag: str, **attributes: str) -> None:
    element = joint.find(tag)
    if element is None:
        element = ElementTree.SubElement(joint, tag)
    for key, value in attributes.items():
        element.set(key, value)


def _text(values: Any) -> str:
    return " ".join(repr(float(v)) if math.isfinite(v) else "0" for v in values)


def _triple(values: Any) -> tuple[float, float, float]:
    x, y, z = (float(v) for v in values)
    return x, y, z
