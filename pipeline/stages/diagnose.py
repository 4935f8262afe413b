"""Stage diagnose: which physics the model leaves out; the extended model serves everything after it."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from pipeline import artifacts
from pipeline.adjusted_images import findings_of
from pipeline.bodies import body_for_robot
from pipeline.campaign import Campaign
from pipeline.instruments_diagnosis import diagnose_several
from pipeline.json_io import write_json
from pipeline.messages import LOG
from pipeline.runs import Run
from pipeline.stages.base import Context, Outcome, Stage, no_files
from pipeline.stages.identify import options_of
from robcal.diagnosis.content import diagnosis_content, with_exchanges, with_images
from robcal.diagnosis.core.result import Diagnosis
from robcal.diagnosis.images.diagnosis import ImageFinding
from robcal.diagnosis.search.selection import SelectionSettings
from robcal.errors import InvalidInput, located
from robcal.files.tables import write_table
from robcal.photogrammetry.station.contradictions import TARGET_SWAPPED
from robcal.recipe.robot_diagnosis import Measured, RobotDiagnosis, diagnose_robot
from robcal.recipe.robot_witness import with_station_moves
from robcal.recipe.verification import kept_out_gain

NAME = "diagnose"


def work(context: Context) -> Outcome:
    """Diagnose the images, then the identified robot; verification poses only measure the gain."""
    campaign, run = context.campaign, context.run
    images = findings_of(campaign, run)
    if campaign.robot is None or campaign.poses is None or campaign.robot.is_hexapod:
        content = with_images(None, images.findings, images.scans, images.noise)
        write_json(run.diagnosis, content)
        reported = [str(finding.statement) for finding in images.findings] or [str(content["statement"])]
        result = {"mismatch": content["mismatch"], "p_value": content["p_value"], "causes": _named(images.findings)}
        return Outcome({"diagnosis": result | {"heldout_px": content["heldout_px"]}}, [run.diagnosis], reported)
    if campaign.instruments:
        return diagnose_several(context, settings_of(campaign))
    station = run.find(artifacts.ORIENTATION)  # None where another system measured
    measured = Measured(body_for_robot(campaign, run), run.find(artifacts.POINTS), station)
    identification = run.load(artifacts.IDENTIFICATION)
    found = diagnose_robot(identification, campaign.poses, measured, images, settings_of(campaign), LOG.info)
    if found is None:
        return Outcome(notes=["nothing to diagnose"])
    diagnosis = found.diagnosis
    content = with_images(diagnosis_content(diagnosis), images.findings, images.scans, images.noise)
    if station is not None and found.recording.own_station:
        content = with_station_moves(content, station.names, found.recording, diagnosis.model)
    options = options_of(campaign, identification.recording.stated)
    try:
        before, delivered = kept_out_gain(campaign.robot, identification, found, campaign.poses, options)
    except InvalidInput as error:
        raise located(error, str(campaign.poses.path)) from None
    gain = {"before": 1e3 * before, "after": 1e3 * delivered.delivered.tools["0"].rms}
    content = content | _in_force(found) | {"heldout_mm": {**_table(content["heldout_mm"]), **gain}}
    exchanges = measured.points.exchanges if measured.points is not None else ()
    content = with_exchanges(content, exchanges, campaign.poses.names)
    write_json(run.diagnosis, content)
    outputs = [run.diagnosis, run.save(artifacts.CALIBRATED, found.robot), run.save(artifacts.EVIDENCE, found.evidence)]
    outputs.append(run.save(artifacts.DELIVERED, delivered))
    if content.get("next_poses"):
        write_table(run.next_poses, _columns(content["next_poses"]))
        outputs.append(run.next_poses)
    outputs += _optional(run, found)
    reported = [f.statement for f in images.findings] + [f.full_statement for f in diagnosis.findings]
    reported = [
        f"targets {x.targets[0]} and {x.targets[1]} exchanged in {len(x.poses)} pose(s)" for x in exchanges
    ] + reported
    notes = reported or ["nothing missing: the model explains the data"]
    if diagnosis.findings:
        notes = [*notes, found.in_force.reason]
    outcome = _result(diagnosis) | {key: content[key] for key in ("mismatch", "p_value", "heldout_mm")}
    outcome |= _in_force(found)
    swapped = [{"cause": TARGET_SWAPPED.name, "where": str(x.targets[0]), "direction": None} for x in exchanges]
    outcome["causes"] = [*swapped, *_named(images.findings), *_result(diagnosis)["causes"]]
    return Outcome({"diagnosis": outcome}, outputs, notes)


def _optional(run: Run, found: RobotDiagnosis) -> list[Path]:
    """What only some diagnoses leave behind."""
    outputs = []
    if found.relative is not None:
        outputs.append(run.save(artifacts.RELATIVE_COVARIANCE, found.relative))
    if found.corrected is not None:
        outputs.append(run.save(artifacts.CORRECTED, found.corrected))
    if found.placed is not None:
        outputs.append(run.save(artifacts.PLACED, found.placed))
    return outputs


def _in_force(found: RobotDiagnosis) -> dict[str, Any]:
    """Whether what was found is in the robot that is delivered, and the errors over folds that decided it."""
    if not found.diagnosis.findings:
        return {"in_force": False, "in_force_reason": found.in_force.reason}
    decided = found.in_force
    return {
        "in_force": decided.diagnosed,
        "in_force_reason": decided.reason,
        "delivered_mm": {"identified": 1e3 * decided.identified, "diagnosed": 1e3 * decided.diagnosed_error},
    }


def _table(content: object) -> dict[str, Any]:
    return dict(content) if isinstance(content, dict) else {}


def settings_of(campaign: Campaign) -> SelectionSettings:
    """Settings of the diagnosis from campaign.yaml."""
    return dataclasses.replace(SelectionSettings(), level=campaign.entry.diagnosis.level)


def _columns(rows: Any) -> dict[str, list[object]]:
    names: dict[str, None] = {}
    for row in rows:
        names.update(dict.fromkeys(row))
    return {name: [row.get(name, "") for row in rows] for name in names}


def _named(findings: Sequence[ImageFinding]) -> list[dict[str, Any]]:
    return [{"cause": f.name, "where": f.where, "direction": f.direction} for f in findings]


def _result(diagnosis: Diagnosis) -> dict[str, Any]:
    causes: Sequence[dict[str, Any]] = [
        {"cause": f.cause.name, "where": f.cause.where, "direction": f.cause.direction} for f in diagnosis.findings
    ]
    return {"mismatch": diagnosis.mismatch, "p_value": diagnosis.p_value, "causes": causes}


STAGE = Stage(
    name=NAME,
    applies=lambda campaign: (
        campaign.entry.diagnosis.enabled
        and (campaign.measures_robot or campaign.entry.hand_eye is None)
        and not (campaign.robot is not None and campaign.robot.is_hexapod and campaign.entry.station is None)
    ),
    work=work,
    inputs=no_files,
    settings=lambda campaign: campaign.entry.model_dump(include={"diagnosis", "model"}),
    after=("survey", "orient", "identify"),
    module=__name__,
)
