"""Stage verify: the calibrated robot on poses that took no part, and the files that hand it on."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from pipeline import artifacts
from pipeline.codec import save_arrays
from pipeline.instrument_results import instruments_result
from pipeline.json_io import read_json
from pipeline.result_sections import noise_section, verdict_section, verification_section
from pipeline.runs import Run
from pipeline.stages.base import Context, Outcome, Stage, no_files
from pipeline.stages.identify import instruments_in_force, load_calibrated, options_of, require_robot
from robcal.calibration.calibrated import CalibratedRobot
from robcal.calibration.instruments import IdentifiedInstruments
from robcal.calibration.measurements import RobotObservations
from robcal.calibration.tolerance import conformity
from robcal.calibration.verdict import verdict
from robcal.calibration.verification import Verification
from robcal.errors import InvalidInput, located
from robcal.files.poses_table import Poses
from robcal.files.residual_table import residual_columns
from robcal.files.robot_file import write_robot
from robcal.files.tables import write_table
from robcal.recipe.agreement import disagreements
from robcal.recipe.identification import Identification
from robcal.recipe.instruments import leading_identification, telling_verification, verify_instruments
from robcal.recipe.noise import noise_of
from robcal.recipe.verdict import robot_facts
from robcal.recipe.verification import RobotVerification, approach_note, datum_note, verify_robot
from robcal.robot.model import parameter_unit
from robcal.transforms import Array

NAME = "verify"


def work(context: Context) -> Outcome:
    """Verify on the kept-out poses, or by folds where there are none; write the calibrated robot."""
    campaign, run = context.campaign, context.run
    robot, poses = require_robot(campaign)
    identification, delivered, relative = _before(run)
    calibrated = load_calibrated(run)
    diagnosed = run.record("diagnose") is not None
    placed = run.find(artifacts.PLACED) if diagnosed else None
    options = options_of(campaign, identification.recording.stated)
    instruments = instruments_in_force(run)
    if instruments is not None:
        identification = leading_identification(instruments)
    verified: dict[str, Verification] = {}
    try:
        if instruments is not None:
            verified = verify_instruments(robot, instruments, poses, options)
            found = telling_verification(instruments, verified)
        else:
            # a diagnosis has verified already what it delivers
            found = delivered or verify_robot(robot, identification, calibrated, poses, options, relative=relative)
    except InvalidInput as error:
        raise located(error, str(poses.path)) from None
    write_robot(run.robot, calibrated.model, f"calibrated from campaign {campaign.name}")
    _write_covariance(run, calibrated)
    _write_residuals(run, poses, calibrated, identification.recording.observations, instruments)
    outputs = [
        run.save(artifacts.VERIFICATION, (found.delivered, found.rows)),
        run.robot,
        run.covariance,
        run.residuals,
    ]
    datum = "" if instruments is not None else datum_note(identification, calibrated, poses, placed)
    notes = [*found.notes, *approach_note(found), *filter(None, [datum])]
    if placed is not None:
        notes.append(
            "station or base moved during the recording: the robot speaks in the frame of the first pose; errors are "
            "against the measurements as they are, those as recorded with the moves taken back"
        )
    diagnosis = read_json(run.diagnosis) if diagnosed and run.diagnosis.is_file() else None
    recording = identification.recording
    said = diagnosis if relative is None else None  # the diagnosis speaks of the robot before the joint adjustment
    wrong = [] if instruments is not None else disagreements(found, calibrated, poses, recording, said)
    doubts = doubtful_coordinates(run)
    noise = noise_of(identification, calibrated, poses)
    facts = robot_facts(identification, calibrated, poses, found.delivered, diagnosis, doubts, wrong)
    facts = replace(facts, elsewhere=found.elsewhere)
    wanted = campaign.entry.tolerance_mm
    if wanted is not None:
        facts = replace(facts, conformity=conformity(found.delivered.errors["0"], wanted / 1e3, noise.along))
    judged = verdict(facts)
    told = verdict_section(judged, facts.conformity)
    result = {"verification": verification_section(found), "noise": noise_section(noise), "verdict": told}
    if instruments is not None:
        sections = {name: verification_section(RobotVerification(v, None, v.rows)) for name, v in verified.items()}
        result["instruments"] = instruments_result(instruments, sections)
    return Outcome(result, outputs, [*notes, *noise.notes])


def _before(run: Run) -> tuple[Identification, RobotVerification | None, Array | None]:
    """What the robot is verified against, its verification where a diagnosis has made it already, and the covariance of
    its parameters against frames of the cameras it was adjusted with."""
    adjusted = run.find(artifacts.ADJUSTED)
    if adjusted is not None:  # the frames, too, are those of the cameras as adjusted
        return adjusted.identification, None, adjusted.adjustment.relative
    return run.load(artifacts.IDENTIFICATION), run.find(artifacts.DELIVERED), None


def doubtful_coordinates(run: Run) -> list[str]:
    """What the surveys say against the coordinates that were given."""
    record = run.record("survey")
    surveys = dict(record.result).get("survey", {}) if record is not None else {}
    return [doubt for entry in surveys.values() for doubt in entry.get("contradictions", [])]


def _write_covariance(run: Run, calibrated: CalibratedRobot) -> None:
    save_arrays(
        run.covariance,
        {
            "names": np.array(calibrated.names, dtype=np.str_),
            "units": np.array([parameter_unit(calibrated.model, name) for name in calibrated.names], dtype=np.str_),
            "theta": calibrated.theta,
            "covariance": calibrated.covariance,
        },
    )


def _write_residuals(
    run: Run,
    poses: Poses,
    robot: CalibratedRobot,
    observations: Sequence[RobotObservations],
    instruments: IdentifiedInstruments | None = None,
) -> None:
    """residuals.csv: measured minus modelled; frames as a turn vector and in tool coordinates, points in the world."""
    if instruments is None:
        write_table(run.residuals, residual_columns(poses, robot, observations))
        return
    columns: dict[str, list[object]] = {}
    for name, placed in instruments.placed.items():
        some = residual_columns(poses, instruments.seen_by(name, robot), placed.recording.observations)
        some["instrument"] = [name] * len(some["pose"])
        for key, values in some.items():
            columns.setdefault(key, []).extend(values)
    write_table(run.residuals, columns)


STAGE = Stage(
    name=NAME,
    applies=lambda campaign: campaign.robot is not None and campaign.poses is not None and campaign.measures_robot,
    work=work,
    inputs=no_files,
    settings=lambda campaign: [campaign.name, campaign.entry.model_dump(include={"model", "tolerance_mm"})],
    after=("identify", "diagnose", "adjust"),
    module=__name__,
)
