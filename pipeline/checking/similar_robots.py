"""Robots of configs/ that a campaign may mean, where its own robot file does not fit."""

import re
from collections.abc import Sequence
from pathlib import Path

from pipeline.campaign import Campaign
from pipeline.checking.joints import Doubts
from robcal.calibration.measurements import RobotRecording
from robcal.calibration.recording_errors.recorded import Recorded, as_frames, residual_rms
from robcal.calibration.recording_errors.search import FEWEST_POSES, PROOF, as_robots_do
from robcal.errors import RobcalError
from robcal.files.robot_file import read_robot
from robcal.files.tables import read_table
from robcal.robot.kernel import Kernel, PoseInputs
from robcal.robot.model import RobotModel

FOLDER = Path(__file__).resolve().parents[2] / "configs" / "robots"


def ready_robots() -> dict[Path, RobotModel]:
    """The robots that are ready to copy; none where the project is installed without them."""
    return {path: read_robot(path) for path in sorted(FOLDER.glob("*.yaml"))}


def robots_of_so_many_joints(campaign: Campaign) -> Doubts:
    """Proposals where the robot file is missing, or has another number of joints than the table of poses."""
    use, robot = campaign.entry.poses, campaign.robot
    if use is None or campaign.entry.robot is None or use.table_map() is not None:
        return [], []
    if robot is None and (campaign.path.parent / campaign.entry.robot.file).exists():
        return [], []  # a file with faults, which are told
    try:
        table = read_table(campaign.path.parent / use.file)
    except RobcalError:
        return [], []  # told already
    joints = sum(bool(re.fullmatch(r"q\d+_(deg|mm)", name)) for name in table.columns)
    if joints == 0 or (robot is not None and robot.n_joints == joints):
        return [], []
    known = [path.name for path, model in ready_robots().items() if model.n_joints == joints]
    if not known:
        return [], []
    return [], [
        f"{table.path}: has {joints} joints, as {_listed(known)} in {FOLDER} have: copy one of them if it is yours"
    ]


def robots_that_fit_better(robot: RobotModel, inputs: PoseInputs, recording: RobotRecording, where: str) -> list[str]:
    """A warning where the nominal robot misses the measurements by far, with the ready ones that do not.

    Each robot is fitted by its base and tool alone; the miss is the RMS of what is left, in m.
    """
    if len(inputs) < FEWEST_POSES:
        return []
    frames = as_frames(recording.observations)
    own = Recorded.of(robot, inputs, frames)
    residual = residual_rms(own)
    if residual < as_robots_do(own):
        return []
    found: list[tuple[float, str]] = []
    for path, model in ready_robots().items():
        if [j.prismatic for j in model.joints] != [j.prismatic for j in robot.joints]:
            continue
        other = Recorded.of(model, Kernel(model).poses(inputs.q), frames)
        left = residual_rms(other)
        if left < min(PROOF * residual, as_robots_do(other)):
            found.append((left, path.name))
    residuals = (
        f"{where}: the nominal robot misses the measurements by {1e3 * residual:.3g} mm with the best base and tool"
    )
    if not found:
        return [
            f"{residuals}: more than robots of this size do: is it this robot, with these signs and zeros of its "
            "joints?"
        ]
    told = _listed([f"{name} by {1e3 * left:.3g} mm" for left, name in sorted(found)])
    return [f"{residuals}, {told}: copy it from {FOLDER} if it is yours"]


def _listed(names: Sequence[str]) -> str:
    return names[0] if len(names) == 1 else ", ".join(names[:-1]) + " or " + names[-1]
