"""The robot in force on poses that took no part."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from robcal.calibration.calibrated import CalibratedRobot
from robcal.calibration.identification import IdentifiedRobot, IdentifyOptions
from robcal.calibration.joint_log import JointLog
from robcal.calibration.measurements import RobotRecording, Rows, well_measured
from robcal.calibration.verification import Verification, cross_validate, fit_nominal, repetitions, tool_errors, verify
from robcal.recipe.identification import Identification
from robcal.robot.kernel import PoseInputs
from robcal.robot.model import RobotModel
from robcal.transforms import Array

FOLDS = 5
BLUNDER, LEAST_BLUNDER = 5.0, 0.02
"""A kept-out pose is no measurement of this robot if the nominal one misses it by this factor more than any other pose,
and by this much (m) more."""


def verify_robot(
    model: RobotModel,
    identification: Identification,
    robot: CalibratedRobot,
    log: JointLog,
    options: IdentifyOptions,
    freed: RobotRecording | None = None,
    relative: Array | None = None,
) -> tuple[Verification, Rows, list[str]]:
    """Verify on the kept-out poses, or by folds where there are none.

    Parameters
    ----------
    model : the nominal robot. robot : the one in force.
    freed : the measurements without what the diagnosis found in the measuring system; relative : covariance (p, p) of
        the robot's parameters beside them.

    Returns
    -------
    The verification, the rows (n,) of its poses in the joint log, and sentences on what was left out or assumed.
    """
    rows = identification.sound
    recording = identification.recording if freed is None else freed
    notes = [] if freed is None else ["verified without the errors of the measuring system that all poses share"]
    inputs = log.inputs(robot.kernel)
    kept_out, said = well_measured(recording, identification.kept_out(log), log.names)
    notes += said
    if len(kept_out):
        nominal = fit_nominal(model, inputs.subset(rows), recording.select(rows))
        kept_out, said = without_blunders(nominal, inputs, recording, rows, kept_out, log.names)
        notes += said
        tested = robot if relative is None else replace(robot, covariance=relative)
        outcome = verify(tested, inputs.subset(kept_out), recording.select(kept_out), nominal)
        if relative is not None:
            # in the world, the robot is as uncertain as the station as well
            _, C = robot.predict(inputs.subset(kept_out))
            outcome = replace(outcome, predicted=np.sqrt(np.trace(C[:, :3, :3], axis1=1, axis2=2) / 3.0))
        return outcome, kept_out, notes
    groups = repetitions(log.q[rows])
    folds = min(FOLDS, int(groups.max()) + 1)
    with_terms = model.with_terms(robot.model.terms)
    outcome = cross_validate(
        with_terms, inputs.subset(rows), recording.select(rows), options, folds=folds, groups=groups
    )
    return outcome, rows, [*notes, f"no verification poses: {folds}-fold cross-validation over groups of poses"]


def without_blunders(
    nominal: IdentifiedRobot,
    inputs: PoseInputs,
    recording: RobotRecording,
    rows: Rows,
    kept_out: Rows,
    names: Sequence[str],
) -> tuple[Rows, list[str]]:
    """Kept-out poses without those that contradict even the nominal robot, which has seen none of them."""
    usual = max(tool_miss(nominal, inputs, recording, rows).values(), default=0.0)
    limit = max(BLUNDER * usual, usual + LEAST_BLUNDER)
    found = {pose: miss for pose, miss in tool_miss(nominal, inputs, recording, kept_out).items() if miss > limit}
    if not found or len(found) > len(kept_out) / 2:
        return kept_out, []
    notes = [
        f"kept-out pose '{names[pose]}' was left out: measured {1e3 * miss:.3g} mm from where even the nominal robot "
        f"is ({1e3 * usual:.2g} mm at most elsewhere), which is no error of a robot"
        for pose, miss in found.items()
    ]
    return kept_out[~np.isin(kept_out, list(found))], notes


def tool_miss(robot: IdentifiedRobot, inputs: PoseInputs, recording: RobotRecording, rows: Rows) -> dict[int, float]:
    """Largest miss (m) of what was measured, by row of the pose."""
    observations = recording.select(rows)
    T, _ = robot.predict(inputs.subset(rows))
    out: dict[int, float] = {}
    for pose, miss in zip(*tool_errors(T, observations)["0"], strict=True):
        row = int(rows[pose])
        out[row] = max(out.get(row, 0.0), float(miss))
    return out
