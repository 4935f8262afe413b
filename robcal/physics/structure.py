"""Causes in the structure of the robot: links, bearings, geometry held fixed, foundation, gravity, payload, warmth."""

from collections.abc import Iterator

import numpy as np

from robcal.cause import Kind
from robcal.physics.cause import (
    DEG,
    LEAST_MOMENT,
    PER_KNM,
    Array,
    Basis,
    Constants,
    Entry,
    Report,
    RobotCause,
    report_move,
    report_wave,
)
from robcal.physics.gravity_sag import without_masses
from robcal.physics.site import LETTER_OF_KIND, Joint, RobotSite, breaks, each_place, exponential_law, waves
from robcal.robot.terms import identifier

BASE_MOVED = Kind(
    "base_moved",
    "robot",
    "base that moved",
    "The base of the robot moved before pose {pose}",
    moves="base",
    of_order=True,
)
BASE_TILT = Kind(
    "base_tilt",
    "robot",
    "tilt of the base against gravity",
    "The base stands {tilt_deg:.2f} deg off the plumb line, which changes the deflections",
)
LINK_COMPLIANCE = Kind(
    "link_compliance",
    "robot",
    "elasticity across the joint's axis",
    "The link or bearing of {where} gives way about {direction} by {compliance_deg_per_kNm:.3g} deg/kNm",
)
GEOMETRY = Kind("geometry", "robot", "geometric deviation")
AXIS_WOBBLE = Kind(
    "axis_wobble",
    "robot",
    "wobble of an axis",
    "{where} wobbles about {direction} by {amplitude_deg:.4f} deg, {order} times a turn",
)
BASE_COMPLIANCE = Kind(
    "base_compliance",
    "robot",
    "foundation that deflects",
    "The foundation tilts under the overturning moment by {compliance_deg_per_kNm:.3g} deg/kNm",
)
PAYLOAD_MASS = Kind(
    "payload_mass", "robot", "mass of the load", "Payload {where} weighs {mass_kg:.1f} kg, not what the campaign says"
)
PAYLOAD_COG = Kind(
    "payload_cog",
    "robot",
    "centre of gravity of the load",
    "The centre of gravity of payload {where} lies at {cog_mm} mm, not where the campaign says",
)
THERMAL_GROWTH = Kind("thermal_growth", "robot", "thermal growth")


def _link_compliance(site: RobotSite, joint: Joint) -> Iterator[RobotCause]:
    for angle in joint.cross_angles if not joint.prismatic else ("roll", "pitch", "yaw"):
        name = f"{joint.frame}.elastic_{angle}"
        if name in site.fitted or not site.varies(f"{identifier(joint.frame)}_m{angle}", LEAST_MOMENT):
            continue
        yield RobotCause(
            LINK_COMPLIANCE,
            joint.where,
            LETTER_OF_KIND[angle],
            (name,),
            (site.compliance(f"{identifier(joint.frame)}_m{angle}", 1e-6),),
            lambda v, c: {"compliance_deg_per_kNm": float(v[0]) * PER_KNM},
            positive=0.95,
            free_parameters=(name,),
            covariates=(f"{identifier(joint.frame)}_m{angle}",),
            limits=(0.0, np.inf),
        )


def _geometry(site: RobotSite, joint: Joint) -> Iterator[RobotCause]:
    for kind in ("x", "y", "z", "roll", "pitch", "yaw"):
        name = f"{joint.frame}.{kind}"
        if name in site.fitted or name in site.tied:
            continue
        length = kind in "xyz"
        unit, factor = ("mm", 1e3) if length else ("deg", DEG)

        def report(v: Array, c: Constants, key: str = f"{kind}_{unit}", scale: float = factor) -> dict[str, object]:
            return {key: float(v[0]) * scale}

        yield RobotCause(
            GEOMETRY,
            joint.where,
            LETTER_OF_KIND[kind],
            (name,),
            (5e-4,),
            report,
            f"The {kind} of {{where}} is off by {{{kind}_{unit}:.4f}} {unit}, which the model held fixed",
            free_parameters=(name,),
        )


def _wobble(site: RobotSite, joint: Joint) -> Iterator[RobotCause]:
    if joint.prismatic or not site.varies(f"q{joint.number}", 1e-6):
        return
    for angle in joint.cross_angles:

        def bases(c: Constants, kind: str = angle) -> tuple[Basis, ...]:
            return waves(joint, kind, c["order"])

        yield RobotCause(
            AXIS_WOBBLE,
            joint.where,
            LETTER_OF_KIND[angle],
            ("cosine", "sine"),
            (2e-4, 2e-4),
            report_wave,
            grid=({"order": 1.0}, {"order": 2.0}, {"order": 3.0}),
            bases=bases,
            covariates=(f"q{joint.number}",),
        )


