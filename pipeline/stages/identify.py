"""Stage identify: geometry and elasticity of the robot from everything that was measured of it."""

from typing import Any

import numpy as np

from pipeline.artifacts import (
    ADJUSTED,
    CALIBRATED,
    DIAGNOSED_INSTRUMENTS,
    HAND_EYE,
    IDENTIFICATION,
    IDENTIFIED,
    INSTRUMENTS,
    ORIENTATION,
    POINTS,
)
from pipeline.bodies import body_for_robot
from pipeline.campaign import Campaign
from pipeline.instrument_results import instrument_notes, instruments_result
from pipeline.model_priors import model_priors
from pipeline.runs import Run
from pipeline.stages.base import Context, Outcome, Stage
from pipeline.stages.observations import build_instruments, build_recording, corrections_of
from robcal.calibration.calibrated import CalibratedRobot
from robcal.calibration.identification import IdentifiedRobot, IdentifyOptions
from robcal.calibration.instruments import IdentifiedInstruments
from robcal.calibration.measurements import RobotRecording, Rows
from robcal.calibration.recording_errors import mirror_residuals
from robcal.calibration.recording_errors.search import fault_of
from robcal.errors import InvalidInput, RobcalError, located
from robcal.files.poses_table import Poses
from robcal.files.robot_file import write_robot
from robcal.files.schemas import proposal
from robcal.photogrammetry.survey.given_coordinates import GivenCoordinates
from robcal.recipe.identification import identify_robot
from robcal.recipe.instruments import leading_identification
from robcal.recipe.robot_diagnosis import Measured, undiagnosed
from robcal.recipe.wires import identify_with_corrections
from robcal.robot.kernel import Kernel
from robcal.robot.model import RobotModel

NAME = "identify"
SETTINGS = {
    *("robot", "model", "payloads", "measurements", "body"),
    *("instruments", "same_world", "same_tool", "world_T_base", "flange_T_tool"),
}
"""Entries of campaign.yaml that this stage depends on."""

SUFFIXES = {".csv", ".yaml", ".yml", ".urdf", ".xml"}
"""Files of a campaign that this stage may depend on; all others are images."""


def options_of(campaign: Campaign, stated: bool) -> IdentifyOptions:
    """Choices of the identification from campaign.yaml."""
    chosen = campaign.entry.model
    return IdentifyOptions(
        parameters=chosen.parameters if isinstance(chosen.parameters, str) else tuple(chosen.parameters),
        robust=chosen.robust,
        objective="basis" if chosen.objective == "basis_norm" else "maximum_likelihood",
        statics=chosen.statics,
        joint_sigma=None if chosen.joint_sigma_deg is None else float(np.radians(chosen.joint_sigma_deg)),
        priors={} if campaign.robot is None else model_priors(chosen.priors, campaign.robot),
        covariance="auto" if stated else "estimated",
    )


def work(context: Context) -> Outcome:
    """Identify the robot from the poses that are not kept out."""
    campaign, run = context.campaign, context.run
    robot, poses = require_robot(campaign)
    if campaign.instruments:
        return _with_instruments(context)
    recording = build_recording(campaign, run, body_for_robot(campaign, run))
    _check_mirror_image(campaign, run, recording)
    try:
        found = identify_robot(robot, poses, recording, options_of(campaign, recording.stated))
    except InvalidInput as error:
        raise located(error, str(poses.path)) from None
    alone: CalibratedRobot = found.robot
    if not campaign.entry.diagnosis.enabled:
        measured = Measured(body_for_robot(campaign, run), run.find(POINTS), run.find(ORIENTATION))
        alone = undiagnosed(found, poses, measured)
    outputs = [run.save(IDENTIFICATION, found), run.save(IDENTIFIED, alone)]
    write_robot(run.robot, found.robot.model, f"calibrated from campaign {campaign.name}, before the diagnosis")
    notes = [*found.recording.notes, *_notes(found.robot, poses, found.rows)]
    return Outcome({"identification": _result(found.robot, found.rows)}, outputs, notes)


