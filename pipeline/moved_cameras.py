"""Cameras that moved a little: found among all other causes, given an orientation of their own from there on.

The adjustment frees what is beyond doubt. A small move looks like other things (a plate that warms up, glass in front
of a camera), so the diagnosis of the images, which knows them all, decides; the station is oriented again with what it
found. With two cameras only their relative motion shows in images. The robot stood still for it: with the wrong one its
base seems to jump, so the one that leaves the smaller misfit of the robot has moved.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from pipeline.calibrated import recorded_inputs
from pipeline.campaign import Campaign
from pipeline.stages.identify import options_of, require_robot
from pipeline.stages.observations import RobotRecording, frame_observations
from robcal.calibration.identification import identify
from robcal.diagnosis.image_data import ImageData
from robcal.diagnosis.image_diagnosis import diagnose_images
from robcal.diagnosis.next_poses import poses_table, row_of
from robcal.diagnosis.recording import Recording
from robcal.errors import RobcalError
from robcal.photogrammetry.measure_frames import measure_frames
from robcal.photogrammetry.measure_points import measure_points
from robcal.photogrammetry.station_network import (
    Evidence,
    StationMarks,
    StationOrientation,
    StationSettings,
    movement,
)
from robcal.robot.kernel import Kernel
from robcal.robot.model import RobotModel

MOST = 3
BEYOND_DOUBT = 1e4
"""Chi-square of a movement from which nothing else can be meant: a plate that grows reaches some thousands."""
DECIDED = 12.0
"""Difference of the robot's misfits (chi-square) from which the other camera is excluded: odds of 400."""
REPEATED = 5
"""Poses to repeat where only targets at rest can separate causes."""
Orient = Callable[[StationSettings], StationOrientation]


def with_small_moves(
    orient: Orient, data: Callable[[StationOrientation], ImageData]
) -> tuple[StationOrientation, Orient]:
    """The station with an epoch for each camera movement that the diagnosis of the images finds.

    Also returns how to orient it again: moves that the adjustment took for such and the diagnosis, which knows the
    alternatives, for something else are not looked for any more.

    Parameters
    ----------
    orient : orientation with given settings. data : the diagnosis' view of an orientation.
    """
    orientation = orient(StationSettings())
    if len(orientation.names) < 2:
        return orientation, orient
    moved = [e for e in orientation.evidence if e.kind == "camera_moved"]
    if moved and max(e.statistic for e in moved) < BEYOND_DOUBT:
        at_rest = orient(StationSettings(detect_moves=False))
        causes = {f.cause for f in diagnose_images(data(at_rest)).findings}
        if causes and "camera_moved" not in causes:
            return at_rest, lambda settings: orient(replace(settings, detect_moves=False))
    for _ in range(MOST):
        view = data(orientation)
        found = next((f for f in diagnose_images(view).findings if f.cause == "camera_moved"), None)
        if found is None:
            break
        pose = int(orientation.poses[view.image_names.index(str(found.parameters["pose"]))])
        try:
            orientation = _oriented(orient, orientation, _with(epochs_of(orientation), found.where, pose))
        except RobcalError:  # an epoch with too few marks cannot be adjusted
            break
    return orientation, orient


def epochs_of(orientation: StationOrientation) -> dict[str, tuple[int, ...]]:
    """Camera -> poses from which on it stands elsewhere."""
    return {
        name: tuple(int(p) for p in sorted(orientation.exterior_first_pose[orientation.exterior_camera == c])[1:])
        for c, name in enumerate(orientation.names)
    }


def _with(epochs: Mapping[str, tuple[int, ...]], camera: str, pose: int) -> dict[str, tuple[int, ...]]:
    return {name: tuple(sorted({*poses, pose})) if name == camera else poses for name, poses in epochs.items()}


def _oriented(orient: Orient, before: StationOrientation, epochs: Mapping[str, tuple[int, ...]]) -> StationOrientation:
    """The station oriented with known epochs; they are evidence like the ones that the adjustment finds itself."""
    after = orient(StationSettings(epochs={name: poses for name, poses in epochs.items() if poses}))
    told = {(e.where, e.pose) for e in after.evidence if e.kind == "camera_moved"}
    known = [
        moved_evidence(after, name, pose)
        for name, poses in epochs.items()
        for pose in poses
        if (name, pose) not in told
    ]
    return replace(after, evidence=(*known, *after.evidence))


