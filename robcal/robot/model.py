"""The robot as data: frames from base to flange, masses, payloads, named parameters and extra physical terms.

Nothing is computed here; :mod:`robcal.robot.kernel` turns a model into an expression graph.

Parameter names (deviations from nominal, metres, radians, rad/(N m), kg):

- ``<frame>.<x|y|z|roll|pitch|yaw>`` and ``<frame>.elastic_<roll|pitch|yaw>`` for every frame of the chain,
- ``<frame>.<crank|coupler|rocker|ground|crank_angle|elastic_crank>`` for every frame that a four-bar turns,
- ``<frame>.<base_x..base_z|platform_x..platform_z|offset>`` instead of these for every leg of a Stewart platform,
- ``base.<x..yaw>``, ``tool.<x..yaw>``: on the right of the references ``world_T_base`` and ``flange_T_tool``,
- ``gravity.tilt_x``, ``gravity.tilt_y``: turn of the gravity vector about the x and y axes of the frame it is given in,
- ``payload.<name>.mass|x|y|z``: deviation of a payload's mass and centre of gravity (flange coordinates),
- ``<term>.<parameter>`` for every extra term.
"""

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from robcal.errors import InvalidInput
from robcal.robot.legs import LEG_KINDS, Leg
from robcal.robot.loops import FOUR_BAR_KINDS, FOUR_BAR_LENGTHS, FourBar

Array = NDArray[np.float64]
Triple = tuple[float, float, float]

GEOMETRIC_KINDS = ("x", "y", "z", "roll", "pitch", "yaw")
ELASTIC_KINDS = ("elastic_roll", "elastic_pitch", "elastic_yaw")
LENGTH_KINDS = frozenset({"x", "y", "z", "offset", *FOUR_BAR_LENGTHS, *LEG_KINDS})
ANGLE_OF_AXIS = {"x": "roll", "y": "pitch", "z": "yaw"}
STANDARD_GRAVITY = (0.0, 0.0, -9.80665)
RESERVED_FRAME_NAMES = frozenset({"base", "tool", "gravity", "payload"})


@dataclass(frozen=True)
class Frame:
    """One entry of the chain: ``parent_T_frame = (R(roll, pitch, yaw), xyz)``.

    Attributes
    ----------
    name : unique within the chain.
    axis : 'x', 'y', 'z' of the joint, or None for a fixed frame. A rotary joint adds ``sign * q`` to roll, pitch or
        yaw; a prismatic one adds it to that component of ``xyz``.
    prismatic : sliding joint.
    sign : +1 or -1.
    limits : lowest and highest q, rad or m; None if unknown.
    xyz, rpy : nominal offset in m and angles in rad, in the parent's coordinates.
    mass : kg, moves with the frame; cog : centre of gravity in this frame's coordinates, m.
    follows : (joint, coefficient) pairs: the angle about ``axis`` also turns by so much of these joints (from 0).
    fourbar : the angle about ``axis`` is, times ``sign``, a rocker's whose crank a joint turns, its own or another's.
    passive : the frame turns by ``follows`` or ``fourbar`` alone, it carries no joint.
    leg : the frame is no link of a chain but a leg of a Stewart platform; its joint is the leg's length.
    """

    name: str
    axis: str | None = None
    prismatic: bool = False
    sign: int = 1
    limits: tuple[float, float] | None = None
    xyz: Triple = (0.0, 0.0, 0.0)
    rpy: Triple = (0.0, 0.0, 0.0)
    mass: float = 0.0
    cog: Triple = (0.0, 0.0, 0.0)
    follows: tuple[tuple[int, float], ...] = ()
    fourbar: FourBar | None = None
    passive: bool = False
    leg: Leg | None = None

    @property
    def is_joint(self) -> bool:
        """Whether the frame carries a joint."""
        return self.axis is not None and not self.passive

    @property
    def in_loop(self) -> bool:
        """Whether other joints, or a four-bar, turn the frame."""
        return bool(self.follows) or self.fourbar is not None

    @property
    def joint_kind(self) -> str | None:
        """Name of the coordinate that moves: 'roll'..'yaw', 'x'..'z' if prismatic, None if the frame is fixed."""
        if self.axis is None:
            return None
        return self.axis if self.prismatic else ANGLE_OF_AXIS[self.axis]

    @property
    def zero_name(self) -> str:
        """Parameter that acts as the joint's zero offset: its own angle or length, of a four-bar the crank's angle."""
        kind = "crank_angle" if self.fourbar is not None else "offset" if self.leg is not None else self.joint_kind
        return f"{self.name}.{kind}"

    @property
    def elastic_name(self) -> str:
        """Parameter that is the elasticity of the joint's gear, about its own axis."""
        return f"{self.name}.elastic_{'crank' if self.fourbar is not None else self.joint_kind}"

    @property
    def zero_sign(self) -> int:
        """What the parameter ``zero_name`` of one counts in the sense of q."""
        return 1 if self.fourbar is not None or self.leg is not None else self.sign


