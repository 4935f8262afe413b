"""Causes that act in the direction of rotation of a joint: compliance, backlash, hysteresis, gears, references."""

from collections.abc import Iterable, Iterator
from dataclasses import replace

import numpy as np

from robcal.cause import Kind
from robcal.physics.cause import (
    LEAST_MOMENT,
    PER_KNM,
    Array,
    Basis,
    Constants,
    Entry,
    RobotCause,
    amplitude_phase,
    report_wave,
)
from robcal.physics.site import Joint, RobotSite, breaks, each_joint, evenly, exponential_law, waves
from robcal.robot.terms import identifier

STIFFNESS_NONLINEAR = Kind(
    "stiffness_nonlinear",
    "robot",
    "stiffness that changes with load",
    "The gear of {where} stiffens or softens with load: cubic term {cubic_deg_per_kNm3:.3g} deg/kNm^3",
)
BACKLASH = Kind("backlash", "robot", "backlash")
HYSTERESIS = Kind("hysteresis", "robot", "hysteresis")
LOST_MOTION = Kind(
    "lost_motion",
    "robot",
    "lost motion",
    "{where} loses {amplitude_deg:.4f} deg around zero load (lost motion, scale {torque_Nm:.3g} N m)",
)
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
JOINT_COMPLIANCE = Kind(
    "joint_compliance",
    "robot",
    "elasticity about the joint's own axis",
    "{where} gives way about its own axis by {compliance_deg_per_kNm:.3g} deg/kNm, which the model leaves out",
)
JOINT_COUPLING = Kind(
    "joint_coupling",
    "robot",
    "one joint drags another",
    "{where} is dragged along by {from}: {ratio:.2e} of its angle",
    several_drivers=True,
)
COUNTERBALANCE = Kind(
    "counterbalance",
    "robot",
    "balancing torque",
    "A balancing torque of {torque_Nm:.0f} N m acts on {where} that the model does not know",
)
THERMAL_ZERO_DRIFT = Kind("thermal_zero_drift", "robot", "thermal drift of a joint's zero")

TORQUE_SCALES = (0.02, 0.06, 0.2, 0.5, 1.2)
"""Scales of a lost motion that are tried first, in shares of the largest load torque: joints are built for theirs."""
KNOWN_TO_GIVE = 3.0
"""Prior weight of a joint's own compliance where the model leaves it out: every joint gives way about its axis."""
MOST_THRESHOLDS = 60
TRIED_THRESHOLDS = 14
"""Tried first, densely where few poses count as unloaded: friction is small against loads."""
UPRIGHT_SHARE = 0.005
"""An axis whose torque is below this share of the moment on its bearings is upright: what torque the fit gives it comes
from deviations of a few mrad, whose sign friction hides."""
HIGHEST_RIPPLE_ORDER = 180
LARGEST = np.radians(0.5)
"""rad (or m): no gear, encoder or reference of a robot that works is off by more."""


def _compliance(site: RobotSite, joint: Joint) -> Iterator[RobotCause]:
    k = joint.number
    if joint.prismatic or not site.varies(f"torque{k}", LEAST_MOMENT):
        return
    elastic = f"{joint.frame}.elastic_{joint.own_angle}"
    torque = f"torque{k}"
    if elastic not in site.fitted:
        yield RobotCause(
            JOINT_COMPLIANCE,
            *joint.place,
            (elastic,),
            (site.compliance(torque, 3e-6),),
            lambda v, c: {"compliance_deg_per_kNm": float(v[0]) * PER_KNM},
            positive=0.98,
            weight=KNOWN_TO_GIVE,
            free_parameters=(elastic,),
            limits=(0.0, np.inf),
        )


