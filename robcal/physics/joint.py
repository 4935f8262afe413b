"""Causes that act in the direction of rotation of a joint: gears, encoders, references, couplings."""

from collections.abc import Iterable, Iterator

import numpy as np

from robcal.cause import Kind
from robcal.physics.cause import Array, Basis, Constants, Entry, RobotCause, report_wave
from robcal.physics.site import Joint, RobotSite, breaks, each_joint, evenly, exponential_law, waves

ZERO_JUMP = Kind("zero_jump", "robot", "jump of a joint's zero", of_order=True)
JOINT_ECCENTRICITY = Kind(
    "joint_eccentricity",
    "robot",
    "eccentricity of a joint's encoder or gear",
    "The encoder or gear of {where} runs out of centre: {amplitude_deg:.4f} deg, order {order}",
)
GEAR_RIPPLE = Kind(
    "gear_ripple",
    "robot",
    "ripple of a gear",
    "The gear of {where} ripples {order:g} times a turn with {amplitude_deg:.4f} deg",
)
TRANSMISSION_RATIO = Kind(
    "transmission_ratio",
    "robot",
    "wrong transmission ratio",
    "The transmission of {where} turns {ratio_error_ppm:.0f} ppm more than its ratio says",
)
JOINT_COUPLING = Kind(
    "joint_coupling",
    "robot",
    "one joint drags another",
    "{where} is dragged along by {from}: {ratio:.2e} of its angle",
    several_drivers=True,
)
THERMAL_ZERO_DRIFT = Kind("thermal_zero_drift", "robot", "thermal drift of a joint's zero")

HIGHEST_RIPPLE_ORDER = 180
LARGEST = np.radians(0.5)
"""rad (or m): no gear, encoder or reference of a robot that works is off by more."""


def _zero_jump(site: RobotSite, joint: Joint) -> Iterator[RobotCause]:
    first, every = breaks(site.variables["index"], 2)
    name = f"jump_{joint.unit}"
    yield RobotCause(
        ZERO_JUMP,
        *joint.place,
        ("jump",),
        (5e-4,),
        lambda v, c: {"pose": c["pose"], name: float(v[0]) * joint.factor},
        "The zero of {where} jumped by {" + name + ":.4f} " + joint.unit + " at pose {pose}",
        grid=tuple({"pose": i} for i in first),
        ordered={"pose": every},
        bases=lambda c: (Basis(joint.frame, "q", "step(index - pose + 0.5)", "jump", c),),
        covariates=("index",),
        limits=(-LARGEST, LARGEST),
    )


def _eccentricity(site: RobotSite, joint: Joint) -> Iterator[RobotCause]:
    return _periodic(joint, JOINT_ECCENTRICITY, 3e-4, (1, 2))


def _ripple(site: RobotSite, joint: Joint) -> Iterator[RobotCause]:
    return _periodic(joint, GEAR_RIPPLE, 1e-4, range(3, HIGHEST_RIPPLE_ORDER + 1))


def _periodic(joint: Joint, kind: Kind, size: float, orders: Iterable[int]) -> Iterator[RobotCause]:
    """Waves over the joint angle, of prior size ``size`` (rad)."""
    if joint.prismatic:
        return

    yield RobotCause(
        kind,
        *joint.place,
        ("cosine", "sine"),
        (size, size),
        report_wave,
        grid=tuple({"order": float(order)} for order in orders),
        bases=lambda c: waves(joint, "q", c["order"]),
        covariates=(f"q{joint.number}",),
        limits=(-LARGEST, LARGEST),
    )


def _ratio(site: RobotSite, joint: Joint) -> Iterator[RobotCause]:
    k = joint.number
    yield RobotCause(
        TRANSMISSION_RATIO,
        *joint.place,
        ("ratio",),
        (2e-4,),
        lambda v, c: {"ratio_error_ppm": float(v[0]) * 1e6},
        bases=lambda c: (Basis(joint.frame, "q", f"q{k}", "ratio"),),
        covariates=(f"q{k}",),
    )


def _coupling(site: RobotSite) -> Iterator[RobotCause]:
    joints = site.moving_joints
    pairs = [(a, b) for a in joints for b in joints if a.number != b.number and a.prismatic == b.prismatic]
    for joint, driver in pairs:

        def bases(c: Constants, frame: str = joint.frame, j: int = driver.number) -> tuple[Basis, ...]:
            return (Basis(frame, "q", f"q{j}", "ratio"),)

        def report(v: Array, c: Constants, where: str = driver.where) -> dict[str, object]:
            return {"from": where, "ratio": float(v[0])}

        yield RobotCause(
            JOINT_COUPLING, *joint.place, ("ratio",), (3e-4,), report, bases=bases, covariates=(f"q{driver.number}",)
        )


def _zero_drift(site: RobotSite, joint: Joint) -> Iterator[RobotCause]:
    for name in site.temperatures():

        def bases(c: Constants, law: str = site.warmed(name)) -> tuple[Basis, ...]:
            return (Basis(joint.frame, "q", law, "drift"),)

        yield RobotCause(
            THERMAL_ZERO_DRIFT,
            *joint.place,
            ("drift",),
            (3e-5,),
            lambda v, c: {f"{joint.unit}_per_K": float(v[0]) * joint.factor},
            "The zero of {where} drifts by {" + f"{joint.unit}_per_K" + ":.5f} " + joint.unit + " per kelvin",
            bases=bases,
            covariates=(name,),
            weight=0.5,
        )
    duration = site.duration_h()
    if duration > 0:
        start = float(np.min(site.variables["time_s"]))

        def warming(c: Constants) -> Basis:
            law, constants = exponential_law(start, duration, c["tau_h"])
            return Basis(joint.frame, "q", law, "drift", constants)

        yield RobotCause(
            THERMAL_ZERO_DRIFT,
            *joint.place,
            ("drift",),
            (3e-4 / duration,),
            lambda v, c: {f"{joint.unit}_per_h": float(v[0]) * joint.factor, "tau_h": c["tau_h"]},
            "The zero of {where} drifts by {" + f"{joint.unit}_per_h" + ":.5f} " + joint.unit + " per hour",
            grid=tuple({"tau_h": share * duration} for share in (0.1, 0.25, 0.6, 3.0)),
            continuous={"tau_h": (0.02 * duration, 10.0 * duration)},
            bases=lambda c: (warming(c),),
            covariates=("time_s",),
            weight=0.5,
        )


ENTRIES = (
    Entry(on_robot=each_joint(_zero_jump)),
    Entry(on_robot=each_joint(_eccentricity)),
    Entry(on_robot=each_joint(_ripple)),
    Entry(on_robot=each_joint(_ratio)),
    Entry(on_robot=each_joint(_zero_drift)),
    Entry(on_robot=evenly(_coupling)),
)