@dataclass(frozen=True)
class Payload:
    """A load on the flange: mass in kg, centre of gravity in flange coordinates, m."""

    mass: float
    cog: Triple = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Term:
    """An extra physical effect: the value of ``expression`` is added to coordinate ``kind`` of ``frame``.

    Attributes
    ----------
    name : terms of the same name share the parameters they have in common.
    frame : name of a frame of the chain, 'base' or 'tool'.
    kind : 'q' (in the sense of q, before ``sign``), 'x', 'y', 'z' (m), 'roll', 'pitch', 'yaw' (rad).
    expression : see :mod:`robcal.robot.terms`.
    parameters : value of each parameter of the expression, by short name.
    units, priors : unit and standard deviation to be expected, by short name (for reports and as starting scale).
    cause : name of the physical cause, if any.
    """

    name: str
    frame: str
    kind: str
    expression: str
    parameters: Mapping[str, float] = field(default_factory=dict)
    units: Mapping[str, str] = field(default_factory=dict)
    priors: Mapping[str, float] = field(default_factory=dict)
    cause: str | None = None

    def __post_init__(self) -> None:
        for name in ("parameters", "units", "priors"):
            object.__setattr__(self, name, dict(getattr(self, name)))

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """Full names ``<term>.<parameter>``."""
        return tuple(f"{self.name}.{short}" for short in self.parameters)


@dataclass(frozen=True)
class RobotModel:
    """A chain, or a Stewart platform, with masses, payloads, parameters and terms.

    Attributes
    ----------
    frames : from the base to the flange; the last one is the flange, in which payloads are given. Of a Stewart platform
        its six legs; then the flange is the platform and weights have no effect.
    home : (4, 4) base_T_platform of a Stewart platform from which its forward kinematics starts; None for chains.
    gravity : m/s2, in coordinates of ``gravity_frame`` ('base' or 'world', the measuring system).
    parameters : deviations that are not zero, by name (see the module's text); those of terms live in the terms.
    world_T_base, flange_T_tool : (4, 4) references, None while unknown (then taken as identity).

    Raises
    ------
    InvalidInput : names, numbers or kinds that a robot cannot have; the message says which.
    """

    name: str
    frames: tuple[Frame, ...]
    gravity: Triple = STANDARD_GRAVITY
    gravity_frame: Literal["base", "world"] = "base"
    parameters: Mapping[str, float] = field(default_factory=dict)
    terms: tuple[Term, ...] = ()
    payloads: Mapping[str, Payload] = field(default_factory=dict)
    world_T_base: Array | None = None
    flange_T_tool: Array | None = None
    home: Array | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "frames", tuple(self.frames))
        object.__setattr__(self, "terms", tuple(self.terms))
        object.__setattr__(self, "parameters", dict(self.parameters))
        object.__setattr__(self, "payloads", dict(self.payloads))
        for name in ("world_T_base", "flange_T_tool", "home"):
            value = getattr(self, name)
            if value is not None:
                matrix = np.array(value, dtype=float)
                if matrix.shape != (4, 4) or not np.all(np.isfinite(matrix)):
                    raise InvalidInput(f"robot '{self.name}': {name} must be a finite 4x4 matrix")
                matrix.setflags(write=False)
                object.__setattr__(self, name, matrix)
        _check(self)

    @property
    def joints(self) -> tuple[Frame, ...]:
        """Frames that carry a joint, in the order of q."""
        return tuple(f for f in self.frames if f.is_joint)

    @property
    def n_joints(self) -> int:
        """Number of joints."""
        return len(self.joints)

    @property
    def is_hexapod(self) -> bool:
        """Whether the robot is a Stewart platform."""
        return any(f.leg is not None for f in self.frames)

    @property
    def has_loops(self) -> bool:
        """Whether frames turn by the angles of other joints or by four-bars."""
        return any(f.in_loop for f in self.frames)

    def joint_of(self, frame_name: str) -> int | None:
        """Index of the joint (0-based) in the named frame; None for a fixed frame."""
        return next((k for k, f in enumerate(self.joints) if f.name == frame_name), None)

    def frame(self, name: str) -> Frame:
        """The frame of that name.

        Raises
        ------
        InvalidInput : there is none.
        """
        for f in self.frames:
            if f.name == name:
                return f
        known = ", ".join(f.name for f in self.frames)
        raise InvalidInput(f"robot '{self.name}' has no frame '{name}'; it has {known}")

    def with_parameters(self, values: Mapping[str, float]) -> "RobotModel":
        """Copy with the named values set, those of terms included; a value of zero removes a deviation."""
        plain = dict(self.parameters)
        of_terms = {full for term in self.terms for full in term.parameter_names}
        plain.update({n: float(v) for n, v in values.items() if n not in of_terms})
        terms = tuple(
            replace(t, parameters={s: float(values.get(f"{t.name}.{s}", v)) for s, v in t.parameters.items()})
            for t in self.terms
        )
        return replace(self, parameters={n: v for n, v in plain.items() if v != 0.0}, terms=terms)

    def with_terms(self, terms: Iterable[Term]) -> "RobotModel":
        """Copy with further terms appended."""
        return replace(self, terms=(*self.terms, *terms))

    def nominal(self) -> "RobotModel":
        """Copy without deviations and terms: what the controller believes."""
        return replace(self, parameters={}, terms=())


