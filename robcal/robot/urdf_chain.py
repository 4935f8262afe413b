"""Reading a URDF safely, and the joints on the way from its root to its tip."""

from __future__ import annotations

import io
import re
from dataclasses import dataclass
from typing import Any
from xml.etree import ElementTree

import numpy as np

from robcal.errors import InvalidInput
from robcal.transforms import Array


@dataclass(frozen=True)
class UrdfStep:
    """A joint on the way to the tip, as URDF has it."""

    name: str
    kind: str
    origin: Array
    axis: Array
    limits: tuple[float, float] | None
    mass: float
    cog: Array
    child: str


def _yourdfpy() -> Any:
    try:
        import yourdfpy
    except ImportError as error:
        raise InvalidInput("reading and writing URDF needs the package yourdfpy: pip install robcal[urdf]") from error
    return yourdfpy


def parse_urdf(text: str) -> Any:
    """yourdfpy's robot of a URDF text, without meshes.

    Raises
    ------
    InvalidInput : no URDF, broken XML, or XML with entities.
    """
    yourdfpy = _yourdfpy()
    # entities are how hostile XML grows; a robot description has no use for them
    if re.search(r"<!(DOCTYPE|ENTITY)", text, re.IGNORECASE):
        raise InvalidInput("the URDF declares a document type or entities, which is refused; remove them")
    if "<robot" not in text:
        raise InvalidInput("the file is no URDF: it has no <robot> element (a xacro file must be expanded first)")
    try:
        ElementTree.fromstring(text)
    except ElementTree.ParseError as error:
        raise InvalidInput(f"the URDF cannot be read, its XML is broken: {error}") from error
    try:
        urdf = yourdfpy.URDF.load(
            io.BytesIO(text.encode()),
            load_meshes=False,
            load_collision_meshes=False,
            build_scene_graph=False,
            build_collision_scene_graph=False,
        )
    except Exception as error:  # yourdfpy and lxml raise their own kinds without a common base
        raise InvalidInput(f"the URDF cannot be read: {str(error)[:200]}") from error
    return urdf.robot


def chain_steps(robot: Any, base: str | None, tip: str | None) -> list[UrdfStep]:
    """Joints from link ``base`` (default the root) to link ``tip`` (default the only end with most joints).

    Raises
    ------
    InvalidInput : unknown links, several possible tips, a loop, or joints that form no chain.
    """
    masses = {link.name: _inertial(link) for link in robot.links}
    parent_joint = {joint.child: joint for joint in robot.joints}
    for link, what in ((base, "base"), (tip, "tip")):
        if link is not None and link not in masses:
            raise InvalidInput(f"URDF '{robot.name}' has no link '{link}' for {what}; it has {', '.join(masses)}")

    def path(link: str) -> list[Any]:
        joints: list[Any] = []
        while link in parent_joint and link != base:
            joint = parent_joint[link]
            joints.append(joint)
            link = joint.parent
            if len(joints) > len(robot.joints):
                raise InvalidInput(f"URDF '{robot.name}': the joints form a loop")
        if base is not None and link != base:
            return []
        return joints[::-1]

    if tip is None:
        parents = {joint.parent for joint in robot.joints}
        ends = [name for name in masses if name not in parents and path(name)]
        moving = {name: sum(j.type != "fixed" for j in path(name)) for name in ends}
        most = max(moving.values(), default=0)
        best = [name for name in ends if moving[name] == most]
        # several ends behind the same last joint (flange, tool0): the one with the longest name list is the farthest
        best.sort(key=lambda name: len(path(name)))
        movers = {tuple(j.name for j in path(name) if j.type != "fixed") for name in best}
        if len(movers) > 1:
            ends_found = ", ".join(sorted(best))
            raise InvalidInput(f"URDF '{robot.name}' has several chains; name the tip, one of {ends_found}")
        if not best:
            raise InvalidInput(f"URDF '{robot.name}' has no joints")
        tip = best[-1]
    joints = path(tip)
    if not joints:
        raise InvalidInput(f"URDF '{robot.name}': no chain leads from '{base}' to '{tip}'")
    return [_step(joint, masses.get(joint.child, (0.0, np.zeros(3)))) for joint in joints]


def _step(joint: Any, inertial: tuple[float, Array]) -> UrdfStep:
    if joint.type not in ("revolute", "continuous", "prismatic", "fixed"):
        raise InvalidInput(f"URDF joint '{joint.name}' is of type '{joint.type}'; only single-axis joints form a chain")
    if getattr(joint, "mimic", None) is not None:
        raise InvalidInput(f"URDF joint '{joint.name}' mimics another one; coupled joints are given as a term instead")
    origin = np.eye(4) if joint.origin is None else np.asarray(joint.origin, dtype=float)
    axis = np.array([1.0, 0.0, 0.0]) if joint.axis is None else np.asarray(joint.axis, dtype=float)
    length = float(np.linalg.norm(axis))
    if not np.all(np.isfinite(origin)) or not (length > 1e-9 or joint.type == "fixed"):
        raise InvalidInput(f"URDF joint '{joint.name}': origin and axis must be finite, the axis not zero")
    limits = None
    if joint.type in ("revolute", "prismatic") and joint.limit is not None:
        limits = (float(joint.limit.lower or 0.0), float(joint.limit.upper or 0.0))
        if limits == (0.0, 0.0):
            limits = None
    mass, cog = inertial
    axis = axis / max(length, 1e-9)
    return UrdfStep(str(joint.name), str(joint.type), origin, axis, limits, mass, cog, str(joint.child))


def _inertial(link: Any) -> tuple[float, Array]:
    if link.inertial is None or link.inertial.mass is None:
        return 0.0, np.zeros(3)
    origin = np.eye(4) if link.inertial.origin is None else np.asarray(link.inertial.origin, dtype=float)
    return float(link.inertial.mass), origin[:3, 3]
