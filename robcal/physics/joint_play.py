"""Causes that act as the direction does from which a joint arrives: backlash, hysteresis."""

from collections.abc import Iterator

import numpy as np

from robcal.cause import Kind
from robcal.physics.cause import Array, Basis, Constants, Entry, RobotCause
from robcal.physics.joint import LARGEST
from robcal.physics.site import Joint, RobotSite, each_joint
from robcal.robot.terms import identifier

BACKLASH = Kind("backlash", "robot", "backlash")
HYSTERESIS = Kind("hysteresis", "robot", "hysteresis")
MOST_THRESHOLDS = 60
TRIED_THRESHOLDS = 14
"""Tried first, densely where few poses count as unloaded: friction is small against loads."""
UPRIGHT_SHARE = 0.005
"""An axis whose torque is below this share of the moment on its bearings is upright: what torque the fit gives it comes
from deviations of a few mrad, whose sign friction hides."""


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


ENTRIES = (Entry(on_robot=each_joint(_backlash)), Entry(on_robot=each_joint(_hysteresis)))