def moved_evidence(orientation: StationOrientation, camera: str, pose: int) -> Evidence:
    """How a camera stands from a pose on against before, from its adjusted exterior orientations."""
    shift, covariance = orientation.movement(camera, pose)
    statistic = float(shift @ np.linalg.pinv(covariance, rcond=1e-9, hermitian=True) @ shift)
    return Evidence("camera_moved", camera, pose, shift, covariance, statistic, 6, movement(camera, pose, shift))


def which_moved(
    orientation: StationOrientation, orient: Orient, campaign: Campaign, marks: Mapping[str, StationMarks]
) -> StationOrientation:
    """Of two cameras the one that really moved, as the robot tells; `Evidence.alone` where it can.

    Each movement is tried on both cameras, one after the other.
    """
    if len(orientation.names) != 2 or campaign.robot is None:
        return orientation
    misfit = robot_misfit(campaign, orientation, marks)
    for item in [e for e in orientation.evidence if e.kind == "camera_moved"]:
        if misfit is None or item.pose is None:
            break
        epochs = epochs_of(orientation)
        other = next(name for name in orientation.names if name != item.where)
        own = tuple(p for p in epochs[item.where] if p != item.pose)
        try:
            second = _oriented(orient, orientation, _with({**epochs, item.where: own}, other, item.pose))
        except RobcalError:
            continue
        rival = None if item.pose in epochs_of(second)[item.where] else robot_misfit(campaign, second, marks)
        if rival is None:  # both of them moved there
            continue
        best = min(misfit, rival)
        alone = abs(rival[0] - misfit[0]) > DECIDED * max(1.0, best[0] / max(best[1], 1))
        better, name = (second, other) if rival < misfit else (orientation, item.where)
        misfit = best
        told = tuple(
            replace(e, alone=e.alone or (alone and (e.where, e.pose) == (name, item.pose))) for e in better.evidence
        )
        orientation = replace(better, evidence=told)
    return orientation


def robot_misfit(
    campaign: Campaign, orientation: StationOrientation, marks: Mapping[str, StationMarks]
) -> tuple[float, int] | None:
    """Whitened sum of squares that the identified robot leaves, and its redundancy; None where it cannot be found."""
    robot, poses = require_robot(campaign)
    kernel = Kernel(robot, campaign.entry.model.statics)
    try:
        frames = measure_frames(points := measure_points(orientation, marks), orientation.body)
        made = frame_observations(points, frames)
        recording = RobotRecording((made,), (made,), True)
        rows = np.array([i for i in recording.poses if not poses.verify[i]], dtype=np.int64)
        inputs = recorded_inputs(kernel, poses).subset(rows)
        found = identify(robot, inputs, recording.select(rows), options_of(campaign, True), kernel)
    except RobcalError:
        return None
    return float(found.sigma0**2 * found.redundancy), int(found.redundancy)


def with_station_moves(
    content: dict[str, Any], cameras: Sequence[str], recording: Recording, model: RobotModel
) -> dict[str, Any]:
    """A base that moved looks like all cameras moved together: said, with poses to repeat beside targets at rest."""
    causes = [dict(cause) for cause in content["causes"]]
    moved = [cause for cause in causes if cause["cause"] == "base_moved"]
    if not moved:
        return content
    where = cameras[0] if len(cameras) == 1 else "station"
    for cause in moved:
        rival = {"cause": "camera_moved", "where": where, "direction": None, "probability": None, "overlap": 1.0}
        cause["indistinguishable_from"] = [*cause["indistinguishable_from"], rival]
    text = (
        "no pose tells a base that moved from cameras that moved together: repeat some with targets at rest "
        "(on the floor, on a wall) in view of the cameras"
    )
    table = content.get("next_poses") or poses_table(_repeated(recording, model), model)
    return {**content, "causes": causes, "notes": [*content.get("notes", []), text], "next_poses": table}


def _repeated(recording: Recording, model: RobotModel) -> tuple[dict[str, float], ...]:
    """Some recorded poses as rows to drive again, spread over the recording."""
    inputs = recording.inputs(Kernel(model))
    chosen = np.unique(np.linspace(0, len(recording.q) - 1, REPEATED).round().astype(int))
    return tuple(row_of(inputs, model, int(i)) for i in chosen)
