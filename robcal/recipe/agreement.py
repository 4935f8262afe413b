"""Do the results of a run agree with one another? What the report says is what the user gets.

Independent of how the results came about: the delivered error is computed anew from the delivered robot, and what
diagnosis.json says is held against it.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np

from robcal.calibration.calibrated import CalibratedRobot
from robcal.calibration.joint_log import JointLog
from robcal.calibration.measurements import RobotRecording
from robcal.calibration.verification import tool_errors
from robcal.recipe.verification import RobotVerification

ALIKE = 1e-6
"""Relative difference of two figures that are to be the same."""


def disagreements(
    found: RobotVerification,
    robot: CalibratedRobot,
    log: JointLog,
    recording: RobotRecording,
    diagnosis: Mapping[str, Any] | None = None,
) -> list[str]:
    """What contradicts what, in words; empty where all results agree.

    Parameters
    ----------
    found : verification of the delivered ``robot``. diagnosis : content of diagnosis.json.
    """
    reported = found.delivered.tools["0"].rms
    out = []
    if found.delivered.kind == "verify-set" and not found.at_home:
        T, _ = robot.predict(robot.inputs(log.as_stated()).subset(found.rows))
        residual = float(np.sqrt(np.mean(tool_errors(T, recording.select(found.rows))["0"][1] ** 2)))
        out += _unequal("the delivered error", reported, "what predict gives", residual)
    if not diagnosis or diagnosis.get("heldout_mm") is None:
        return out
    after = diagnosis["heldout_mm"].get("after")
    if after is not None:
        out += _unequal("the diagnosis' error afterwards", 1e-3 * after, "the verification's", reported)
    if "in_force" in diagnosis:
        out += _in_force(diagnosis, robot)
    return out


def _in_force(diagnosis: Mapping[str, Any], robot: CalibratedRobot) -> list[str]:
    """Contradictions between what is said to be in force, the causes, and the terms of the robot."""
    causes = [cause for cause in diagnosis.get("causes") or [] if cause.get("in_force") is not None]
    out = []
    if diagnosis["in_force"] and causes and not any(cause["in_force"] for cause in causes):
        out.append("something found is said to be in force, but no cause is")
    names = {term.cause for term in robot.model.terms if term.cause}
    force = {cause["cause"] for cause in causes if cause["in_force"]}
    waits = {cause["cause"] for cause in causes if not cause["in_force"]} - force
    out += [f"cause '{name}' is said not to be in force, but the robot has it" for name in sorted(names & waits)]
    return out


def _unequal(what: str, a: float, other: str, b: float) -> list[str]:
    if np.isclose(a, b, rtol=ALIKE, atol=1e-12):
        return []
    return [f"{what} is {1e3 * a:.6g} mm, {other} {1e3 * b:.6g} mm"]
