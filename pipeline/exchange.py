"""Commands exchange and transfer: a new robot in place of a calibrated one."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.campaign import Campaign
from pipeline.mastering import keep_calibrated, marks_in_known_cameras, measured_campaign, recording_for
from pipeline.runs import Run, open_run
from pipeline.stages.identify import load_calibrated, require_robot
from robcal.calibration.calibrated import CalibratedRobot
from robcal.calibration.identifiability import repetitions
from robcal.calibration.joint_log import JointLog
from robcal.calibration.observations import Observations
from robcal.cell.exchange import FEW, exchange, exchange_by_mastering, transfer
from robcal.errors import InvalidInput, NotIdentifiable, located
from robcal.files.poses_table import joint_columns, read_poses
from robcal.files.tables import write_table
from robcal.robot.model import RobotModel


def exchange_robot(reference: Path, campaign_path: Path, out: Path, workers: int | None = None) -> dict[str, Any]:
    """Make a run of the new robot, with which ``transfer`` and all other commands work.

    Raises
    ------
    InvalidInput : another type of robot, or measured in another world. NotIdentifiable : too few measurements.
    """
    before = open_run(reference)
    robot = load_calibrated(before)
    campaign, run = measured_campaign(campaign_path, out, workers)
    nominal, _ = require_robot(campaign)
    log, recording, free = recording_for(robot, before, campaign, run)
    if "base" in free:
        raise InvalidInput(
            f"{campaign.path}: was measured by another instrument than the reference, so in another world: measure "
            "both with the same, or with cameras of the same name that have not been moved"
        )
    if int(repetitions(log.q, 1e-3).max(initial=-1)) + 1 < FEW:
        marks = marks_in_known_cameras(before, run, campaign, log)
        observations = recording.observations if marks is None else (marks,)
        return _from_few(robot, nominal, log, observations, recording.stated, campaign, run, out)
    try:
        found = exchange(robot, nominal, log, recording)
    except (InvalidInput, NotIdentifiable) as error:
        raise located(error, str(campaign.path)) from None
    keep_calibrated(run, found, f"exchanged for {robot.model.name}, from campaign {campaign.name}")
    joints = {f.name: f.zero_name for f in nominal.joints}
    values, sigma = found.values, dict(zip(found.names, found.sigma, strict=True))
    offsets = {axis: float(np.degrees(values[n])) for axis, n in joints.items() if n in values}
    warnings = [
        f"{axis}: its offset is not told from base and tool, which take it up" for axis in joints if axis not in offsets
    ]
    return {
        "out": str(out),
        "poses": len(log),
        "parameters": len(found.names),
        "sigma0": found.sigma0,
        "offsets_deg": offsets,
        "sigma_deg": {axis: float(np.degrees(sigma[joints[axis]])) for axis in offsets},
        "warnings": warnings,
    }


def _from_few(
    robot: CalibratedRobot,
    nominal: RobotModel,
    log: JointLog,
    observations: Sequence[Observations],
    stated: bool,
    campaign: Campaign,
    run: Run,
    out: Path,
) -> dict[str, Any]:
    """A run of the new robot from one to three poses: zero offsets alone."""
    try:
        found = exchange_by_mastering(robot, nominal, log, observations, stated)
    except (InvalidInput, NotIdentifiable) as error:
        raise located(error, str(campaign.path)) from None
    keep_calibrated(run, found.robot, f"exchanged for {robot.model.name}, from campaign {campaign.name}")
    sigma = np.sqrt(np.diag(found.covariance))
    return {
        "out": str(out),
        "poses": len(log),
        "parameters": len(found.joints),
        "sigma0": found.sigma0,
        "offsets_deg": {j: float(np.degrees(v)) for j, v in zip(found.joints, found.offsets, strict=True)},
        "sigma_deg": {j: float(np.degrees(v)) for j, v in zip(found.joints, sigma, strict=True)},
        "warnings": [
            f"{campaign.path}: fewer than {FEW} distinct poses tell zero offsets alone: base and tool are taken from "
            "the reference, lengths from the drawing, which the stated uncertainty holds"
        ],
    }


def transfer_poses(new: Path, reference: Path, poses: Path, out: Path, skip: bool = False) -> dict[str, Any]:
    """Write joint angles for the new robot.

    Raises
    ------
    InvalidInput : a bad table, or a frame that the new robot cannot reach.
    """
    robot, old = load_calibrated(open_run(new)), load_calibrated(open_run(reference))
    if old.model.n_joints != robot.model.n_joints:
        raise InvalidInput(
            f"{new}: its robot has {robot.model.n_joints} joints, that of {reference} {old.model.n_joints}"
        )
    taught = read_poses(poses, old.model, old.model.payloads, to_predict=True)
    found = transfer(robot, old, taught)
    lost = np.flatnonzero(~found.command.reachable)
    if len(lost) and (not skip or len(lost) == len(taught)):
        i = int(lost[0])
        raise InvalidInput(
            f"{poses}, row {int(taught.rows[i])}: the new robot cannot bring its tool where the reference's was in "
            f"pose '{taught.names[i]}' ({len(lost)} such poses): {found.command.reason[i]}: teach it anew, or leave "
            "such poses out with --skip-unreachable"
        )
    rows = np.flatnonzero(found.command.reachable)
    columns: dict[str, list[str]] = {"pose": [taught.names[i] for i in rows]}
    for k, (name, factor) in enumerate(joint_columns(robot.model)):
        columns[name] = [f"{v:.9f}" for v in found.command.q[rows, k] / factor]
    if any(taught.payload):
        columns["payload"] = [taught.payload[i] or "" for i in rows]
    columns["sigma_mm"] = [f"{1e3 * found.sigma[i]:.6g}" for i in rows]
    write_table(out, columns)
    warnings = [taught.outside] if taught.outside else []
    warnings += [f"{poses}: pose '{taught.names[i]}' left out: {found.command.reason[i]}" for i in lost]
    return {
        "poses": len(rows),
        "left_out": [taught.names[i] for i in lost],
        "out": str(out),
        "untransferred_mean_mm": float(1e3 * found.before[rows].mean()),
        "sigma_mean_mm": float(1e3 * found.sigma[rows].mean()),
        "warnings": warnings,
    }
