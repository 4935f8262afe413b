"""A (calibrated) robot as URDF, from its numbers alone or into a description that exists.

Weakness: URDF knows neither elasticities nor extra terms; of a calibrated robot it carries the geometry only. Meshes
are neither read nor written: with a template its visual and collision elements stay as they are. What simulators demand
and a calibration does not know (effort, velocity, moments of inertia) gets the assumptions named in the file.
"""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any
from xml.etree import ElementTree

import numpy as np

from robcal.errors import InvalidInput
from robcal.robot.model import Frame, RobotModel
from robcal.robot.urdf_chain import NEGLIGIBLE_MASS, UrdfStep, chain_steps, model_from_urdf, parse_urdf, turn_x_to
from robcal.transforms import Array, frame, frame_from_xyzrpy, invert, rotation_from_rpy, rpy_from_rotation

EFFORT = 1e5
"""N m or N: no limit in practice; a limit of 0 would forbid every motion."""
VELOCITY = math.pi
"""rad/s or m/s, of the order of an industrial robot's axis."""
DENSITY = 2000.0
"""kg/m3 of the solid spheres that stand for the links' unknown moments of inertia (a casting with its cavities)."""
_NOTE = (
    " geometry with identified deviations; elasticities and extra terms left out. Not known, assumed: effort and "
    "velocity limits; moments of inertia (solid spheres of the links' masses, 2000 kg/m3); links without known mass "
    "weigh 1 g "
)


def urdf_text(model: RobotModel, template: str | None = None) -> str:
    """URDF of a robot with its geometric deviations included; elasticities and terms are left out.

    Parameters
    ----------
    template : URDF text whose joint origins and axes are replaced, everything else (meshes, inertias, other links) left
        alone; the robot must come from it (same joints in the same order).

    Raises
    ------
    InvalidInput : the template's joints are not the robot's; a Stewart platform, a four-bar, loops with a template.
    """
    if model.is_hexapod:
        raise InvalidInput(f"URDF has no closed chains: it cannot express the Stewart platform '{model.name}'")
    bars = [f.name for f in model.frames if f.fourbar is not None]
    if bars:
        raise InvalidInput(
            f"URDF cannot express the four-bar of frame '{bars[0]}': its mimic joints are linear; export C, or the "
            "numbers with --data"
        )
    if template is not None and model.has_loops:
        raise InvalidInput("a URDF template cannot take loops of joints: export without a template")
    return _from_template(model, template) if template is not None else _plain(model)


def calibrated_frames(model: RobotModel) -> tuple[Frame, ...]:
    """The chain with its geometric deviations put into the nominal numbers."""
    out = []
    for f in model.frames:
        d = [model.parameters.get(f"{f.name}.{k}", 0.0) for k in ("x", "y", "z", "roll", "pitch", "yaw")]
        xyz, rpy = np.add(f.xyz, d[:3]), np.add(f.rpy, d[3:])
        out.append(replace(f, xyz=_triple(xyz), rpy=_triple(rpy)))
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


def _plain(model: RobotModel) -> str:
    root = ElementTree.Element("robot", name=model.name)
    root.append(ElementTree.Comment(_NOTE))
    parent = "base_link"
    ElementTree.SubElement(root, "link", name=parent)
    for f in calibrated_frames(model):
        link = f"{f.name}_link"
        element = ElementTree.SubElement(root, "link", name=link)
        if f.mass > 0 or f.axis is not None:
            _add_inertial(element, f)
        kind = "fixed" if f.axis is None else "prismatic" if f.prismatic else "revolute" if f.limits else "continuous"
        place: tuple[Any, Any] = (f.xyz, f.rpy)
        for k, coefficient in f.follows[: None if f.is_joint else -1]:
            between = f"{f.name}_with_{model.joints[k].name}"
            _add_mimic(root, model, f, (k, coefficient), (between, parent, between + "_link", *place))
            parent, place = between + "_link", ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
            ElementTree.SubElement(root, "link", name=parent)
        if f.passive:
            _add_mimic(root, model, f, f.follows[-1], (f.name, parent, link, *place))
            parent = link
            continue
        joint = _add_joint(root, f.name, kind, parent, link, *place)
        if f.axis is not None:
            ElementTree.SubElement(joint, "axis", xyz=_text(joint_axis_in_child(f)))
            limits = {"effort": repr(EFFORT), "velocity": repr(VELOCITY)}
            if kind != "continuous":
                low, high = f.limits or (-1e3, 1e3)
                limits = {"lower": repr(float(low)), "upper": repr(float(high)), **limits}
            ElementTree.SubElement(joint, "limit", limits)
        parent = link
    if model.flange_T_tool is not None:
        ElementTree.SubElement(root, "link", name="tool_link")
        tool = model.flange_T_tool
        _add_joint(root, "tool", "fixed", parent, "tool_link", tool[:3, 3], rpy_from_rotation(tool[:3, :3]))
    ElementTree.indent(root)
    return '<?xml version="1.0"?>\n' + ElementTree.tostring(root, encoding="unicode") + "\n"


