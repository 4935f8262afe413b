"""Stage adjust: marks, cameras, body and the robot in force in one adjustment, where the campaign asks for it."""

from typing import Any

import numpy as np

from pipeline.artifacts import ADJUSTED, CORRECTED, IDENTIFICATION, MARKS, ORIENTATION, PLACED
from pipeline.campaign import Campaign
from pipeline.runs import Run
from pipeline.stages.base import Context, Outcome, Stage, no_files
from pipeline.stages.identify import load_calibrated, require_robot
from robcal.errors import RobcalError, located
from robcal.files.camera_file import CameraFile, write_camera
from robcal.files.poses_table import Poses
from robcal.files.robot_file import write_robot
from robcal.joint_adjustment.result import JointAdjustment
from robcal.recipe.joint import adjust_robot

NAME = "adjust"


def work(context: Context) -> Outcome:
    """Adjust jointly; the stages' results are the start, their choices hold."""
    campaign, run = context.campaign, context.run
    robot, poses = require_robot(campaign)
    if run.find(PLACED) is not None or run.find(CORRECTED) is not None:
        told = "the diagnosis found faults of the measuring system, which a joint adjustment does not know of"
        return Outcome(notes=[f"{told}: the robot of the stages is delivered"])
    identification, calibrated = run.load(IDENTIFICATION), load_calibrated(run)
    tolerance = campaign.entry.quality.distance_tolerance_mm
    try:
        adjusted = adjust_robot(
            robot,
            identification,
            calibrated,
            poses,
            run.load(ORIENTATION),
            run.load(MARKS),
            None if tolerance is None else tolerance / 1000,
        )
    except RobcalError as error:
        raise located(error, f"{campaign.path}: joint adjustment") from None
    found = adjusted.adjustment
    write_robot(run.robot, adjusted.robot.model, f"calibrated from campaign {campaign.name}, adjusted jointly")
    outputs = [run.save(ADJUSTED, adjusted), *_write_cameras(campaign, run, found)]
    return Outcome({"adjustment": _section(found, poses)}, outputs, _notes(found, poses))


def _write_cameras(campaign: Campaign, run: Run, found: JointAdjustment) -> list[Any]:
    """Cameras as adjusted with the robot, beside those of the station by itself."""
    paths = []
    for name, camera in zip(found.orientation.names, found.orientation.cameras, strict=True):
        path = run.camera(name).parent / "joint" / f"{name}.yaml"
        content = CameraFile(camera, found.orientation.world_T_camera[name], None, None)
        write_camera(path, content, f"adjusted jointly with the robot in campaign {campaign.name}")
        paths.append(path)
    return paths


def _section(found: JointAdjustment, poses: Poses) -> dict[str, Any]:
    return {
        "kind": "joint",
        "marks": found.marks,
        "poses": found.poses,
        "parameters": len(found.robot.names),
        "sigma0": found.sigma0,
        "joint_scatter_deg": np.degrees(found.joint_sigma).tolist(),
        "noise": dict(found.orientation.noise),
        "loose": [poses.names[i] for i in found.loose],
        "rejected": len(found.rejected),
        "iterations": found.summary.iterations,
        "seconds": found.seconds,
    }


def _notes(found: JointAdjustment, poses: Poses) -> list[str]:
    notes = [
        f"adjusted jointly: {found.marks} marks, cameras, body and {len(found.robot.names)} parameters of the robot; "
        f"joints scatter by {np.degrees(np.max(found.joint_sigma)):.2g} deg"
    ]
    notes += [
        f"pose '{poses.names[i]}' does not stand where its joints say: it orients cameras only" for i in found.loose
    ]
    if not found.summary.converged:
        notes.append(f"the joint adjustment did not converge: {found.summary.termination}")
    return notes


STAGE = Stage(
    name=NAME,
    applies=lambda campaign: (
        campaign.entry.model.adjustment == "joint"
        and campaign.entry.station is not None
        and campaign.robot is not None
        and campaign.poses is not None
    ),
    work=work,
    inputs=no_files,
    settings=lambda campaign: [campaign.name, campaign.entry.model_dump(include={"model", "quality"})],
    after=("orient", "identify", "diagnose"),
    module=__name__,
)