def _with_instruments(context: Context) -> Outcome:
    """Identify the robot from all instruments together."""
    campaign, run = context.campaign, context.run
    robot, poses = require_robot(campaign)
    options = options_of(campaign, stated=True)
    try:
        found = identify_with_corrections(
            robot, poses, build_instruments(campaign, run), corrections_of(campaign), options
        )
    except InvalidInput as error:
        raise located(error, str(campaign.path)) from None
    leading = leading_identification(found)
    outputs = [run.save(IDENTIFICATION, leading), run.save(IDENTIFIED, leading.robot), run.save(INSTRUMENTS, found)]
    seen = found.seen_by(found.telling, leading.robot)
    write_robot(run.robot, seen.model, f"calibrated from campaign {campaign.name}, before the diagnosis")
    notes = [*found.notes, *instrument_notes(found, poses)]
    together = _result(leading.robot, leading.rows) | {
        "poses": len(set().union(*(p.rows.tolist() for p in found.placed.values()))),
        "parameters": len(found.names),
        "outliers": sum(int(np.count_nonzero(~p.used)) for p in found.placed.values()),
    }
    return Outcome({"identification": together, "instruments": instruments_result(found)}, outputs, notes)


def _check_mirror_image(campaign: Campaign, run: Run, recording: RobotRecording) -> None:
    """Where survey and given coordinates are mirror images of each other, the robot tells which of them is right.

    Raises
    ------
    InvalidInput : they are.
    """
    record, name = run.record("survey"), campaign.carried_body
    entry = dict(record.result).get("survey", {}).get(name, {}) if record is not None else {}
    if not entry.get("mirrored_mm") or name is None:
        return
    robot, poses = require_robot(campaign)
    words = GivenCoordinates(mirrored=tuple(1e-3 * value for value in entry["mirrored_mm"])).mirror_words
    straight, mirrored = mirror_residuals(robot, poses.inputs(Kernel(robot)), recording.observations)
    proof = f"the robot misses the frames by {1e3 * straight:.3g} mm, their mirror images by {1e3 * mirrored:.3g} mm"
    survey = campaign.bodies[name].survey
    marks = survey.marks.path if survey is not None and survey.marks is not None else campaign.path
    if mirrored < straight:
        raise InvalidInput(
            f"{marks}: the image axes are mirrored: {words}, and {proof}: count x_px to the right and y_px downwards "
            "from the centre of the top left pixel"
        )
    raise InvalidInput(
        f"{campaign.bodies[name].file.path}: the given coordinates are mirrored: {words}, while {proof}: a column of "
        "xyz_mm has the wrong sign, or two are exchanged"
    )


def check_joint_limits(campaign: Campaign, run: Run) -> None:
    """Refuse poses beyond the robot's ranges; where a slip in the recording explains them, name it with the proof.

    Raises
    ------
    InvalidInput : some pose is beyond a range of the robot file.
    """
    poses, robot = campaign.poses, campaign.robot
    if poses is None or robot is None or not poses.outside:
        return
    fault = ""
    if campaign.measurements and not campaign.instruments:
        kernel = Kernel(robot, campaign.entry.model.statics)
        try:
            recording = build_recording(campaign, run, body_for_robot(campaign, run))
            fault = fault_of(robot, poses.inputs(kernel), recording)
        except RobcalError:
            fault = ""  # what else is wrong comes to light once the angles are within the ranges
    raise InvalidInput(poses.outside + (f"; a likely cause: {fault}" if fault else ""))


def require_robot(campaign: Campaign) -> tuple[RobotModel, Poses]:
    """The robot and its poses.

    Raises
    ------
    InvalidInput : the campaign has none.
    """
    if campaign.robot is None or campaign.poses is None:
        raise InvalidInput(f"{campaign.path}: no robot or no poses: add 'robot' and 'poses'")
    return campaign.robot, campaign.poses


