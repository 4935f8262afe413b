"""Several instruments: the robot identified from all of them, and verified by each on its own kept-out poses."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from scipy import stats

from robcal.calibration.calibrated import CalibratedRobot
from robcal.calibration.identifiability import repetitions
from robcal.calibration.identification import IdentifyOptions
from robcal.calibration.instruments import IdentifiedInstruments, Instrument, identify_instruments
from robcal.calibration.instruments.evaluator import Part
from robcal.calibration.instruments.placing import place
from robcal.calibration.joint_log import JointLog
from robcal.calibration.recording_errors.search import check_joint_log
from robcal.calibration.verification import ErrorStatistics, Verification, fit_nominal, verify
from robcal.errors import InvalidInput
from robcal.recipe.identification import Identification
from robcal.recipe.verification import FOLDS, RobotVerification
from robcal.recipe.wire_alarms import wire_alarms
from robcal.robot.kernel import Kernel
from robcal.robot.model import RobotModel

CARRIED, TIED = float(np.radians(0.02)), 0.95
"""Points tell a sensor's orientation where its standard deviation is below this (rad) and no angle is correlated more
than that with the sensor's origin."""


def identify_from_instruments(
    model: RobotModel, log: JointLog, instruments: Sequence[Instrument], options: IdentifyOptions | None = None
) -> IdentifiedInstruments:
    """Identify a robot, after a look whether the joint log belongs to what each instrument measured.

    Raises
    ------
    InvalidInput : joint angles and measurements do not belong together, or nothing is left to identify from.
    NotIdentifiable : fewer measurements than unknowns, or an instrument that cannot be placed.
    """
    kernel = Kernel(model)
    notes: list[str] = []
    start = model
    for i in sorted((i for i in instruments if not i.loop), key=lambda i: -i.dimension):
        rows = i.recording.poses
        chosen = replace(i.recording, observations=i.recording.select(rows), detailed=())
        try:
            slips = check_joint_log(model, log.inputs(kernel).subset(rows), chosen, kernel)
        except InvalidInput as error:
            raise InvalidInput(f"instrument '{i.name}': {error}") from None
        if slips and start is model:
            start = model.with_parameters({**model.parameters, **slips[0].values})
            notes.append(f"{slips[0].statement}; {slips[0].remedy}")
    instruments, reported = with_determined_orientations(Kernel(start), log, instruments)
    notes += reported
    found = identify_instruments(start, log, instruments, options)
    found = replace(found, notes=(*found.notes, *wire_alarms(start, found, log, options)))
    unstated = [i.name for i in instruments if not i.recording.stated]
    if unstated:
        notes.append(f"{' and '.join(unstated)}: no uncertainty is stated, it is estimated from the residuals")
    return replace(found, notes=(*notes, *found.notes))


def with_determined_orientations(
    kernel: Kernel, log: JointLog, instruments: Sequence[Instrument]
) -> tuple[list[Instrument], list[str]]:
    """Instruments of which the orientation of a certificate is freed where the points tell it better; a note each.

    A sensor that stands at one distance, square to what it looks at, sees its own tilt as a displacement of its origin.
    """
    out, notes = [], []
    for i in instruments:
        rows = np.array([k for k in i.recording.poses if not log.verify[k]], dtype=np.int64)
        if not i.tool.certified or not len(rows):
            out.append(i)
            continue
        free = i.tool.with_free_angles()
        part = Part(i.name, log.inputs(kernel).subset(rows), i.recording.select(rows), i.world, free)
        at = place(part, kernel.with_references(np.eye(4), np.eye(4)).frames(kernel.theta0, part.poses))
        rows_determined = sum(len(o.pose) * o.dimension for o in part.observations)
        scale = max(1.0, 2.0 * at.cost / max(1, rows_determined - 12))
        sigma = np.sqrt(np.diag(at.covariance)[6:])
        tie = np.abs(at.covariance[6:9, 9:] / np.maximum(np.outer(sigma[:3], sigma[3:]), 1e-300)).max()
        determined = (
            not any(h.startswith("flange_T_tool") for h in at.held) and np.sqrt(scale) * sigma[3:].max() < CARRIED
        )
        if determined and tie < TIED:
            out.append(replace(i, tool=free))
            notes.append(f"instrument '{i.name}': its points tell the orientation of the sensor, which is identified")
        else:
            out.append(i)
            notes.append(
                f"instrument '{i.name}': its points do not tell the orientation of the sensor from its place: "
                "flange_T_tool.rpy_deg is held as stated"
            )
    return out, notes


def leading_identification(found: IdentifiedInstruments) -> Identification:
    """The identification as the instrument sees it that tells most."""
    placed = found.placed[found.leading]
    if placed.robot is None:
        raise InvalidInput("no instrument was identified from")
    return Identification(placed.rows, placed.robot, placed.recording)