def geometric_kinds(frame: Frame) -> tuple[str, ...]:
    """Kinds of geometric parameters that a frame has, those of four-bars left out."""
    return GEOMETRIC_KINDS if frame.leg is None else ("offset", *LEG_KINDS)


def frame_kinds(frame: Frame) -> tuple[str, ...]:
    """Kinds of parameters that a frame has."""
    if frame.leg is not None:
        return geometric_kinds(frame)
    return (*GEOMETRIC_KINDS, *ELASTIC_KINDS, *(FOUR_BAR_KINDS if frame.fourbar is not None else ()))


def parameter_names(model: RobotModel) -> tuple[str, ...]:
    """All parameter names of a model: base, frames in order, tool, gravity, payloads, terms."""
    names = [f"base.{k}" for k in GEOMETRIC_KINDS]
    for f in model.frames:
        names += [f"{f.name}.{k}" for k in frame_kinds(f)]
    names += [f"tool.{k}" for k in GEOMETRIC_KINDS]
    names += ["gravity.tilt_x", "gravity.tilt_y"]
    names += [f"payload.{p}.{k}" for p in model.payloads for k in ("mass", "x", "y", "z")]
    for term in model.terms:
        names += [full for full in term.parameter_names if full not in names]
    return tuple(names)


def parameter_unit(model: RobotModel, name: str) -> str:
    """Unit of a parameter inside the library: 'm', 'rad', 'rad/(N m)', 'kg' or what the term states."""
    for term in model.terms:
        for short in term.parameters:
            if name == f"{term.name}.{short}":
                return term.units.get(short, "1")
    kind = name.rsplit(".", 1)[-1]
    if kind.startswith("elastic_"):
        return "rad/(N m)"
    if kind == "mass":
        return "kg"
    return "m" if kind in LENGTH_KINDS else "rad"


