"""The facts that the verdict on a robot rests on, from what was identified, diagnosed and verified."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from robcal.calibration.calibrated import CalibratedRobot
from robcal.calibration.joint_log import JointLog
from robcal.calibration.observations import FrameObservations
from robcal.calibration.verdict import Deviation, Facts
from robcal.calibration.verification import Verification
from robcal.physics.library import kinds
from robcal.recipe.identification import Identification
from robcal.robot.model import GEOMETRIC_KINDS
from robcal.transforms import log_so3

LEVEL = 0.01
SURE = 3.0
"""Standard deviations below zero from which on an elasticity or a mass counts as negative."""


def robot_facts(
    identification: Identification,
    robot: CalibratedRobot,
    log: JointLog,
    verification: Verification,
    diagnosis: Mapping[str, Any] | None = None,
    untested: Sequence[str] = (),
    disagreeing: Sequence[str] = (),
) -> Facts:
    """Facts on the robot in force; ``diagnosis`` as in diagnosis.json, ``untested`` : doubts about coordinates,
    ``disagreeing`` : results that contradict one another."""
    found = identification.robot
    diagnosis = diagnosis or {}
    p = (diagnosis.get("unexplained") or {}).get("p_value")
    normalised = float(np.sum(verification.normalised * verification.degrees) / max(1, verification.degrees.sum()))
    nominal = verification.nominal["0"].mean if verification.nominal else None
    return Facts(
        sigma0=found.sigma0,
        explained=bool(diagnosis.get("causes")) and (p is None or p >= LEVEL) and normalised <= SURE**2,
        before_mm=None if nominal is None else 1e3 * nominal,
        before_deg=_nominal_turn(identification, log),
        after_mm=1e3 * verification.tools["0"].mean,
        geometry=_geometry(robot),
        negative=_negative(robot),
        untested=tuple(untested),
        disagreeing=tuple(disagreeing),
        coverage_95=verification.coverage_95 if np.isfinite(verification.coverage_95) else None,
        kept_out=verification.poses,
        converged=found.summary.converged,
        unexplained=p is not None and p < LEVEL,
        unnamed=any(not kinds()[cause["cause"]].named for cause in diagnosis.get("causes", [])),
    )


def _geometry(robot: CalibratedRobot) -> tuple[Deviation, ...]:
    """Geometric deviations of the chain's frames; base and tool have no file to be off."""
    out = []
    for name, value in robot.values.items():
        frame, _, kind = name.rpartition(".")
        if kind in GEOMETRIC_KINDS and frame not in ("base", "tool"):
            length = kind in "xyz"
            out.append(Deviation(name, float(1e3 * value if length else np.degrees(value)), "mm" if length else "deg"))
    return tuple(out)


def _negative(robot: CalibratedRobot) -> tuple[Deviation, ...]:
    out = []
    masses = {f"payload.{name}.mass": load.mass for name, load in robot.model.payloads.items()}
    for name, value, sigma in zip(robot.names, robot.theta, robot.sigma, strict=True):
        if name.rpartition(".")[2].startswith("elastic_") and value < -SURE * sigma:
            out.append(Deviation(name, float(np.degrees(value) * 1e3), "deg/kNm"))
        elif name in masses and masses[name] + value < -SURE * sigma:
            out.append(Deviation(name, float(masses[name] + value), "kg"))
    return tuple(out)


def _nominal_turn(identification: Identification, log: JointLog) -> float | None:
    """RMS turn (deg) by which the nominal robot in its best cell misses the measured frames; None without frames."""
    nominal = identification.robot.nominal
    frames = [o for o in identification.recording.select(identification.sound) if isinstance(o, FrameObservations)]
    if nominal is None or not frames:
        return None
    bare = CalibratedRobot(model=nominal)
    T = bare.predict(log.inputs(bare.kernel).subset(identification.sound))[0]
    turns = [log_so3(np.swapaxes(T[o.pose, :3, :3], 1, 2) @ o.world_T_tool[:, :3, :3]) for o in frames]
    return float(np.degrees(np.sqrt(np.mean(np.sum(np.concatenate(turns) ** 2, axis=1)))))