def _add_mimic(
    root: ElementTree.Element,
    model: RobotModel,
    f: Frame,
    turn: tuple[int, float],
    place: tuple[str, str, str, Any, Any],
) -> None:
    """A joint (name, parent, child, xyz, rpy) that turns frame f by so much of another's true angle, zero included."""
    k, coefficient = turn
    name, parent, child, xyz, rpy = place
    joint = _add_joint(root, name, "continuous", parent, child, xyz, rpy)
    ElementTree.SubElement(joint, "axis", xyz=_text(joint_axis_in_child(replace(f, sign=1))))
    ElementTree.SubElement(joint, "limit", effort=repr(EFFORT), velocity=repr(VELOCITY))
    driver = model.joints[k]
    offset = coefficient * driver.zero_sign * model.parameters.get(driver.zero_name, 0.0)
    attributes = {"joint": driver.name, "multiplier": repr(coefficient), "offset": repr(offset)}
    ElementTree.SubElement(joint, "mimic", attributes)


def _add_joint(
    root: ElementTree.Element, name: str, kind: str, parent: str, child: str, xyz: Any, rpy: Any
) -> ElementTree.Element:
    joint = ElementTree.SubElement(root, "joint", name=name, type=kind)
    ElementTree.SubElement(joint, "parent", link=parent)
    ElementTree.SubElement(joint, "child", link=child)
    ElementTree.SubElement(joint, "origin", xyz=_text(xyz), rpy=_text(rpy))
    return joint


def _add_inertial(link: ElementTree.Element, f: Frame) -> None:
    """Mass, centre of gravity, and the moment of inertia of a solid sphere: 2/5 m r^2."""
    mass = max(float(f.mass), NEGLIGIBLE_MASS)
    radius = (3.0 * mass / (4.0 * math.pi * DENSITY)) ** (1.0 / 3.0)
    moment = repr(0.4 * mass * radius**2)
    inertial = ElementTree.SubElement(link, "inertial")
    ElementTree.SubElement(inertial, "origin", xyz=_text(f.cog), rpy="0 0 0")
    ElementTree.SubElement(inertial, "mass", value=repr(mass))
    ElementTree.SubElement(inertial, "inertia", ixx=moment, ixy="0", ixz="0", iyy=moment, iyz="0", izz=moment)


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
    for step, (origin, axis) in zip(steps, calibrated_origins(model, nominal, steps), strict=True):
        _replace(elements[step.name], "origin", xyz=_text(origin[:3, 3]), rpy=_text(rpy_from_rotation(origin[:3, :3])))
        _replace(elements[step.name], "axis", xyz=_text(axis))
    return '<?xml version="1.0"?>\n' + ElementTree.tostring(root, encoding="unicode") + "\n"


def calibrated_origins(model: RobotModel, nominal: RobotModel, steps: Sequence[UrdfStep]) -> list[tuple[Array, Array]]:
    """Origin (4, 4) and axis (3,) of each moving joint, in URDF's sense, with the deviations of a calibrated robot.

    ``nominal`` is the robot as it was read from the joints ``steps`` (fixed ones between them left out).
    """
    found = []
    old, new = np.eye(4), np.eye(4)  # from the joint frame before, fixed frames between included
    moving = iter(steps)
    for before, after in zip(nominal.frames, calibrated_frames(model), strict=True):
        old, new = (T @ frame_from_xyzrpy([*f.xyz, *f.rpy]) for T, f in ((old, before), (new, after)))
        if before.axis is None:
            continue
        step = next(moving)
        link_T_frame = _link_T_frame(step, before)
        # old = carry origin link_T_frame; what stands before the joint's own origin stays
        carry = old @ invert(link_T_frame) @ invert(step.origin)
        origin = invert(carry) @ new @ invert(link_T_frame)
        found.append((origin, link_T_frame[:3, :3] @ joint_axis_in_child(after)))
        old, new = np.eye(4), np.eye(4)
    return found


def _link_T_frame(step: UrdfStep, before: Frame) -> Array:
    """How the project's frame of a joint is turned against URDF's child link (identity for direct joints)."""
    direct = joint_axis_in_child(before)
    if np.linalg.norm(direct - step.axis) < 1e-6:
        return np.eye(4)
    return frame(turn_x_to(step.axis), np.zeros(3))


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
