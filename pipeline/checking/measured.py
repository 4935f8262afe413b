"""What is doubtful about measurements, and what contradicts the joint log."""

import numpy as np

from pipeline.bodies import body_for_robot
from pipeline.campaign import Campaign
from pipeline.checking.joints import Doubts
from pipeline.checking.similar_robots import robots_that_fit_better
from pipeline.runs import Run
from pipeline.stages.identify import check_joint_limits
from pipeline.stages.observations import build_recording
from robcal.calibration.recording_errors.search import check_joint_log
from robcal.errors import InvalidInput
from robcal.files.frame_tables import NEARLY_LOCKED
from robcal.files.measurement_tables import MeasuredTable
from robcal.files.schemas import proposal
from robcal.robot.hexapod import nominal_frames
from robcal.robot.kernel import Kernel

MOST_NAMED = 5
SAME_TURN = np.radians(2.0)
"""Tools whose orientations differ by less have one orientation."""
WAYS = (0.2, 5.0)
"""Measured ways outside these shares of the nominal flange's are in doubt; a long tool may explain them."""
FEW_ROWS = 2.0
"""Numbers measured for each parameter of the geometry, base and tool, below which there is little to average."""


def measured_doubts(campaign: Campaign) -> Doubts:
    """Units, angles near the singularity, one orientation, few numbers, ids that nothing lists."""
    faults: list[str] = []
    doubts: list[str] = []
    tables = [*campaign.measurements]
    for source in campaign.instruments.values():
        tables += [table for table in source.tables or () if table not in tables]
    for table in tables:
        doubts += _angles(campaign, table)
        doubts += _ways(campaign, table)
        if table.covariance is None and table.kind != "sensor_points":
            doubts.append(
                f"{table.path}: states no uncertainty (sigma_mm): it will be estimated from the residuals, which hides "
                "what the model lacks"
            )
    doubts += _numbers(campaign, tables)
    faults += _unlisted(campaign, tables)
    return faults, doubts


def _angles(campaign: Campaign, table: MeasuredTable) -> list[str]:
    if table.kind != "frames":
        return []
    told = []
    angles = table.angles
    if angles is not None:
        locked = np.abs(np.cos(angles[:, 1])) < NEARLY_LOCKED
        if locked.any():
            rows = ", ".join(str(int(row)) for row in table.rows[locked][:MOST_NAMED])
            told.append(
                f"{table.path}, row {int(table.rows[locked][0])}: {int(locked.sum())} frames have a pitch near 90 deg "
                f"(rows {rows}), where roll and yaw turn about one line: make sure that all digits are given, or give "
                "quaternions"
            )
        if (
            len(table) > 2
            and 0 < np.abs(np.degrees(angles)).max() < 6.5
            and np.ptp(np.degrees(angles), axis=0).max() > 0.5
        ):
            told.append(f"{table.path}: no angle is beyond {np.degrees(np.abs(angles).max()):.2f} deg: radians?")
    R = table.values[:, :3, :3]
    cosine = np.clip((np.einsum("nij,ij->n", R, R[0]) - 1.0) / 2.0, -1.0, 1.0)
    if len(table) > 2 and np.arccos(cosine).max() < SAME_TURN:
        told.append(
            f"{table.path}: all {len(table)} frames have one orientation: the tool and the wrist cannot be told from "
            "the rest: turn the tool from pose to pose, or check the columns of the angles"
        )
    return told


def _ways(campaign: Campaign, table: MeasuredTable) -> list[str]:
    """Measured ways beside those of the nominal flange."""
    if campaign.robot is None or campaign.poses is None or table.kind == "sensor_points" or len(table) < 3:
        return []
    if table.pose.max() >= len(campaign.poses) or not campaign.poses.q.shape[1]:
        return []
    places = nominal_frames(campaign.robot, campaign.poses.q)[table.pose, :3, 3]
    measured = table.values[:, :3, 3] if table.kind == "frames" else table.values.reshape(len(table), -1)
    way, nominal = float(np.std(measured, axis=0).max()), float(np.std(places, axis=0).max())
    if nominal < 1e-3 or WAYS[0] < way / nominal < WAYS[1]:
        return []
    return [
        f"{table.path}: the measured places scatter by {1e3 * way:.3g} mm, the nominal flange at these poses by "
        f"{1e3 * nominal:.3g} mm: check the units (mm, deg) and that both are of the same recording"
    ]


def _numbers(campaign: Campaign, tables: list[MeasuredTable]) -> list[str]:
    robot, poses = campaign.robot, campaign.poses
    if robot is None or poses is None or not tables:
        return []
    kept = np.zeros(max(int(table.pose.max()) for table in tables) + 1, dtype=bool)
    kept[: len(poses)] = poses.verify[: len(kept)]
    numbers = sum(
        (6 if t.kind == "frames" else 1 if t.kind == "distances" else 3) * int((~kept[t.pose]).sum()) for t in tables
    )
    parameters = 4 * len(robot.joints) + 12
    if numbers >= FEW_ROWS * parameters:
        return []
    return [
        f"{poses.path}: {numbers} measured numbers for about {parameters} unknowns of geometry, base and tool: measure "
        "more poses, or more in each"
    ]


def _unlisted(campaign: Campaign, tables: list[MeasuredTable]) -> list[str]:
    """Targets that no body lists, where a survey may add some; both lists."""
    listed = {t.id for body in campaign.bodies.values() for t in body.file.targets if t.id is not None}
    told = []
    for table in tables:
        if table.kind not in ("points", "sensor_points") or not listed:
            continue
        measured = {int(i) for i in np.unique(table.target)}
        if not measured & listed:
            word = str(min(measured))
            told.append(
                f"{table.path}: none of its targets ({_some(measured)}) is in a body of the campaign ({_some(listed)})"
                f"{proposal(word, [str(i) for i in sorted(listed)])}: correct the ids, or list them in the body file"
            )
    return told


def _some(ids: set[int]) -> str:
    named = sorted(ids)
    return ", ".join(map(str, named[:12])) + (f", ... ({len(named)})" if len(named) > 12 else "")


def recording_faults(campaign: Campaign) -> Doubts:
    """Whether joint log, robot file and measurements belong together, as the identification will ask."""
    robot, poses = campaign.robot, campaign.poses
    nowhere = Run(campaign.path / "none")  # nothing has run yet
    if robot is None or poses is None or not campaign.measurements or campaign.instruments:
        check_joint_limits(campaign, nowhere)
        return [], []
    body = body_for_robot(campaign, nowhere)
    located = body is not None and bool(np.isfinite(body.points).all())
    if not located and any(table.kind in ("points", "sensor_points") for table in campaign.measurements):
        check_joint_limits(campaign, nowhere)
        return [], []  # their frames follow from the points themselves, in the run
    kernel = Kernel(robot, campaign.entry.model.statics)
    recording, inputs = build_recording(campaign, nowhere, body), poses.inputs(kernel)
    file = campaign.entry.robot.file if campaign.entry.robot else "robot"
    other = robots_that_fit_better(robot, inputs, recording, file)
    try:
        check_joint_limits(campaign, nowhere)
        slips = check_joint_log(robot, inputs, recording, kernel)
    except InvalidInput as error:
        return list(error.faults), other
    return [], (other if not slips else []) + [f"{poses.path}: {slip.statement}: {slip.remedy}" for slip in slips]
