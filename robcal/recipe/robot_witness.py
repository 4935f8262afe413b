"""What the robot has to say of cameras that moved."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from robcal.calibration.identification import IdentifyOptions, identify
from robcal.calibration.joint_log import JointLog
from robcal.calibration.measurements import frame_observations
from robcal.diagnosis.core.recording import Recording
from robcal.diagnosis.next_poses import poses_table, row_of
from robcal.errors import RobcalError
from robcal.photogrammetry.measure.frames import measure_frames
from robcal.photogrammetry.measure.points import measure_points
from robcal.photogrammetry.station.contradictions import CAMERA_MOVED
from robcal.photogrammetry.station.network import StationMarks, StationOrientation
from robcal.physics.library import kinds
from robcal.robot.kernel import Kernel
from robcal.robot.model import RobotModel

REPEATED = 5
"""Poses to repeat where only targets at rest can separate causes."""


def robot_misfit(
    model: RobotModel,
    log: JointLog,
    options: IdentifyOptions,
    orientation: StationOrientation,
    marks: Mapping[str, StationMarks],
) -> tuple[float, int] | None:
    """Whitened sum of squares that the identified robot leaves, and its redundancy; None where it cannot be found."""
    kernel = Kernel(model, options.statics)
    try:
        frames = measure_frames(points := measure_points(orientation, marks), orientation.body)
        made = frame_observations(points, frames)
        rows = np.array([i for i in np.unique(made.pose) if not log.verify[i]], dtype=np.int64)
        found = identify(model, log.inputs(kernel).subset(rows), [made.subset(rows)], options, kernel)
    except RobcalError:
        return None
    return float(found.sigma0**2 * found.redundancy), int(found.redundancy)


def with_station_moves(
    content: dict[str, Any], cameras: Sequence[str], recording: Recording, model: RobotModel
) -> dict[str, Any]:
    """A base that moved looks like all cameras moved together: said, with poses to repeat beside targets at rest."""
    causes = [dict(cause) for cause in content["causes"]]
    moved = [cause for cause in causes if kinds()[cause["cause"]].moves == "base"]
    if not moved:
        return content
    where = cameras[0] if len(cameras) == 1 else "station"
    for cause in moved:
        rival = {"cause": CAMERA_MOVED.name, "where": where, "direction": None, "probability": None, "overlap": 1.0}
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
