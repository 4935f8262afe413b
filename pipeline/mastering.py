"""Command master: zero offsets of a calibrated robot from a campaign, or the extremum of a notch's signal."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.artifacts import CALIBRATED, MARKS, ORIENTATION
from pipeline.bodies import body_for_robot
from pipeline.campaign import Campaign
from pipeline.campaign_reader import read_campaign
from pipeline.json_io import write_json
from pipeline.runner import run_campaign
from pipeline.runs import Run, StageRecord, open_run
from pipeline.stages.identify import load_calibrated, require_robot
from pipeline.stages.observations import build_recording
from robcal.calibration.calibrated import CalibratedRobot
from robcal.calibration.joint_log import JointLog
from robcal.calibration.measurements import RobotRecording, Rows
from robcal.calibration.observations import FrameObservations, PixelObservations
from robcal.cell.mastering import Mastering, master
from robcal.cell.notch import notch_extremum
from robcal.errors import DegenerateGeometry, InvalidInput, NotIdentifiable, located
from robcal.files.poses_table import Poses, read_poses
from robcal.files.robot_file import write_robot
from robcal.files.tables import read_table
from robcal.robot.model import RobotModel
from robcal.transforms import Array

BEFORE_ROBOT = ("detect", "survey", "orient", "measure", "frames")
"""Stages that make measurements of images and points."""


def master_campaign(
    reference: Path, campaign_path: Path, out: Path, joints: Sequence[str] | None, workers: int | None = None
) -> dict[str, Any]:
    """Write mastering.json and robot_calibrated.yaml.

    Raises
    ------
    InvalidInput : no calibrated robot, or measurements that tell no offset.
    """
    before = open_run(reference)
    robot = load_calibrated(before)
    campaign, run = measured_campaign(campaign_path, out, workers)
    log, recording, free = recording_for(robot, before, campaign, run)
    marks = marks_in_known_cameras(before, run, campaign, log)
    observations = recording.observations if marks is None else (marks,)
    try:
        found = master(robot, log, observations, joints=joints, free=free, stated=recording.stated)
    except (InvalidInput, NotIdentifiable) as error:
        raise located(error, str(campaign.path)) from None
    data = mastering_data(found, robot.model)
    write_json(out / "mastering.json", data)
    keep_calibrated(run, found.robot, f"mastered from campaign {campaign.name}")
    return {**data, "out": str(out), "warnings": _warnings(campaign, found, free)}


def measured_campaign(path: Path, out: Path, workers: int | None = None) -> tuple[Campaign, Run]:
    """A campaign with its measurements, made from images where there are some; the run folder is ``out``."""
    done = run_campaign(path, out, only=BEFORE_ROBOT, workers=workers)
    return read_campaign(path), done.run


def recording_for(
    robot: CalibratedRobot, before: Run, campaign: Campaign, run: Run
) -> tuple[JointLog, RobotRecording, tuple[str, ...]]:
    """Measured poses as the calibrated robot takes them, what was measured, and which of base and tool are others.

    An instrument of the same name as in the calibration (`station`, `measurements`) keeps its world and tool; a
    station's world is that of its cameras in the calibration.
    """
    require_robot(campaign)
    if campaign.poses is None:
        raise InvalidInput(f"{campaign.path}: no poses: add 'poses'")
    poses = read_poses(campaign.poses.path, robot.model, robot.model.payloads)
    recording = build_recording(campaign, run, body_for_robot(campaign, run))
    station = before.find(ORIENTATION)
    own = run.find(ORIENTATION)
    free: tuple[str, ...] = () if (station is None) == (own is None) else ("base", "tool")
    observations = recording.observations
    if station is not None and own is not None:
        move = _to_world_of(station.world_T_camera, own.world_T_camera)
        if move is None:
            free = ("base",)
        else:
            observations = tuple(_moved(o, move) for o in observations)
    rows = np.array([i for i in recording.poses if not poses.verify[i]], dtype=np.int64)
    if not len(rows):
        raise InvalidInput(f"{campaign.path}: no measured pose is left: set 'identify' in the column set")
    moved = RobotRecording(observations, observations, recording.stated, recording.notes)
    return _rows(poses, rows), RobotRecording(moved.select(rows), moved.select(rows), recording.stated), free


def marks_in_known_cameras(before: Run, run: Run, campaign: Campaign, log: JointLog) -> PixelObservations | None:
    """Marks of a station's cameras that the calibration knows already, as they are in the images.

    A few poses do not orient a camera anew, let alone calibrate it: its interior and exterior orientation are those of
    the calibration. None where no camera of that name was there. Weakness: their uncertainty is not carried.
    """
    station, marks = before.find(ORIENTATION), run.find(MARKS)
    if station is None or marks is None or campaign.poses is None:
        return None
    known = [name for name in station.names if name in marks and len(marks[name])]
    row = {name: k for k, name in enumerate(log.names)}
    of_pose = np.array([row.get(name, -1) for name in campaign.poses.names], dtype=np.int64)
    parts = []
    for k, name in enumerate(known):
        own = marks[name]
        at, pose = station.body.index(own.target), of_pose[own.pose]
        good = np.flatnonzero((at >= 0) & (pose >= 0))
        good = good[station.body.known[at[good]]]
        camera = np.full(len(good), k, dtype=np.int64)
        parts.append((pose[good], camera, station.body.points[at[good]], own.xy[good], own.covariance[good]))
    if not parts or not sum(len(p[0]) for p in parts):
        return None
    pose, camera, points, xy, covariance = (np.concatenate([p[j] for p in parts]) for j in range(5))
    cameras = tuple(station.cameras[station.names.index(name)] for name in known)
    placed = np.array([np.linalg.inv(station.world_T_camera[name]) for name in known])
    return PixelObservations(pose, camera, points, xy, covariance, cameras, placed)


def _to_world_of(known: dict[str, Array], own: dict[str, Array]) -> Array | None:
    """Frame that takes the world of a station to that of another with a camera of the same name."""
    for name, world_T_camera in own.items():
        if name in known:
            return np.asarray(known[name] @ np.linalg.inv(world_T_camera), dtype=float)
    return None


def _moved(observations: Any, move: Array) -> Any:
    if not isinstance(observations, FrameObservations):
        return observations
    return FrameObservations(observations.pose, move @ observations.world_T_tool, observations.covariance)


def _rows(poses: Poses, rows: Rows) -> JointLog:
    return JointLog(
        names=tuple(poses.names[i] for i in rows),
        q=poses.q[rows],
        payload=tuple(poses.payload[i] for i in rows),
        verify=poses.verify[rows],
        approach=poses.approach[rows],
        inferred=poses.inferred,
        covariates={name: values[rows] for name, values in poses.covariates.items()},
    )


def mastering_data(found: Mastering, model: RobotModel) -> dict[str, Any]:
    """Content of mastering.json; sliding joints stand in mm."""
    slides = {f.name for f in model.joints if f.prismatic}
    turns = [i for i, name in enumerate(found.joints) if name not in slides]
    deg, sigma = np.degrees(found.offsets), np.degrees(found.sigma)
    data: dict[str, Any] = {
        "format": "robcal/mastering-1",
        "offsets_deg": {found.joints[i]: deg[i] for i in turns},
        "sigma_deg": {found.joints[i]: sigma[i] for i in turns},
        "interval_95_deg": {found.joints[i]: np.degrees(found.wide[i]) for i in turns},
        "covariance_deg2": np.degrees(np.degrees(found.covariance[np.ix_(turns, turns)])),
        "unobservable": [{"axis": axis, "tied_to": tied} for axis, tied in found.unobservable.items()],
        "reversal_deg": {
            k: {"half_width": np.degrees(v), "sigma": np.degrees(s)} for k, (v, s) in found.reversal.items()
        },
        "sigma0": found.sigma0,
        "redundancy": found.redundancy,
        "p_value": found.p_value,
    }
    sliding = [i for i in range(len(found.joints)) if i not in turns]
    if sliding:
        data["offsets_mm"] = {found.joints[i]: 1e3 * found.offsets[i] for i in sliding}
        data["sigma_mm"] = {found.joints[i]: 1e3 * found.sigma[i] for i in sliding}
    return data


def keep_calibrated(run: Run, robot: CalibratedRobot, comment: str) -> None:
    """Make a run folder hold a calibrated robot, for all commands that take one."""
    write_robot(run.robot, robot.model, comment)
    outputs = [run.save(CALIBRATED, robot), run.robot]
    run.write_record(StageRecord(CALIBRATED.stage, comment, run.outputs(outputs), {}))


def master_notch(path: Path) -> dict[str, float]:
    """Extremum of a notch's signal.

    Raises
    ------
    InvalidInput : a bad table. DegenerateGeometry : no notch inside.
    """
    table = read_table(path)
    table.require(["q_deg", "signal"])
    try:
        found = notch_extremum(table.numbers("q_deg"), table.numbers("signal"))
    except DegenerateGeometry as error:
        raise DegenerateGeometry(f"{path}: {error}") from None
    return {"q_deg": found.q, "sigma_deg": found.sigma}


def _warnings(campaign: Campaign, found: Mastering, free: Sequence[str]) -> list[str]:
    reported = []
    if free:
        reported.append(
            f"{campaign.path}: {' and '.join(free)} are not those of the calibration (another instrument) and were "
            "estimated as well"
        )
    for axis, tied in found.unobservable.items():
        reported.append(f"{axis}: cannot be told from {', '.join(tied) or 'these measurements'}")
    if found.p_value < 0.01:
        reported.append(
            f"the residuals are {found.sigma0:.1f} times as large as stated: the noise was estimated from them; is it "
            "the same tool and world as in the calibration?"
        )
    return reported
