"""Causes that act about a joint as its load does: compliance, stiffness, lost motion, balancing."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from robcal.cause import Kind
from robcal.physics.cause import LEAST_MOMENT, PER_KNM, Array, Basis, Constants, Entry, RobotCause, amplitude_phase
from robcal.physics.joint import LARGEST
from robcal.physics.site import Joint, RobotSite, each_joint, waves

STIFFNESS_NONLINEAR = Kind(
    "stiffness_nonlinear",
    "robot",
    "stiffness that changes with load",
    "The gear of {where} stiffens or softens with load: cubic term {cubic_deg_per_kNm3:.3g} deg/kNm^3",
)
LOST_MOTION = Kind(
    "lost_motion",
    "robot",
    "lost motion",
    "{where} loses {amplitude_deg:.4f} deg around zero load (lost motion, scale {torque_Nm:.3g} N m)",
)
JOINT_COMPLIANCE = Kind(
    "joint_compliance",
    "robot",
    "elasticity about the joint's own axis",
    "{where} gives way about its own axis by {compliance_deg_per_kNm:.3g} deg/kNm, which the model leaves out",
)
COUNTERBALANCE = Kind(
    "counterbalance",
    "robot",
    "balancing torque",
    "A balancing torque of {torque_Nm:.0f} N m acts on {where} that the model does not know",
)
TORQUE_SCALES = (0.02, 0.06, 0.2, 0.5, 1.2)
"""Scales of a lost motion that are tried first, in shares of the largest load torque: joints are built for theirs."""
KNOWN_TO_GIVE = 3.0
"""Prior weight of a joint's own compliance where the model leaves it out: every joint gives way about its axis."""


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


ENTRIES = (
    Entry(on_robot=each_joint(_compliance)),
    Entry(on_robot=each_joint(_stiffness)),
    Entry(on_robot=each_joint(_lost_motion)),
    Entry(on_robot=_counterbalance),
)
