"""The robot in force on poses that took no part."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from robcal.calibration.calibrated import CalibratedRobot
from robcal.calibration.cell import with_fitted_cell
from robcal.calibration.identification import IdentifiedRobot, IdentifyOptions
from robcal.calibration.joint_log import JointLog
from robcal.calibration.measurements import RobotRecording, Rows, well_measured
from robcal.calibration.observations import FrameObservations
from robcal.calibration.verification import Verification, cross_validate, fit_nominal, repetitions, tool_errors, verify
from robcal.errors import InvalidInput, RobcalError
from robcal.recipe.identification import Identification
from robcal.recipe.robot_diagnosis import RobotDiagnosis
from robcal.robot.kernel import PoseInputs
from robcal.robot.model import RobotModel
from robcal.transforms import Array, difference

FOLDS = 5
BLUNDER, LEAST_BLUNDER = 5.0, 0.02
"""A kept-out pose is no measurement of this robot if the nominal one misses it by this factor more than any other pose,
and by this much (m) more."""
FAR, FEWEST_OF_A_PLACE = 5.0, 10
"""Factor by which errors shrink once base and tool are fitted to poses measured elsewhere, and how many these are."""
ALIKE = 3.0
"""Factor by which these then scatter more than the poses that identified the robot, at most."""
SIGMAS = 4.0
"""Standard errors by which the mean of the residuals may differ from zero."""


@dataclass(frozen=True)
class RobotVerification:
    """The robot in force where it was not identified.

    Attributes
    ----------
    delivered : against the measurements as they are, predicted from what the table of poses states, as for any user.
    recorded : with what only the recording knows (approach directions inferred, measurements freed of what was found in
        the measuring system), None where there is nothing of that.
    unstated : the same without the approach directions that were inferred; None where there are none.
    rows : (n,) rows of the poses in the joint log. notes : what was left out or assumed.
    at_home : whether base and tool were fitted to these very poses, since nothing else tells them.
    elsewhere : where the kept-out poses lie off together, as from another place or with another tool, in words.
    """

    delivered: Verification
    recorded: Verification | None
    rows: Rows = field(repr=False)
    notes: tuple[str, ...] = ()
    unstated: Verification | None = None
    at_home: bool = False
    elsewhere: str = ""


def verify_robot(
    model: RobotModel,
    identification: Identification,
    robot: CalibratedRobot,
    log: JointLog,
    options: IdentifyOptions | None = None,
    freed: RobotRecording | None = None,
    relative: Array | None = None,
    placed: RobotRecording | None = None,
) -> RobotVerification:
    """Verify on the kept-out poses, or by folds where there are none.

    Parameters
    ----------
    model : the nominal robot. robot : the one in force.
    freed : the measurements without what the diagnosis found in the measuring system.
    relative : covariance (p, p) of the robot's parameters against frames of the own station.
    placed : the measurements in the frame that the robot speaks in, where the station or the base moved.
    """
    options = options or IdentifyOptions()
    rows, recording = identification.sound, identification.recording
    # only the recording knows that station or base moved, and when
    freed = freed if freed is not None else placed
    stated, inputs = robot.inputs(log.as_stated()), log.inputs(robot.kernel)
    kept_out, notes = well_measured(recording, identification.kept_out(log), log.names)
    if not len(kept_out):
        groups = repetitions(log.q[rows])
        folds = min(FOLDS, int(groups.max()) + 1)
        with_terms = model.with_terms(robot.model.terms)
        expected = {f"{term.name}.{short}": size for term in robot.model.terms for short, size in term.priors.items()}
        outcome = cross_validate(
            with_terms,
            inputs.subset(rows),
            recording.select(rows),
            replace(options, priors={**expected, **options.priors}),
            folds=folds,
            groups=groups,
            stated=stated.subset(rows),
        )
        notes = [*notes, f"no verification poses: {folds}-fold cross-validation over groups of poses"]
        return RobotVerification(outcome, None, rows, tuple(notes))
    tested = robot if relative is None else replace(robot, covariance=relative)
    foreign = _foreign(recording, rows, kept_out)
    if foreign:
        # another measuring system has a world and a tool of its own, and nobody but these poses knows them
        at_home = with_fitted_cell(robot.kernel, stated.subset(kept_out), recording.select(kept_out), anew=True)
        tested = replace(tested, model=at_home)
        notes = [*notes, f"{foreign} serve the verification alone: their world and tool are fitted to these very poses"]
        nominal = fit_nominal(model, stated.subset(kept_out), recording.select(kept_out))
    else:
        nominal = fit_nominal(model, stated.subset(rows), recording.select(rows))
        kept_out, said = without_blunders(nominal, stated, recording, rows, kept_out, log.names)
        notes = [*notes, *said]
    outcome = verify(tested, stated.subset(kept_out), recording.select(kept_out), nominal)
    if relative is not None:
        # in the world, the robot is as uncertain as the station as well
        _, C = robot.predict(stated.subset(kept_out))
        outcome = replace(outcome, predicted=np.sqrt(np.trace(C[:, :3, :3], axis1=1, axis2=2) / 3.0))
    recorded, unstated = None, outcome if log.inferred else None
    if not foreign and (freed is not None or log.inferred):
        used = recording if freed is None else freed
        at_home = with_fitted_cell(robot.kernel, inputs.subset(rows), used.select(rows))
        beside = replace(tested, model=at_home)
        recorded = verify(beside, inputs.subset(kept_out), used.select(kept_out))
        if freed is not None:
            if log.inferred:
                at_home = with_fitted_cell(robot.kernel, stated.subset(rows), used.select(rows))
                beside = replace(tested, model=at_home)
                unstated = verify(beside, stated.subset(kept_out), used.select(kept_out))
            # the stated uncertainty is that of the robot as a table of poses states it; faults of the measuring are
            # told apart, but directions that nobody states are no user's
            told = recorded if unstated is None else unstated
            judged = {name: getattr(told, name) for name in ("normalised", "degrees", "p_value", "coverage_95")}
            outcome = replace(outcome, **judged)
            notes = [*notes, "uncertainties are judged without the faults of the measuring system that were found"]
    elsewhere = "" if foreign else measured_elsewhere(robot, stated, recording, rows, kept_out)
    return RobotVerification(
        outcome, recorded, kept_out, (*notes, *filter(None, [elsewhere])), unstated, bool(foreign), elsewhere
    )


def measured_elsewhere(
    robot: CalibratedRobot, inputs: PoseInputs, recording: RobotRecording, rows: Rows, kept_out: Rows
) -> str:
    """Whether another base and tool explain what the robot misses at the kept-out poses, in words; empty if not."""
    before, identified = _rms(robot, inputs, recording, kept_out), _rms(robot, inputs, recording, rows)
    if len(kept_out) < FEWEST_OF_A_PLACE or before < FAR * identified:
        return ""
    try:
        moved = with_fitted_cell(robot.kernel, inputs.subset(kept_out), recording.select(kept_out), anew=True)
    except (RobcalError, np.linalg.LinAlgError):  # these poses determine no base and tool: nothing speaks for a place
        return ""
    after = _rms(replace(robot, model=moved), inputs, recording, kept_out)
    if before < FAR * after or after > ALIKE * identified:  # something else is wrong with them as well
        return ""
    return (
        f"the kept-out poses lie off together: {1e3 * before:.3g} mm as measured, {1e3 * after:.3g} mm once base and "
        "tool are fitted to them; they were measured from another place or with another tool: list the two recordings "
        "as instruments of their own"
    )


def _rms(robot: CalibratedRobot, inputs: PoseInputs, recording: RobotRecording, rows: Rows) -> float:
    """What the robot misses (RMS, m) at rows of a recording."""
    _, errors = tool_errors(robot.predict(inputs.subset(rows))[0], recording.select(rows))["0"]
    return float(np.sqrt(np.mean(errors**2)))


def kept_out_gain(
    model: RobotModel,
    identification: Identification,
    diagnosed: RobotDiagnosis,
    log: JointLog,
    options: IdentifyOptions | None = None,
) -> tuple[float, RobotVerification]:
    """What the identified robot misses (RMS, m) where the one in force is verified, and that verification.

    Both against the same measurements, and both as any user would predict.
    """
    placed = diagnosed.placed
    after = verify_robot(
        model, identification, diagnosed.robot, log, options, diagnosed.corrected, diagnosed.relative, placed
    )
    if not diagnosed.in_force.diagnosed and not diagnosed.recording.own_station:
        return after.delivered.tools["0"].rms, after
    before = verify_robot(model, identification, identification.robot, log, options, placed=placed)
    return before.delivered.tools["0"].rms, after


def _foreign(recording: RobotRecording, rows: Rows, kept_out: Rows) -> str:
    """Kinds of measurement that only poses to verify with have, in words; empty if there are none."""
    known = {type(o) for o in recording.select(rows)}
    kinds = [type(o).__name__.removesuffix("Observations").lower() + "s" for o in recording.select(kept_out)]
    foreign = [k for o, k in zip(recording.select(kept_out), kinds, strict=True) if type(o) not in known]
    if foreign and len(foreign) < len(kinds):
        raise InvalidInput(
            f"{' and '.join(foreign)} are measured at poses to verify with only, {kinds[0]} at others: list them as "
            "instruments of their own"
        )
    return " and ".join(foreign)


def datum_note(
    identification: Identification, robot: CalibratedRobot, log: JointLog, placed: RobotRecording | None = None
) -> str:
    """Where measured frames and predictions at the identified poses do not agree in the mean; empty if they do."""
    rows = identification.sound
    T = robot.predict(robot.inputs(log.as_stated()).subset(rows))[0]
    for o in (placed or identification.recording).select(rows):
        if not isinstance(o, FrameObservations) or len(o.pose) < 3:
            continue
        off = difference(T[o.pose], o.world_T_tool)[:, :3]
        off = np.einsum("nij,nj->ni", T[o.pose, :3, :3], off)
        mean, sigma = off.mean(axis=0), off.std(axis=0, ddof=1) / np.sqrt(len(off))
        if np.any(np.abs(mean) > SIGMAS * sigma + 1e-9):
            told = ", ".join(f"{1e3 * m:+.3g} +- {1e3 * s:.2g}" for m, s in zip(mean, sigma, strict=True))
            return f"predictions differ from the measured frames by {told} mm in the mean (x, y, z)"
    return ""


def without_blunders(
    nominal: IdentifiedRobot,
    inputs: PoseInputs,
    recording: RobotRecording,
    rows: Rows,
    kept_out: Rows,
    names: Sequence[str],
) -> tuple[Rows, list[str]]:
    """Kept-out poses without those that contradict even the nominal robot, which has seen none of them."""
    typical = max(tool_residual(nominal, inputs, recording, rows).values(), default=0.0)
    limit = max(BLUNDER * typical, typical + LEAST_BLUNDER)
    found = {
        pose: residual
        for pose, residual in tool_residual(nominal, inputs, recording, kept_out).items()
        if residual > limit
    }
    if not found or len(found) > len(kept_out) / 2:
        return kept_out, []
    notes = [
        f"kept-out pose '{names[pose]}' was left out: measured {1e3 * residual:.3g} mm from where even the nominal "
        f"robot is ({1e3 * typical:.2g} mm at most elsewhere), which is no error of a robot"
        for pose, residual in found.items()
    ]
    return kept_out[~np.isin(kept_out, list(found))], notes


def tool_residual(
    robot: IdentifiedRobot, inputs: PoseInputs, recording: RobotRecording, rows: Rows
) -> dict[int, float]:
    """Largest miss (m) of what was measured, by row of the pose."""
    observations = recording.select(rows)
    T, _ = robot.predict(inputs.subset(rows))
    out: dict[int, float] = {}
    for pose, residual in zip(*tool_errors(T, observations)["0"], strict=True):
        row = int(rows[pose])
        out[row] = max(out.get(row, 0.0), float(residual))
    return out


PAYS = 0.95
"""Share of the error that has to be left for approach directions to be worth stating."""


def approach_note(found: RobotVerification) -> list[str]:
    """What stating approach directions would gain."""
    if found.unstated is None or found.recorded is None:
        return []
    before, after = (1e3 * v.tools["0"].rms for v in (found.unstated, found.recorded))
    if after > PAYS * before:
        return []
    return [f"state approach: {before:.3f} -> {after:.3f} mm RMS at the kept-out poses"]