def _result(found: IdentifiedRobot, rows: Rows) -> dict[str, Any]:
    return {
        "poses": len(rows),
        "parameters": len(found.names),
        "iterations": found.iterations,
        "condition": found.condition,
        "sigma0": found.sigma0,
        "seconds": found.seconds,
        "redundancy": found.redundancy,
        "p_value": found.p_value,
        "eliminated": {
            name: {"reason": e.reason, "tied_to": [n for n, share in e.tied_to.items() if abs(share) > 0.05]}
            for name, e in found.eliminated.items()
        },
        "outliers": len(found.outliers),
        "deficiency": found.deficiency or None,
        "correlated": [list(pair) for pair in found.strong_correlations()[:20]],
    }


def _notes(found: IdentifiedRobot, poses: Poses, rows: Rows) -> list[str]:
    notes = [f"{poses.path}: {found.deficiency}"] if found.deficiency else []
    for i in found.outliers:
        name, error = poses.names[int(rows[i])], found.normalised[i]
        notes.append(f"pose '{name}' contradicts all others and was left out (normalised error {error:.1f})")
    if found.model.is_hexapod:
        notes.append(
            "a Stewart platform: no missing physics is looked for (the causes are those of chains); whether the model "
            f"suffices shows in sigma0 = {found.sigma0:.2f} (p = {found.p_value:.2g})"
        )
    if not found.summary.converged:
        notes.append(f"the identification did not converge: {found.summary.termination}")
    return notes


def instruments_in_force(run: Run) -> IdentifiedInstruments | None:
    """All instruments with what a diagnosis found; None where a campaign has but one of which nothing is known."""
    return run.find(DIAGNOSED_INSTRUMENTS) or run.find(INSTRUMENTS)


def load_calibrated(run: Run, instrument: str | None = None) -> CalibratedRobot:
    """The robot with all that was found out about it: after diagnosis and joint adjustment where there were such.

    In the world and with the tool of an ``instrument``; of several, by default of the one that tells most.

    Raises
    ------
    InvalidInput : the run has no calibrated robot, or no such instrument.
    """
    adjusted = run.find(ADJUSTED)
    robot: CalibratedRobot | None = run.find(CALIBRATED) if adjusted is None else adjusted.robot
    if robot is None:
        robot = run.find(IDENTIFIED)
    identified = run.find(IDENTIFICATION)
    if robot is None and identified is not None:
        robot = identified.robot
    instruments = instruments_in_force(run)
    if instruments is None and instrument is not None:
        raise InvalidInput(f"{run.folder}: the campaign has one instrument: leave --instrument out")
    if robot is not None and instruments is not None:
        name = instrument or instruments.telling
        if name not in instruments.placed:
            raise InvalidInput(
                f"{run.folder}: there is no instrument '{name}'{proposal(name, list(instruments.placed))}"
            )
        placed = instruments.placed[name].robot
        if placed is not None and run.find(CALIBRATED) is None:
            return placed
        beside = robot if run.find(CALIBRATED) is not None else leading_identification(instruments).robot
        return instruments.seen_by(name, beside)
    seen = run.find(HAND_EYE)
    if robot is None and seen is not None:
        robot = seen.robot
    if robot is not None:
        return robot
    raise InvalidInput(f"{run.folder}: holds no calibrated robot: the campaign needs a robot, poses and measurements")


STAGE = Stage(
    name=NAME,
    applies=lambda campaign: campaign.robot is not None and campaign.poses is not None and campaign.measures_robot,
    work=work,
    inputs=lambda campaign: [
        p for p in campaign.files if p.suffix.lower() in {".csv", ".yaml", ".yml", ".urdf", ".xml", ".py"}
    ],
    settings=lambda campaign: [campaign.entry.model_dump(include=SETTINGS), campaign.entry.diagnosis.enabled],
    after=("survey", "measure", "frames"),
    module=__name__,
)
