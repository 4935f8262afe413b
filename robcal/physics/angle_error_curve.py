"""Irregular errors of joints over their own angle that repeat every turn: scales and tables of angle sensors, gears.

A curve is a sum of bumps round the circle, von Mises' (exp(cos)), so a joint at -90 deg and at 270 deg has the same
error. Where no joint ever was the amplitudes stay zero with the uncertainty of their prior, which predictions there
need. Joints with a copy of the same part share one curve `c`: the error of each is `sense c(sense q + shift)`.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from robcal.cause import Kind
from robcal.physics.cause import Array, Basis, Constants, RobotCause
from robcal.physics.site import LETTER_OF_KIND, Joint

ANGLE_ERROR_CURVE = Kind("angle_error_curve", "robot", "irregular error of an angle that repeats every turn")
CURVE_PRIOR = 3e-4
"""Typical amplitude of one bump of a joint's error curve, rad."""
ALL = "all joints"


@dataclass(frozen=True)
class Placed:
    """A joint and how the shared curve sits in it: shift in rad, sense -1 for a part mounted the other way round."""

    joint: Joint
    sense: int = 1
    shift: float = 0.0

    def bump(self, centre: float, sharp: float, parameter: str) -> Basis:
        """One bump of the curve as a law of this joint."""
        constants = {"sense": float(self.sense), "sharp": sharp, "shift": self.shift, "centre": centre}
        law = f"sense*exp(sharp*(cos(sense*q{self.joint.number} + shift - centre) - 1))"
        return Basis(self.joint.frame, "q", law, parameter, constants)


def periodic_curve(joint: Joint, angles: Array, bumps: int) -> RobotCause:
    """The curve of one joint; angles (n,) as recorded, rad."""
    sentence = (
        "The angle of {where} is wrong by an irregular curve that repeats every turn ({rms_deg:.4f} deg RMS), as of an "
        "encoder or gear with uneven pitch"
    )
    return _cause((Placed(joint),), angles, bumps, joint.where, sentence)


def difference_from_shared(cause: RobotCause, size: float) -> RobotCause:
    """The curve of a joint as what it differs by from the one that it shares, `size` times as large as a curve."""
    sentence = "The curve of {where} differs by {rms_deg:.4f} deg RMS from the one that joints share"
    return replace(cause, sentence=sentence, default_prior=size * CURVE_PRIOR)


def shared_curve(placed: Sequence[Placed], angles: Array, bumps: int, every: bool) -> RobotCause:
    """One curve for several joints; angles (n,) of the first of them; every : these are all joints of the robot."""
    where = ALL if every else ", ".join(p.joint.where for p in placed)
    turns = "; ".join(
        f"{p.joint.where}: turned by {np.degrees(p.shift) % 360.0:.1f} deg{', reversed' if p.sense < 0 else ''}"
        for p in placed
    )
    sentence = (
        "The angles of {where} are wrong by one and the same irregular curve that repeats every turn ({rms_deg:.4f} "
        f"deg RMS), as of a part of which each has a copy ({turns})"
    )
    return _cause(placed, angles, bumps, where, sentence)


def _cause(placed: Sequence[Placed], angles: Array, bumps: int, where: str, sentence: str) -> RobotCause:
    spacing = 2.0 * np.pi / bumps
    sharp = float(np.round(1.0 / (0.9 * spacing) ** 2, 6))
    first = placed[0]

    def bases(c: Constants) -> tuple[Basis, ...]:
        return tuple(p.bump(float(np.round(i * spacing, 9)), sharp, f"c{i}") for p in placed for i in range(bumps))

    def report(v: Array, c: Constants) -> dict[str, object]:
        own = bases(c)[:bumps]
        values = np.sum([x * b.value({f"q{first.joint.number}": angles}) for b, x in zip(own, v, strict=True)], axis=0)
        formula = " + ".join(f"{x:.6g}*({b.expression})" for b, x in zip(own, v, strict=True))
        term = {"variables": [f"q{first.joint.number}_deg"], "kind": "gaussian_process", "formula": formula}
        reported: dict[str, object] = {"term": term, "period_deg": 360.0, "rms_deg": float(np.degrees(np.std(values)))}
        return reported | (_mounting(placed) if len(placed) > 1 else {})

    return RobotCause(
        ANGLE_ERROR_CURVE,
        where,
        LETTER_OF_KIND[first.joint.own_angle],
        (),
        (),
        report,
        sentence,
        grid=({"bumps": float(bumps)},),
        bases=bases,
        covariates=tuple(f"q{p.joint.number}" for p in placed),
        default_prior=CURVE_PRIOR,
    )


def _mounting(placed: Sequence[Placed]) -> dict[str, object]:
    return {
        "shift_deg": {p.joint.where: float(np.degrees(p.shift) % 360.0) for p in placed},
        "sense": {p.joint.where: p.sense for p in placed},
    }