def _growth(site: RobotSite, joint: Joint) -> Iterator[RobotCause]:
    nominal = site.model.frame(joint.frame).xyz
    for k, axis in enumerate("xyz"):
        length = float(nominal[k])
        if abs(length) < 0.02:
            continue
        for name in site.temperatures():
            law = f"{length!r}*{site.warmed(name)}"

            def warm(c: Constants, axis: str = axis, law: str = law) -> tuple[Basis, ...]:
                return (Basis(joint.frame, axis, law, "growth"),)

            yield RobotCause(
                THERMAL_GROWTH,
                joint.where,
                axis,
                ("growth",),
                (1.5e-5,),
                lambda v, c: {"um_per_m_K": float(v[0]) * 1e6},
                "The link of {where} grows along {direction} by {um_per_m_K:.1f} um per metre and kelvin",
                bases=warm,
                covariates=(name,),
            )
        duration = site.duration_h()
        if duration > 0:
            start = float(np.min(site.variables["time_s"]))

            def slow(
                c: Constants,
                axis: str = axis,
                sign: float = float(np.sign(length)),
                start: float = start,
                duration: float = duration,
            ) -> tuple[Basis, ...]:
                law, constants = exponential_law(start, duration, c["tau_h"])
                return (Basis(joint.frame, axis, f"{sign!r}*{law}", "growth", constants),)

            yield RobotCause(
                THERMAL_GROWTH,
                joint.where,
                axis,
                ("growth",),
                (2e-4 / duration,),
                lambda v, c: {"rate_um_per_h": float(v[0]) * 1e6, "tau_h": c["tau_h"]},
                "The link of {where} grows along {direction} by {rate_um_per_h:.1f} um per hour",
                grid=tuple({"tau_h": share * duration} for share in (0.1, 0.25, 0.6, 3.0)),
                continuous={"tau_h": (0.02 * duration, 10.0 * duration)},
                bases=slow,
                covariates=("time_s",),
            )


def _base(site: RobotSite) -> Iterator[RobotCause]:
    if any(site.varies(f"base_m{axis}", LEAST_MOMENT) for axis in "xy"):
        yield RobotCause(
            BASE_COMPLIANCE,
            "base",
            None,
            ("compliance",),
            (min(site.compliance(f"base_m{axis}", 3e-7) for axis in "xy"),),
            lambda v, c: {"compliance_deg_per_kNm": float(v[0]) * PER_KNM},
            positive=0.98,
            bases=lambda c: (
                Basis("base", "roll", "base_mx", "compliance"),
                Basis("base", "pitch", "base_my", "compliance"),
            ),
            covariates=("base_mx", "base_my"),
            limits=(0.0, np.inf),
        )
    first, every = breaks(site.variables["index"], 3)
    kinds = ("x", "y", "z", "roll", "pitch", "yaw")
    yield RobotCause(
        BASE_MOVED,
        "base",
        None,
        kinds,
        (1e-3, 1e-3, 1e-3, 5e-4, 5e-4, 5e-4),
        report_move,
        grid=tuple({"pose": i} for i in first),
        ordered={"pose": every},
        bases=lambda c: tuple(Basis("base", kind, "step(index - pose + 0.5)", kind, c) for kind in kinds),
        covariates=("index",),
    )


def _gravity(site: RobotSite) -> Iterator[RobotCause]:
    names = ("gravity.tilt_x", "gravity.tilt_y")
    if any(name in site.fitted for name in names) or not _elastic(site):
        return

    def report(v: Array, c: Constants) -> dict[str, object]:
        # a turn (tx, ty) of the downward vector leans it towards x by -ty and towards y by tx
        return {"tilt_deg": float(np.hypot(*v)) * DEG, "azimuth_deg": float(np.degrees(np.arctan2(v[0], -v[1])))}

    yield RobotCause(BASE_TILT, "base", None, names, (0.02, 0.02), report, free_parameters=names)


def _elastic(site: RobotSite) -> bool:
    return any(".elastic_" in name and value for name, value in site.model.parameters.items())


def _payloads(site: RobotSite) -> Iterator[RobotCause]:
    # where the arm's own weights are not stated, what they do would be taken for a wrong load
    if not _elastic(site) or without_masses(site.model):
        return
    for name, payload in site.model.payloads.items():
        mass_name = f"payload.{name}.mass"
        if mass_name in site.fitted:
            continue
        yield RobotCause(
            PAYLOAD_MASS,
            name,
            None,
            (mass_name,),
            (max(0.15 * payload.mass, 0.5),),
            _mass_report(payload.mass),
            free_parameters=(mass_name,),
            limits=(-payload.mass, np.inf),
        )
        cog_names = tuple(f"payload.{name}.{axis}" for axis in "xyz")
        yield RobotCause(
            PAYLOAD_COG,
            name,
            None,
            cog_names,
            (0.1, 0.1, 0.1),
            _cog_report(np.array(payload.cog)),
            free_parameters=cog_names,
            limits=(-1.0, 1.0),
        )


def _mass_report(stated: float) -> Report:
    return lambda v, c: {"mass_kg": stated + float(v[0])}


def _cog_report(stated: Array) -> Report:
    return lambda v, c: {"cog_mm": [float(x) * 1e3 for x in stated + v]}


ENTRIES = (
    Entry(on_robot=each_place(_link_compliance)),
    Entry(on_robot=each_place(_geometry)),
    Entry(on_robot=each_place(_wobble)),
    Entry(on_robot=each_place(_growth)),
    Entry(on_robot=_base),
    Entry(on_robot=_gravity),
    Entry(on_robot=_payloads),
)
