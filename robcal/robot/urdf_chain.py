"""Reading a URDF safely, and the joints on the way from its root to its tip.

One chain of a URDF as a robot.

The file format is yourdfpy's business; here is only the geometry. URDF turns a child about an arbitrary axis of its own
frame, this project about the line of roll, pitch or yaw: most joints translate directly, the others by turning the
child's frame so that the axis is its x (kept track of, undone behind the last joint).
"""

import io
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any
from xml.etree import ElementTree

import numpy as np

from robcal.errors import InvalidInput
from robcal.robot.model import Frame, RobotModel
from robcal.transforms import Array, frame, invert, rotation_from_rpy, rpy_from_rotation

LARGEST = 1e30
"""Numbers beyond are no length, angle or mass of a robot."""
_DECIMAL = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
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
            angles = [float(v) for v in re.findall(_DECIMAL, origin.get("rpy", ""))]
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
        raise InvalidInput(
            f"URDF joint '{joint.name}' mimics another one: describe the robot in a robot.yaml, whose frames may turn "
            "by the angles of joints ('angle')"
        )
    origin = np.eye(4) if joint.origin is None else np.asarray(joint.origin, dtype=float)
    axis = np.array([1.0, 0.0, 0.0]) if joint.axis is None else np.asarray(joint.axis, dtype=float)
    measurable = np.all(np.abs(origin) < LARGEST) and np.all(np.abs(axis) < LARGEST)
    length = float(np.linalg.norm(axis)) if measurable else 0.0
    if not measurable or not (length > 1e-9 or joint.type == "fixed"):
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
    if not np.all(np.abs([mass, *origin.ravel()]) < LARGEST):
        raise InvalidInput(f"URDF link '{link.name}': mass and origin of its inertial must be finite")
    return (mass, origin[:3, 3]) if mass > NEGLIGIBLE_MASS else (0.0, np.zeros(3))


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