def verify_instruments(
    model: RobotModel,
    found: IdentifiedInstruments,
    log: JointLog,
    options: IdentifyOptions | None = None,
    robot: CalibratedRobot | None = None,
) -> dict[str, Verification]:
    """Each instrument on its own kept-out poses; those that have none are left out.

    Where no pose at all is kept out, every instrument is verified over folds of the poses, in which all instruments
    are identified anew.

    Parameters
    ----------
    model : the nominal robot. robot : the one in force where a diagnosis changed it.
    """
    kept = {name: np.array([k for k in p.recording.poses if log.verify[k]], int) for name, p in found.placed.items()}
    if not any(len(rows) for rows in kept.values()):
        return _by_folds(model, found, log, options)
    return {
        name: replace(_on_rows(model, found, name, rows, log, robot), rows=rows)
        for name, rows in kept.items()
        if len(rows)
    }


def _on_rows(
    model: RobotModel,
    found: IdentifiedInstruments,
    name: str,
    rows: np.ndarray,
    log: JointLog,
    robot: CalibratedRobot | None = None,
) -> Verification:
    placed = found.placed[name]
    tested: CalibratedRobot
    if placed.robot is not None and robot is None:
        tested = placed.robot
    else:
        tested = found.seen_by(name, robot or leading_identification(found).robot)
    inputs = tested.inputs(log.as_stated())
    known = placed.sound if len(placed.sound) else rows
    nominal = CalibratedRobot(model=placed.nominal)
    if not placed.instrument.loop:
        nominal = fit_nominal(model, inputs.subset(known), placed.recording.select(known))
    return verify(tested, inputs.subset(rows), placed.recording.select(rows), nominal)


def _by_folds(
    model: RobotModel, found: IdentifiedInstruments, log: JointLog, options: IdentifyOptions | None
) -> dict[str, Verification]:
    terms = leading_identification(found).robot.model.terms
    model = replace(model, terms=terms)
    groups = repetitions(log.q)
    folds = min(FOLDS, int(groups.max()) + 1)
    fold = (np.argsort(np.random.default_rng(0).permutation(int(groups.max()) + 1)) % folds)[groups]
    instruments = [p.instrument for p in found.placed.values()]
    parts: dict[str, list[Verification]] = {}
    for k in range(folds):
        part = replace(log, verify=fold == k)
        again = identify_instruments(model, part, instruments, options)
        for name, placed in again.placed.items():
            rows = np.array([i for i in placed.recording.poses if part.verify[i]], int)
            if len(rows) and placed.robot is not None:
                one = _on_rows(model, again, name, rows, part)
                parts.setdefault(name, []).append(replace(one, rows=rows))
    return {name: merged(some) for name, some in parts.items()}


def merged(parts: Sequence[Verification]) -> Verification:
    """One verification of several folds."""
    names = list(parts[0].tools)
    errors = {n: np.concatenate([p.errors[n] for p in parts]) for n in names}
    nominal = {n: np.concatenate([(p.nominal_errors or {})[n] for p in parts]) for n in names}
    degrees = np.concatenate([p.degrees for p in parts])
    square = np.concatenate([p.normalised for p in parts])
    measured = degrees > 0
    inside = (square * degrees)[measured] <= stats.chi2.isf(0.05, degrees[measured])
    return replace(
        parts[0],
        kind="cross-validation",
        poses=sum(p.poses for p in parts),
        tools={n: ErrorStatistics.of(e) for n, e in errors.items()},
        nominal={n: ErrorStatistics.of(e) for n, e in nominal.items()},
        errors=errors,
        nominal_errors=nominal,
        normalised=square,
        degrees=degrees,
        p_value=float(stats.chi2.sf(float(np.sum(square * degrees)), max(1, int(degrees.sum())))),
        coverage_95=float(np.mean(inside)),
        predicted=np.concatenate([p.predicted for p in parts]),
        iso=None,
        rows=np.concatenate([p.rows for p in parts]),
    )


def telling_verification(found: IdentifiedInstruments, verified: Mapping[str, Verification]) -> RobotVerification:
    """The verification of the instrument of the highest dimension that has kept-out poses.

    Raises
    ------
    InvalidInput : no instrument could be verified.
    """
    if not verified:
        raise InvalidInput("no instrument has poses to verify with: set 'verify' in the column set")
    name = max(verified, key=lambda n: (found.placed[n].instrument.dimension, verified[n].poses))
    chosen = verified[name]
    notes = [f"verified by instrument '{name}'"]
    if chosen.kind == "cross-validation":
        notes.append("no verification poses: cross-validation over groups of poses, all instruments identified anew")
    own = replace(chosen, rows=np.arange(len(chosen.rows)))
    return RobotVerification(own, None, chosen.rows, tuple(notes))