def _stiffness(site: RobotSite, joint: Joint) -> Iterator[RobotCause]:
    k = joint.number
    if joint.prismatic or not site.varies(f"torque{k}", LEAST_MOMENT):
        return
    elastic = f"{joint.frame}.elastic_{joint.own_angle}"
    torque = f"torque{k}"
    linear_fitted = elastic in site.fitted
    held = float(site.model.parameters.get(elastic, 0.0))
    largest = float(np.max(np.abs(site.variables[torque])))
    cubic = Basis(joint.frame, "q", f"{torque}*{torque}*{torque}", "cubic")
    linear = Basis(joint.frame, "q", torque, "linear")

    def report(v: Array, c: Constants) -> dict[str, object]:
        reported: dict[str, object] = {} if linear_fitted else {"linear_deg_per_kNm": (held + float(v[1])) * PER_KNM}
        return reported | {"cubic_deg_per_kNm3": float(v[0] * np.degrees(1.0) * 1e9)}

    yield RobotCause(
        STIFFNESS_NONLINEAR,
        *joint.place,
        ("cubic",) if linear_fitted else ("cubic", "linear"),
        (2e-4 / largest**3,) if linear_fitted else (2e-4 / largest**3, 3e-6),
        report,
        bases=(lambda c: (cubic,)) if linear_fitted else (lambda c: (cubic, linear)),
        jointly_fitted={"linear_deg_per_kNm": (elastic, PER_KNM)} if linear_fitted else {},
        covariates=(torque,),
    )


def _lag(joint: Joint) -> float:
    return 2e-4 if not joint.prismatic else 1e-4


def _backlash(site: RobotSite, joint: Joint) -> Iterator[RobotCause]:
    k = joint.number
    torque = site.variables[f"torque{k}"]
    moved = site.varies(f"approach{k}")
    largest = float(np.max(np.abs(torque)))
    loaded = largest > max(1e-3, UPRIGHT_SHARE * _moment(site, joint))
    if not moved and not (loaded and np.min(torque) < 0 < np.max(torque)):
        return
    name = f"width_{joint.unit}"
    every = _thresholds(torque) if loaded and moved else ()
    tried = np.unique(np.geomspace(1, max(len(every), 1), TRIED_THRESHOLDS).round().astype(int)) - 1
    grid: tuple[Constants, ...] = tuple({"threshold_Nm": every[i]} for i in tried if every) or ({},)

    def bases(c: Constants) -> tuple[Basis, ...]:
        lag = f"-0.5*approach{k}"
        if not loaded:
            law = lag
        elif not moved:
            law = f"0.5*sign(torque{k})"
        else:
            law = f"where(abs(torque{k}) > threshold_Nm, 0.5*sign(torque{k}), {lag})"
        return (Basis(joint.frame, "q", law, "width", c),)

    def report(v: Array, c: Constants) -> dict[str, object]:
        reported: dict[str, object] = {name: float(v[0]) * joint.factor}
        return reported | {"threshold_Nm": c["threshold_Nm"]} if c.get("threshold_Nm") else reported

    yield RobotCause(
        BACKLASH,
        *joint.place,
        ("width",),
        (_lag(joint),),
        report,
        "{where} has {" + name + ":.4f} " + joint.unit + " of backlash the model does not know",
        grid=grid,
        ordered={"threshold_Nm": every} if every else {},
        positive=0.97,
        bases=bases,
        covariates=(f"approach{k}", f"torque{k}"),
        limits=(0.0, LARGEST),
    )


def _moment(site: RobotSite, joint: Joint) -> float:
    """Largest moment (N m) about any line of a joint's frame."""
    lines = (site.variables.get(f"{identifier(joint.frame)}_m{a}") for a in ("roll", "pitch", "yaw"))
    return max((float(np.max(np.abs(m))) for m in lines if m is not None), default=0.0)


def _thresholds(torque: Array) -> tuple[float, ...]:
    """Torques between which recorded loads lie, below which a joint may count as unloaded; up to nine tenths of the
    poses, because a joint that is unloaded in all of them lags behind, which is another cause.

    The first is zero: torques are known no better than the fit, so none is small for sure."""
    sizes = np.sort(np.abs(torque))
    between = 0.5 * (sizes[1:] + sizes[:-1])[: int(0.9 * len(sizes))]
    between = np.unique(np.concatenate([[0.0], between]))
    chosen = np.unique(np.linspace(0, len(between) - 1, MOST_THRESHOLDS).round().astype(int))
    return tuple(float(between[i]) for i in chosen)