def _check(model: RobotModel) -> None:
    where = f"robot '{model.name}'"
    if not any(f.is_joint for f in model.frames):
        raise InvalidInput(f"{where}: the chain has no joint; give at least one frame an axis x, y or z")
    if model.is_hexapod and (len(model.frames) != 6 or any(f.leg is None for f in model.frames) or model.home is None):
        raise InvalidInput(f"{where}: a Stewart platform has six legs, nothing else, and a home")
    seen: set[str] = set()
    for f in model.frames:
        if not f.name or f.name in seen or f.name in RESERVED_FRAME_NAMES or "." in f.name:
            raise InvalidInput(
                f"{where}: frame name '{f.name}' is empty, used twice, contains a dot or is one of "
                f"{', '.join(sorted(RESERVED_FRAME_NAMES))}; rename it"
            )
        seen.add(f.name)
        _check_frame(f, f"{where}, frame {f.name}")
        _check_loop(model, f, f"{where}, frame {f.name}")
    for name, payload in model.payloads.items():
        if not all(math.isfinite(v) for v in (payload.mass, *payload.cog)) or payload.mass < 0:
            raise InvalidInput(f"{where}, payload '{name}': mass and centre of gravity must be finite, mass >= 0")
    if model.gravity_frame not in ("base", "world"):
        raise InvalidInput(f"{where}: gravity_frame must be base or world, not '{model.gravity_frame}'")
    if len(model.gravity) != 3 or not all(math.isfinite(v) for v in model.gravity):
        raise InvalidInput(f"{where}: gravity must be three finite numbers in m/s2")
    for term in model.terms:
        _check_term(model, term, f"{where}, term {term.name}")
    known = set(parameter_names(model))
    for name, value in model.parameters.items():
        if name not in known:
            raise InvalidInput(f"{where}: unknown parameter '{name}'; names are <frame>.<kind>")
        if not math.isfinite(value):
            raise InvalidInput(f"{where}: parameter '{name}' is not finite")


def _check_frame(f: Frame, where: str) -> None:
    if f.axis not in (None, "x", "y", "z"):
        raise InvalidInput(f"{where}: axis must be x, y, z or null, not '{f.axis}'")
    if f.sign not in (1, -1):
        raise InvalidInput(f"{where}: sign must be +1 or -1, not {f.sign}")
    numbers = (*f.xyz, *f.rpy, f.mass, *f.cog)
    if len(f.xyz) != 3 or len(f.rpy) != 3 or len(f.cog) != 3 or not all(math.isfinite(v) for v in numbers):
        raise InvalidInput(f"{where}: offsets, angles, mass and centre of gravity must be finite")
    if f.mass < 0:
        raise InvalidInput(f"{where}: mass {f.mass} kg is negative")
    if f.limits is not None and not f.limits[0] <= f.limits[1]:
        raise InvalidInput(f"{where}: the lower limit is above the upper one")


def _check_loop(model: RobotModel, f: Frame, where: str) -> None:
    if not f.in_loop:
        if f.passive:
            raise InvalidInput(f"{where}: a passive frame turns by the angles of joints or by a four-bar; give either")
        return
    if f.axis is None or f.prismatic:
        raise InvalidInput(f"{where}: what joints turn needs an axis x, y or z and cannot slide")
    if f.follows and f.fourbar is not None:
        raise InvalidInput(f"{where}: turns by joint angles or by a four-bar, not by both")
    joints = model.joints
    drivers = [k for k, _ in f.follows] if f.fourbar is None else [f.fourbar.driver]
    for k in drivers:
        if not 0 <= k < len(joints):
            raise InvalidInput(f"{where}: turns with joint q{k + 1}, but the robot has {len(joints)} joints")
        if joints[k].prismatic:
            raise InvalidInput(f"{where}: turns with joint q{k + 1} ({joints[k].name}), which slides")
    own = next((k for k, joint in enumerate(joints) if joint is f), None)
    if own is not None and ((f.fourbar is None) == (own in drivers)):
        raise InvalidInput(f"{where}: its joint is q{own + 1}; a four-bar of its own is driven by it, other angles not")
    if not all(math.isfinite(c) and c != 0.0 for _, c in f.follows):
        raise InvalidInput(f"{where}: coefficients of joint angles must be finite and not zero")


def _check_term(model: RobotModel, term: Term, where: str) -> None:
    if term.frame not in {"base", "tool", *(f.name for f in model.frames)}:
        raise InvalidInput(f"{where}: there is no frame '{term.frame}'")
    if model.is_hexapod and term.kind != "q":
        raise InvalidInput(f"{where}: terms of a Stewart platform act on the lengths of its legs, kind q")
    if term.kind not in (*GEOMETRIC_KINDS, "q"):
        raise InvalidInput(f"{where}: kind '{term.kind}' is not q, x, y, z, roll, pitch or yaw")
    if term.kind == "q" and model.joint_of(term.frame) is None:
        raise InvalidInput(f"{where}: frame '{term.frame}' has no joint for kind q")
