"""Stage frames: the distance criterion, then one frame with covariance from the targets of each pose."""

from typing import Any

import numpy as np

from pipeline.artifacts import FRAMES, ORIENTATION, POINTS
from pipeline.bodies import surveyed_or_given
from pipeline.campaign import Campaign
from pipeline.runs import Run
from pipeline.stages.base import Context, Outcome, Stage
from robcal.errors import InvalidInput
from robcal.files.frame_tables import frame_columns, frame_covariance_columns, six_covariance
from robcal.files.poses_table import Poses
from robcal.files.tables import write_table
from robcal.photogrammetry.core.bodies import Body, line_ratio
from robcal.photogrammetry.measure.frames import MeasuredFrames, measure_frames
from robcal.photogrammetry.measure.measured_points import MeasuredPoints
from robcal.photogrammetry.measure.point_faults import length_ratio, mirrored, unit_fault
from robcal.transforms import Array

NAME = "frames"
STRAIGHT = 0.02
"""Second by first extent of a body below which its targets lie in one line."""


def applies(campaign: Campaign) -> bool:
    """Whether points are measured, three or more in some pose."""
    if campaign.entry.station is not None:
        return True
    return any(len(t) and np.bincount(t.pose).max() >= 3 for t in campaign.measured("points"))


def work(context: Context) -> Outcome:
    """Frames of the body that the robot carries."""
    campaign, run = context.campaign, context.run
    if campaign.poses is None:
        raise InvalidInput(f"{campaign.path}: no poses: add 'poses: poses.csv'")
    points = run.load(POINTS)
    body = _body(campaign, run)
    _check_points(campaign, points, body)
    tolerance = campaign.entry.quality.distance_tolerance_mm
    frames = measure_frames(points, body, tolerance=None if tolerance is None else tolerance / 1000)
    write_frames(run, campaign.poses, frames)
    outputs = [run.save(FRAMES, frames), run.frames]
    names = campaign.poses.names
    notes = [*frames.notes, *(f"pose '{names[r.pose]}' rejected: {r.reason}" for r in frames.rejected_poses)]
    if frames.recurring.pairs or frames.recurring.scale_ppm is not None:
        notes.append(f"recurring length deviations, evidence for the diagnosis: {frames.recurring.statement}")
    return Outcome({"points": _result(points, frames)}, outputs, notes)


def _check_points(campaign: Campaign, points: MeasuredPoints, body: Body | None) -> None:
    """Refuse points in a wrong unit, and points that mirror the body.

    Raises
    ------
    InvalidInput : one of both, with the proof.
    """
    if body is None or line_ratio(body.points[body.known]) < STRAIGHT:  # the fit itself says what is wrong with a line
        return
    tables = [t.path for t in campaign.measured("points")]
    where = tables[0] if tables else campaign.path
    rows = (points.pose, points.target, points.p_world, body)
    ratio = length_ratio(*rows)
    if ratio is not None and unit_fault(ratio):
        raise InvalidInput(
            f"{where}: lengths between targets are measured {ratio:.3g} times as long as on body '{body.name}': "
            "coordinates in columns and keys _mm must be in millimetres, check the unit of both files"
        )
    found = mirrored(*rows)
    if found is not None:
        raise InvalidInput(
            f"{where}: the measured points are a mirror image of body '{body.name}' (it misses them by "
            f"{found[0] * 1000:.3g} mm, their mirror image by {found[1] * 1000:.3g} mm): two coordinate columns are "
            "exchanged, one has the wrong sign, or a system is left-handed; correct the points or the body file"
        )


def _body(campaign: Campaign, run: Run) -> Body | None:
    name = campaign.carried_body
    if name is None:
        return None
    orientation = run.find(ORIENTATION)
    return orientation.body if orientation is not None else surveyed_or_given(campaign, run, name)


def write_frames(run: Run, poses: Poses, frames: MeasuredFrames) -> None:
    """frames.csv of the run, with the full covariance of the six numbers."""
    T = frames.world_T_body
    scale = np.array([1000.0] * 3 + [180 / np.pi] * 3)
    numbers = six_covariance(T, frames.covariance) * np.outer(scale, scale)
    columns: dict[str, Any] = {"pose": [poses.names[i] for i in frames.pose], **frame_columns(T)}
    for name, i, j in frame_covariance_columns():
        columns[name] = [f"{v:.9g}" for v in numbers[:, i, j]]
    columns["targets"] = [len(t) for t in frames.targets]
    columns["method"] = list(frames.method)
    write_table(run.frames, columns)


def _result(points: MeasuredPoints, frames: MeasuredFrames) -> dict[str, Any]:
    deviation: Array = np.abs(frames.pairs.deviation) * 1000
    return {
        "measured": len(points.pose),
        "rejected": len(frames.rejected_points),
        "length_deviation_mean_mm": float(deviation.mean()) if len(deviation) else None,
        "length_deviation_max_mm": float(deviation.max()) if len(deviation) else None,
        "frames": len(frames.pose),
        "rejected_poses": len(frames.rejected_poses),
        "noise_factor": frames.noise_factor,
    }


STAGE = Stage(
    name=NAME,
    applies=applies,
    work=work,
    inputs=lambda campaign: [body.file.path for body in campaign.bodies.values()],
    settings=lambda campaign: campaign.entry.model_dump(include={"quality", "body"}),
    after=("survey", "orient", "measure"),
    module=__name__,
)