def _hysteresis(site: RobotSite, joint: Joint) -> Iterator[RobotCause]:
    k = joint.number
    if not site.varies(f"approach{k}"):
        return
    name = f"width_{joint.unit}"
    yield RobotCause(
        HYSTERESIS,
        *joint.place,
        ("width",),
        (_lag(joint),),
        lambda v, c: {name: float(v[0]) * joint.factor},
        "{where} lags behind by {" + name + ":.4f} " + joint.unit + " between the two approach directions",
        positive=0.97,
        bases=lambda c: (Basis(joint.frame, "q", f"-0.5*approach{k}", "width"),),
        covariates=(f"approach{k}",),
        limits=(0.0, LARGEST),
    )


def _lost_motion(site: RobotSite, joint: Joint) -> Iterator[RobotCause]:
    k = joint.number
    torque = site.variables[f"torque{k}"]
    largest = float(np.max(np.abs(torque)))
    if joint.prismatic or not site.varies(f"torque{k}", LEAST_MOMENT):
        return
    yield RobotCause(
        LOST_MOTION,
        *joint.place,
        ("amplitude",),
        (2e-4,),
        lambda v, c: {"amplitude_deg": float(v[0]) * np.degrees(1.0), "torque_Nm": c["torque_Nm"]},
        grid=tuple({"torque_Nm": share * largest} for share in TORQUE_SCALES),
        continuous={"torque_Nm": (0.003 * largest, 2.0 * largest)},
        positive=0.7,
        bases=lambda c: (Basis(joint.frame, "q", f"tanh(torque{k}/torque_Nm)", "amplitude", c),),
        covariates=(f"torque{k}",),
        limits=(-LARGEST, LARGEST),
    )


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


def _counterbalance(site: RobotSite) -> Iterator[RobotCause]:
    """Shows through the joint's own compliance only, so it equals an eccentricity of the first order."""
    loaded = []
    for joint in site.moving_joints:
        elastic = float(site.model.parameters.get(f"{joint.frame}.elastic_{joint.own_angle}", 0.0))
        if not joint.prismatic and elastic > 1e-8:
            loaded.append((float(np.max(np.abs(site.variables[f"torque{joint.number}"]))), elastic, joint))
    loaded.sort(key=lambda item: -item[0])
    for rank, (largest, elastic, joint) in enumerate(loaded):

        def report(v: Array, c: Constants) -> dict[str, object]:
            amplitude, phase = amplitude_phase(v, 1.0)
            return {"torque_Nm": amplitude, "phase_deg": phase}

        def bases(c: Constants, joint: Joint = joint, elastic: float = elastic) -> tuple[Basis, ...]:
            return tuple(replace(wave, template=f"{elastic!r}*{wave.template}") for wave in waves(joint, "q", 1.0))

        size = max(0.2 * largest, 1.0)
        yield RobotCause(
            COUNTERBALANCE,
            *joint.place,
            ("cosine", "sine"),
            (size, size),
            report,
            bases=bases,
            scaled_by=(f"{joint.frame}.elastic_{joint.own_angle}", elastic),
            covariates=(f"q{joint.number}",),
            weight=0.7 if rank == 0 else 0.3 / (len(loaded) - 1),
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
    Entry(on_robot=each_joint(_compliance)),
    Entry(on_robot=each_joint(_stiffness)),
    Entry(on_robot=each_joint(_backlash)),
    Entry(on_robot=each_joint(_hysteresis)),
    Entry(on_robot=each_joint(_lost_motion)),
    Entry(on_robot=each_joint(_zero_jump)),
    Entry(on_robot=each_joint(_eccentricity)),
    Entry(on_robot=each_joint(_ripple)),
    Entry(on_robot=each_joint(_ratio)),
    Entry(on_robot=each_joint(_zero_drift)),
    Entry(on_robot=evenly(_coupling)),
    Entry(on_robot=_counterbalance),
)
