"""Stage diagnose: which physics the model leaves out; the extended model serves everything after it."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np

from pipeline.bodies import body_for_robot
from pipeline.calibrated import Calibrated, with_folded_cell
from pipeline.campaign import Campaign
from pipeline.common_errors import common_errors
from pipeline.image_findings import images_of
from pipeline.moved_cameras import with_station_moves
from pipeline.poses_table import Poses
from pipeline.runs import Run, write_json
from pipeline.stages.base import Context, Outcome, Stage, no_files
from pipeline.stages.corrections import corrected
from pipeline.stages.evidence import evidence_of
from pipeline.stages.identify import load_identification, require_robot
from pipeline.stages.observations import RobotRecording, Rows
from pipeline.tables import write_table
from robcal.calibration.identifiability import weak_parameters
from robcal.calibration.identification import IdentifiedRobot
from robcal.calibration.observations import FrameObservations
from robcal.diagnosis.content import diagnosis_content, with_images
from robcal.diagnosis.core.fitting import Accepted, Fit, fit
from robcal.diagnosis.core.recording import Recording
from robcal.diagnosis.core.result import Diagnosis
from robcal.diagnosis.diagnose import diagnose
from robcal.diagnosis.images.diagnosis import ImageFinding
from robcal.diagnosis.search.selection import SelectionSettings
from robcal.photogrammetry.core.bodies import Body
from robcal.photogrammetry.measure.measured_points import MeasuredPoints
from robcal.photogrammetry.station.network import StationOrientation
from robcal.physics.cause import ObservationCause
from robcal.physics.prior_scale import DEVIATION
from robcal.transforms import Array

NAME = "diagnose"
BEYOND_DOUBT = 1e-6


def recording_for_diagnosis(
    poses: Poses,
    recording: RobotRecording,
    rows: Rows,
    body: Body | None,
    points: MeasuredPoints | None = None,
    orientation: StationOrientation | None = None,
) -> Recording | None:
    """The measurements of some poses in the form the diagnosis takes: the kind with the most of them."""
    chosen = recording.select(rows, detailed=True)
    if not chosen:
        return None
    covariates = {name: np.asarray(values)[rows] for name, values in poses.covariates.items()}
    covariates.update({f"approach{k + 1}": poses.approach[rows, k] for k in range(poses.q.shape[1])})
    covariates["index"] = rows.astype(float)
    observations = max(chosen, key=lambda o: len(o.pose) * o.dimension)
    return Recording(
        q=poses.q[rows],
        payload=tuple(poses.payload[i] for i in rows),
        covariates=covariates,
        names=tuple(poses.names[i] for i in rows),
        observations=observations,
        body=body.name if body is not None else "body",
        ids=tuple(int(i) for i in body.ids) if body is not None else (),
        common=common_errors(observations, recording, rows, body, points, orientation),
        own_station=orientation is not None and isinstance(observations, FrameObservations),
    )


def work(context: Context) -> Outcome:
    """Diagnose the images, then the identified robot; verification poses only measure the gain."""
    campaign, run = context.campaign, context.run
    images = images_of(campaign, run)
    if campaign.robot is None or campaign.poses is None:
        content = with_images(None, images.findings, images.scans, images.noise)
        write_json(run.diagnosis, content)
        reported = [str(finding.statement) for finding in images.findings] or [str(content["statement"])]
        result = {"mismatch": content["mismatch"], "p_value": content["p_value"], "causes": _named(images.findings)}
        return Outcome({"diagnosis": result | {"heldout_px": content["heldout_px"]}}, [run.diagnosis], reported)
    _, poses = require_robot(campaign)
    identification = load_identification(run)
    points: MeasuredPoints | None = run.load("points") if run.has("points") else None
    orientation = _own_station(run)
    found, measured = identification.robot(), identification.recording
    body = body_for_robot(campaign, run)
    # all of them: what a few poses have against the others may be a blunder, or an effect of one place in the workspace
    recording = recording_for_diagnosis(poses, measured, identification.rows, body, points, orientation)
    kept_out = np.array([i for i in measured.poses if poses.verify[i]], dtype=np.int64)
    verify = recording_for_diagnosis(poses, measured, kept_out, body, points, orientation) if len(kept_out) else None
    if recording is None:
        return Outcome(notes=["nothing to diagnose"])
    free, tied = found.names, (*found.eliminated, *own_elasticities(found))
    if recording.own_station:
        # reported apart from the errors of the station, the frames show elasticities that were lost in them
        free, tied = (*found.names, *own_elasticities(found)), tuple(found.eliminated)
    diagnosis = diagnose(
        found.model,
        recording,
        free,
        tied,
        verify,
        settings_beside(settings_of(campaign), [f for f in images.findings if f not in images.taken_back]),
        context.messages.info,
        optional_parameters(found),
    )
    outputs = [run.diagnosis]
    content = with_images(diagnosis_content(diagnosis), images.findings, images.scans, images.noise)
    if recording.own_station and orientation is not None:
        content = with_station_moves(content, orientation.names, recording, diagnosis.model)
    write_json(run.diagnosis, content)
    table = content.get("next_poses")
    if table:
        write_table(run.next_poses, _columns(table))
        outputs.append(run.next_poses)
    calibrated: Calibrated = run.load("calibrated_identify")
    calibrated = dataclasses.replace(calibrated, joint_sigma=diagnosis.joint_sigma)
    final = _final(diagnosis, recording)
    shared = None if orientation is None else final.common
    if shared is not None:
        # beside frames that are freed of the station's errors, the robot is as uncertain as if there were none
        outputs.append(run.save("relative", _relative_covariance(diagnosis, recording) * final.variance_factor))
    if diagnosis.findings or shared is not None:
        # a robot that was fitted beside the errors of its station is better even where nothing is missing
        calibrated = dataclasses.replace(
            calibrated,
            model=with_folded_cell(diagnosis.model),
            names=diagnosis.free,
            covariance=diagnosis.covariance,
            statics="converged",  # as the diagnosis fits
            diagnosed=True,
        )
    outputs.append(run.save(f"calibrated_{NAME}", calibrated))
    whole = recording_for_diagnosis(poses, measured, measured.poses, body, points, orientation)
    of_station = None if shared is None or whole is None or whole.common is None else whole.common @ shared
    without = corrected(measured, poses, diagnosis, of_station)
    if without is not None:
        outputs.append(run.save("corrected", without))
    outputs.append(run.save("evidence", evidence_of(found.model, recording, free, verify, diagnosis)))
    reported = [f.statement for f in images.findings] + [f.statement for f in diagnosis.findings]
    notes = reported or ["nothing missing: the model explains the data"]
    outcome = _result(diagnosis) | {"mismatch": content["mismatch"]}
    outcome["causes"] = [*_named(images.findings), *_result(diagnosis)["causes"]]
    return Outcome({"diagnosis": outcome}, outputs, notes)


def own_elasticities(found: IdentifiedRobot) -> tuple[str, ...]:
    """Elasticities about joints' own axes that the identification left out for want of evidence.

    They belong to the standard model, so they are no missing physics; the diagnosis frees them with the first cause.
    """
    if found.options.parameters != "standard":
        return ()
    own = {f"{joint.name}.elastic_{joint.joint_kind}" for joint in found.model.joints if not joint.prismatic}
    return tuple(name for name in found.rejected_elasticities if name in own)


def optional_parameters(found: IdentifiedRobot) -> tuple[str, ...]:
    """What the identification of a standard model took only because the residuals asked for it.

    Elasticities across joints' axes, and geometry that is less certain than anybody would doubt it anyway: that one was
    opened for what nothing plausible explained.
    """
    if found.options.parameters != "standard":
        return ()
    own = {f"{joint.name}.elastic_{joint.joint_kind}" for joint in found.model.joints if not joint.prismatic}
    cross = tuple(name for name in found.names if ".elastic_" in name and name not in own)
    frames = {frame.name for frame in found.model.frames}
    free = [name.rsplit(".", 1)[0] in frames and ".elastic_" not in name for name in found.names]
    limits = np.where(free, DEVIATION, np.inf)
    return (*cross, *weak_parameters(found.names, found.covariance, limits))


def settings_beside(settings: SelectionSettings, findings: Sequence[ImageFinding]) -> SelectionSettings:
    """Settings beside causes in images that displace what is measured and are not taken back.

    What they leave in the frames looks like small causes of the robot; only what is far beyond doubt is reported.
    """
    if any(finding.kind.displaces_marks for finding in findings):
        return dataclasses.replace(settings, level=min(settings.level, BEYOND_DOUBT))
    return settings


def settings_of(campaign: Campaign) -> SelectionSettings:
    """Settings of the diagnosis from campaign.yaml."""
    return dataclasses.replace(SelectionSettings(), level=campaign.entry.diagnosis.level)


def _own_station(run: Run) -> StationOrientation | None:
    """The station whose frames are diagnosed; None where another system measured."""
    if run.record("orient") is None or not run.has("orient"):
        return None
    found: StationOrientation = run.load("orient")
    return found


def _relative_covariance(diagnosis: Diagnosis, recording: Recording) -> Array:
    """Covariance (p, p) of the free parameters where errors common to all poses are known, variance factor one."""
    known = _final(diagnosis, dataclasses.replace(recording, common=None), iterations=0)
    return known.covariance[: len(diagnosis.free), : len(diagnosis.free)]


def _final(diagnosis: Diagnosis, recording: Recording, iterations: int = 8) -> Fit:
    """The extended model at the recording: its terms are in the model, observation causes beside it."""
    direct = [
        Accepted(f.cause, f.constants, f.values, f.covariance)
        for f in diagnosis.findings
        if isinstance(f.cause, ObservationCause)
    ]
    clean = recording.subset(~np.isin(np.array(recording.names), diagnosis.blunders))
    return fit(diagnosis.model, clean, diagnosis.free, direct, iterations=iterations)


def _columns(rows: Any) -> dict[str, list[object]]:
    names: dict[str, None] = {}
    for row in rows:
        names.update(dict.fromkeys(row))
    return {name: [row.get(name, "") for row in rows] for name in names}


def _named(findings: Sequence[ImageFinding]) -> list[dict[str, Any]]:
    return [{"cause": f.name, "where": f.where, "direction": f.direction} for f in findings]


def _result(diagnosis: Diagnosis) -> dict[str, Any]:
    before, after, floor = (v * 1000 for v in diagnosis.heldout)
    causes: Sequence[dict[str, Any]] = [
        {"cause": f.cause.name, "where": f.cause.where, "direction": f.cause.direction} for f in diagnosis.findings
    ]
    return {
        "mismatch": diagnosis.mismatch,
        "p_value": diagnosis.p_value,
        "causes": causes,
        "heldout_mm": {"before": before, "after": after, "noise_floor": floor},
    }


STAGE = Stage(
    name=NAME,
    applies=lambda campaign: campaign.entry.diagnosis.enabled,
    work=work,
    inputs=no_files,
    settings=lambda campaign: campaign.entry.diagnosis.model_dump(),
    after=("survey", "orient", "identify"),
    code=(
        "robcal/calibration",
        "robcal/diagnosis",
        "robcal/physics",
        "robcal/robot",
        "pipeline/calibrated.py",
        "pipeline/common_errors.py",
        "pipeline/image_findings.py",
        "pipeline/moved_cameras.py",
        "pipeline/stages/corrections.py",
        "pipeline/stages/diagnose.py",
        "pipeline/stages/evidence.py",
        "pipeline/stages/observations.py",
    ),
)
