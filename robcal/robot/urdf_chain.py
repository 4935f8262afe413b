"""Reading a URDF safely, and the joints on the way from its root to its tip."""

import io
import math
import re
from dataclasses import dataclass
from typing import Any
from xml.etree import ElementTree

import numpy as np

from robcal.errors import InvalidInput
from robcal.transforms import Array

NEGLIGIBLE_MASS = 1e-3
"""kg; lighter links stand for links of unknown mass (simulators refuse links without)."""
LARGEST_LIMIT = 25.0
"""rad; four turns, more than the cables of any arm allow."""


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
        root = ElementTree.fromstring(text)
    except ElementTree.ParseError as error:
        raise InvalidInput(f"the URDF cannot be read, its XML is broken: {error}") from error
    _check_plain(root)
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


def _check_plain(root: ElementTree.Element) -> None:
    """Refuse what is no finished URDF: macros of xacro, angles in degrees."""
    for element in root.iter():
        macro = "xacro" in str(element.tag) or any(mark in v for v in element.attrib.values() for mark in ("${", "$("))
        if macro:
            raise InvalidInput(
                "the file is a xacro template, not yet a URDF: expand it first ('xacro robot.urdf.xacro > robot.urdf', "
                "with the arguments that your robot needs)"
            )
    for joint in root.iter("joint"):
        for origin in joint.iter("origin"):
            angles = [float(v) for v in re.findall(r"[-+.\deE]+", origin.get("rpy", "")) if re.search(r"\d", v)]
            if max(map(abs, angles), default=0.0) > 2.0 * math.pi + 1e-6:
                raise InvalidInput(
                    f"URDF joint '{joint.get('name')}' has rpy=\"{origin.get('rpy')}\": URDF wants radians, these look "
                    "like degrees; divide them by 57.2958"
                )


def chain_steps(robot: Any, base: str | None, tip: str | None) -> list[UrdfStep]:
    """Joints from link ``base`` (default the root) to link ``tip`` (default the only end with most joints).

    Grippers are left out. A step's mass is that of all links that move with it, side branches included at their zero
    position.

    Raises
    ------
    InvalidInput : unknown links, several possible tips, a loop, or joints that form no chain.
    """
    tree = _Tree(robot, base)
    for link, what in ((base, "base"), (tip, "tip")):
        if link is not None and link not in tree.links:
            raise InvalidInput(f"URDF '{robot.name}' has no link '{link}' for {what}; it has {', '.join(tree.links)}")
    joints = tree.path(tip if tip is not None else tree.only_tip())
    if not joints:
        raise InvalidInput(f"URDF '{robot.name}': no chain leads from '{base}' to '{tip}'")
    chain = {joint.name for joint in joints}
    return [_step(joint, *tree.inertial(joint.child, chain)) for joint in joints]


class _Tree:
    """Links and joints of a description, seen from ``base`` (None: the root)."""

    def __init__(self, robot: Any, base: str | None) -> None:
        self.name, self.base = robot.name, base
        self.links = {link.name: _inertial(link) for link in robot.links}
        self.parent_joint = {joint.child: joint for joint in robot.joints}
        self.child_joints: dict[str, list[Any]] = {}
        for joint in robot.joints:
            self.child_joints.setdefault(joint.parent, []).append(joint)
        self.mimicking = {joint.name for joint in robot.joints if joint.mimic is not None}
        self.mimicking |= {joint.mimic.joint for joint in robot.joints if joint.mimic is not None}

    def path(self, link: str) -> list[Any]:
        """Joints from the base to a link; none if the link does not hang on the base."""
        joints: list[Any] = []
        while link in self.parent_joint and link != self.base:
            joints.append(self.parent_joint[link])
            link = joints[-1].parent
            if len(joints) > len(self.parent_joint):
                raise InvalidInput(f"URDF '{self.name}': the joints form a loop")
        return joints[::-1] if self.base is None or link == self.base else []

    def only_tip(self) -> str:
        """The farthest link behind the last joint of the only chain with most joints."""
        ends = [name for name in self.links if self._ends_arm(name)]
        movers = {name: tuple(j.name for j in self.path(name) if j.type != "fixed") for name in ends}
        most = max(map(len, movers.values()), default=0)
        best = sorted((name for name in ends if len(movers[name]) == most), key=lambda name: len(self.path(name)))
        if len({movers[name] for name in best}) > 1:
            raise InvalidInput(
                f"URDF '{self.name}' has several chains; name the tip: one of their ends ({', '.join(sorted(best))}) "
                f"or, if these are fingers of a gripper, the link before ({self._fork(best)})"
            )
        if not best or not any(self.path(name) for name in best):
            raise InvalidInput(f"URDF '{self.name}' has no joints")
        return best[-1]

    def _ends_arm(self, link: str) -> bool:
        behind = self.child_joints.get(link, [])
        return all(map(self._grips, behind)) and not any(map(self._grips, self.path(link)))

    def _grips(self, joint: Any) -> bool:
        """A joint of a gripper: one that mimics or is mimicked, with nothing but such joints behind it."""
        return joint.type != "fixed" and self._passive(joint)

    def _passive(self, joint: Any) -> bool:
        own = joint.type == "fixed" or joint.name in self.mimicking
        return own and all(map(self._passive, self.child_joints.get(joint.child, [])))

    def _fork(self, ends: list[str]) -> str:
        """The last link that the ways to all these ends share."""
        ways = [[joint.child for joint in self.path(end)] for end in ends]
        shared = [links[0] for links in zip(*ways, strict=False) if len(set(links)) == 1]
        return shared[-1] if shared else self.base or "the root"

    def inertial(self, link: str, chain: set[str]) -> tuple[float, Array]:
        """Mass (kg) and centre of gravity (link coordinates) of a link with its side branches at zero position."""
        mass, cog = self.links.get(link, (0.0, np.zeros(3)))
        moment = mass * cog
        for joint in self.child_joints.get(link, []):
            if joint.name in chain:
                continue
            m, c = self.inertial(joint.child, chain)
            origin = np.eye(4) if joint.origin is None else np.asarray(joint.origin, dtype=float)
            mass, moment = mass + m, moment + m * (origin[:3, :3] @ c + origin[:3, 3])
        return mass, moment / mass if mass > 0 else np.zeros(3)


def _step(joint: Any, mass: float, cog: Array) -> UrdfStep:
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
        elif joint.type == "revolute" and LARGEST_LIMIT < max(map(abs, limits)) <= 720.0:
            raise InvalidInput(
                f"URDF joint '{joint.name}' has the limits {limits[0]:g} and {limits[1]:g}: URDF wants radians, these "
                "look like degrees; divide by 57.2958 (a joint that turns without end is of type continuous)"
            )
    axis = axis / max(length, 1e-9)
    return UrdfStep(str(joint.name), str(joint.type), origin, axis, limits, mass, cog, str(joint.child))


def _inertial(link: Any) -> tuple[float, Array]:
    if link.inertial is None or link.inertial.mass is None:
        return 0.0, np.zeros(3)
    origin = np.eye(4) if link.inertial.origin is None else np.asarray(link.inertial.origin, dtype=float)
    mass = float(link.inertial.mass)
    return (mass, origin[:3, 3]) if mass > NEGLIGIBLE_MASS else (0.0, np.zeros(3))
