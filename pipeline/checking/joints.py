"""What is doubtful about a joint log, from its numbers alone."""

import numpy as np

from pipeline.campaign import Campaign
from robcal.robot.hexapod import nominal_frames

Doubts = tuple[list[str], list[str]]
"""Faults that stop a run, and what is doubtful; a sentence each."""

RADIANS, LEAST_MOTION = 6.5, 0.5
"""Joint angles (deg) that never exceed a turn in radians, although some joint moved by more than so many."""
METRES = 10.0
"""Positions (mm) of a sliding joint that never exceed this are probably in metres."""
STILL = 0.01
"""A joint whose angles scatter by less (deg or mm) did not move."""
FEW_POSES = 20
GOOD_POSES = 60
FEWEST_POSES = 4
FEW_KEPT_OUT = 8


def joint_doubts(campaign: Campaign) -> Doubts:
    """Units, joints that stand still, poses that are few, stand twice or lie in one place."""
    poses, robot = campaign.poses, campaign.robot
    if poses is None or robot is None or not poses.q.shape[1]:
        return [], []
    where = str(poses.path)
    faults = [poses.outside] if poses.outside else []
    doubts: list[str] = []
    sliding = np.array([joint.prismatic for joint in robot.joints])
    shown = np.where(sliding, 1e3 * poses.q, np.degrees(poses.q))
    turning, straight = shown[:, ~sliding], shown[:, sliding]
    if (
        turning.size
        and len(poses) > 2
        and np.abs(turning).max() < RADIANS
        and np.ptp(turning, axis=0).max() > LEAST_MOTION
    ):
        doubts.append(
            f"{where}: no joint angle is beyond {np.abs(turning).max():.2f} deg: these look like radians: write "
            "degrees into the columns _deg"
        )
    if straight.size and len(poses) > 2 and 0 < np.abs(straight).max() < METRES:
        doubts.append(
            f"{where}: no sliding joint is beyond {np.abs(straight).max():.3g} mm: these look like metres: write "
            "millimetres into the columns _mm"
        )
    identify = ~poses.verify
    if identify.sum() > 1:
        still = [
            f.name for f, spread in zip(robot.joints, np.ptp(shown[identify], axis=0), strict=True) if spread < STILL
        ]
        if still:
            doubts.append(
                f"{where}: {', '.join(still)} never moved: what it carries cannot be told from the rest: move every "
                "joint over its range"
            )
    doubts += _few(where, int(identify.sum()), int(poses.verify.sum()))
    loaded = {name for name in poses.payload if name is not None}
    doubts += [
        f"{campaign.path}, line {campaign.document.line(('payloads', name))}: payload '{name}' has a mass of 0 kg: "
        "state it"
        for name in sorted(loaded)
        if robot.payloads[name].mass == 0
    ]
    places = np.round(shown, 3)
    again = len(places) - len(np.unique(places, axis=0))
    if again > len(places) // 2:
        doubts.append(f"{where}: {again} of {len(places)} rows repeat the angles of others: they add no new poses")
    reach = nominal_frames(robot, poses.q)[:, :3, 3]
    if len(poses) > 2 and np.ptp(reach, axis=0).max() < 0.05:
        doubts.append(f"{where}: all poses lie within 50 mm: the model will hold there only: spread them")
    return faults, doubts


def _few(where: str, identify: int, verify: int) -> list[str]:
    told = []
    if identify < FEWEST_POSES:
        told.append(f"{where}: {identify} poses to identify from: base and tool alone need {FEWEST_POSES} or more")
    elif identify < FEW_POSES:
        told.append(
            f"{where}: {identify} poses to identify from are few for the parameters of a robot: record {GOOD_POSES} or "
            "more ('pipeline poses' proposes some)"
        )
    if 0 < verify < FEW_KEPT_OUT:
        told.append(f"{where}: {verify} poses are kept out (set = verify): their figure says little: keep out a fifth")
    return told
