"""Where causes may act on a given robot: its joints, the covariates that were recorded, what is fitted already."""

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np

from robcal.physics.cause import DEFLECTION, DEG, LEAST_MOMENT, Array, Basis, RobotCause
from robcal.robot.model import RobotModel

ANGLE_OF_AXIS = {"x": "roll", "y": "pitch", "z": "yaw"}
LETTER_OF_KIND = {"roll": "x", "pitch": "y", "yaw": "z", "x": "x", "y": "y", "z": "z"}


@dataclass(frozen=True)
class Joint:
    """Joint K (from 1) of the chain, carried by a named frame."""

    number: int
    frame: str
    axis: str
    sign: int
    prismatic: bool

    @property
    def where(self) -> str:
        """Its name in files and reports."""
        return f"axis{self.number}"

    @property
    def place(self) -> tuple[str, str]:
        """Its name, and the letter of the direction in which it moves."""
        return self.where, LETTER_OF_KIND[self.own_angle]

    @property
    def unit(self) -> str:
        """Unit of the joint coordinate in files."""
        return "mm" if self.prismatic else "deg"

    @property
    def factor(self) -> float:
        """From SI to the unit of files."""
        return 1e3 if self.prismatic else DEG

    @property
    def own_angle(self) -> str:
        """The number of the frame that the joint turns or slides."""
        return self.axis if self.prismatic else ANGLE_OF_AXIS[self.axis]

    @property
    def cross_angles(self) -> tuple[str, ...]:
        """The angles across the joint's own."""
        return tuple(kind for kind in ("roll", "pitch", "yaw") if kind != self.own_angle)


@dataclass(frozen=True)
class RobotSite:
    """The robot and the recording, as far as causes need to know them.

    Attributes
    ----------
    model : the robot as identified.
    variables : every variable of the expression language, each (n,), one value per pose.
    fitted : names of the kernel's parameters that the identification fitted.
    tied : names that it eliminated because the data cannot tell them from fitted ones.
    """

    model: RobotModel
    variables: Mapping[str, Array]
    fitted: frozenset[str]
    tied: frozenset[str]

    @property
    def joints(self) -> tuple[Joint, ...]:
        """The joints in order."""
        moving = [frame for frame in self.model.frames if frame.is_joint]
        return tuple(
            Joint(k, frame.name, frame.axis or "", frame.sign, frame.prismatic) for k, frame in enumerate(moving, 1)
        )

    @property
    def moving_joints(self) -> tuple[Joint, ...]:
        """The joints that move in the recording."""
        return tuple(joint for joint in self.joints if self.varies(f"q{joint.number}", 1e-6))

    @property
    def poses(self) -> int:
        """Number of poses."""
        return len(self.variables["index"])

    def varies(self, name: str, least: float = 1e-9) -> bool:
        """Whether a covariate was recorded and changes by more than `least`."""
        values = self.variables.get(name)
        return values is not None and bool(np.ptp(values) > least)

    def temperatures(self) -> tuple[str, ...]:
        """Recorded temperatures that change by more than 0.2 K, enough to speak of."""
        return tuple(v for v in self.variables if v.startswith("temp_") and self.varies(v, 0.2))

    def warmed(self, name: str) -> str:
        """Template of a temperature's change since the first pose."""
        first = float(self.variables[name][int(np.argmin(self.variables["index"]))])
        return f"({name} - {first!r})"

    def compliance(self, moment: str, least: float) -> float:
        """Typical compliance (rad/(N m)) for a moment that was recorded: `least`, or more where loads are small, since
        small robots are softer in proportion."""
        largest = float(np.max(np.abs(self.variables.get(moment, np.zeros(1)))))
        return max(least, DEFLECTION / max(largest, LEAST_MOMENT))

    def duration_h(self) -> float:
        """Hours between the first and the last pose; zero without times."""
        times = self.variables.get("time_s")
        return 0.0 if times is None else float(np.max(times) - np.min(times)) / 3600.0


MOST_BREAKS = 100
"""Poses at which a break is tried first; with longer recordings the best one is refined among its neighbours."""


def breaks(index: Array, margin: int, most: int = MOST_BREAKS) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Values of `index` at which something may break: those to be tried first, and all of them."""
    every = tuple(float(i) for i in np.sort(index)[margin:-margin])
    if len(every) <= most:
        return every, every
    chosen = np.unique(np.linspace(0, len(every) - 1, most).round().astype(int))
    return tuple(every[i] for i in chosen), every


def waves(joint: Joint, kind: str, order: float) -> tuple[Basis, Basis]:
    """Cosine and sine of a multiple of a joint's angle, added to a number of its frame."""
    argument, constants = f"order*q{joint.number}", {"order": order}
    return (
        Basis(joint.frame, kind, f"cos({argument})", "cosine", constants),
        Basis(joint.frame, kind, f"sin({argument})", "sine", constants),
    )


def exponential_law(start_s: float, duration_h: float, tau_h: float) -> tuple[str, dict[str, float]]:
    """Template and constants of a warming up that reaches `duration_h` (hours) at the end, time constant `tau_h`."""
    if not np.isfinite(tau_h):
        return "((time_s - start_s)/3600)", {"start_s": start_s}
    scale = float(duration_h / -np.expm1(-duration_h / tau_h))
    law = "(scale*(1 - exp((start_s - time_s)/tau_s)))"
    return law, {"scale": scale, "start_s": start_s, "tau_s": 3600.0 * tau_h}


def each_joint(at: Callable[[RobotSite, Joint], Iterable[RobotCause]]) -> Callable[[RobotSite], Iterator[RobotCause]]:
    """Causes at every joint that moves, which share one prior weight."""

    def on_robot(site: RobotSite) -> Iterator[RobotCause]:
        joints = site.moving_joints
        causes = [cause for joint in joints for cause in at(site, joint)]
        yield from (replace(cause, weight=cause.weight / len(joints)) for cause in causes)

    return on_robot


def each_place(at: Callable[[RobotSite, Joint], Iterable[RobotCause]]) -> Callable[[RobotSite], Iterator[RobotCause]]:
    """Causes in the frames of all joints, which share one prior weight evenly."""
    return evenly(lambda site: (cause for joint in site.joints for cause in at(site, joint)))


def evenly(at: Callable[[RobotSite], Iterable[RobotCause]]) -> Callable[[RobotSite], Iterator[RobotCause]]:
    """Causes at all places of a robot, which share one prior weight evenly."""

    def on_robot(site: RobotSite) -> Iterator[RobotCause]:
        causes = list(at(site))
        yield from (replace(cause, weight=cause.weight / len(causes)) for cause in causes)

    return on_robot
