"""Deviations of base and tool become part of the references without moving the tool."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from robcal.calibration.calibrated import CalibratedRobot, with_folded_cell
from robcal.calibration.joint_log import JointLog
from robcal.files.robot_file import read_robot
from robcal.robot.kernel import Kernel
from robcal.transforms import frame_from_xyzrpy

UR10 = Path(__file__).parents[2] / "configs" / "robots" / "ur10.yaml"


def test_folding_the_cell_moves_nothing() -> None:
    rng = np.random.default_rng(2)
    deviations = {
        f"{end}.{k}": float(v)
        for end in ("base", "tool")
        for k, v in zip(("x", "y", "z", "roll", "pitch", "yaw"), rng.normal(0, 1e-2, 6), strict=True)
    }
    ends = frame_from_xyzrpy(rng.normal(size=(2, 6)))
    model = replace(
        read_robot(UR10), parameters={"axis2.x": 1e-3, **deviations}, world_T_base=ends[0], flange_T_tool=ends[1]
    )
    folded = with_folded_cell(model)
    assert set(folded.parameters) == {"axis2.x"}
    before, after = Kernel(model), Kernel(folded)
    q = rng.uniform(-1, 1, (9, 6))
    expected = before.frames(before.theta0, before.poses(q))
    np.testing.assert_allclose(after.frames(after.theta0, after.poses(q)), expected, atol=1e-12)


def test_joint_scatter_is_part_of_what_a_prediction_may_miss() -> None:
    model = replace(read_robot(UR10), world_T_base=np.eye(4), flange_T_tool=np.eye(4))
    q = np.random.default_rng(3).uniform(-1, 1, (4, 6))
    poses = JointLog(("a", "b", "c", "d"), q, (None,) * 4, np.zeros(4, dtype=bool), np.zeros((4, 6)))
    kernel = Kernel(model)
    calibrated = CalibratedRobot(model=model)
    T, without = calibrated.predict(calibrated.inputs(poses))
    _, covariance = replace(calibrated, joint_sigma=1e-4).predict(calibrated.inputs(poses))
    assert not without.any()
    rng = np.random.default_rng(4)
    samples = [kernel.frames(kernel.theta0, kernel.poses(q + 1e-4 * rng.normal(size=q.shape))) for _ in range(4000)]
    moved = np.stack([np.linalg.inv(T) @ S for S in samples])[:, :, :3, 3]
    np.testing.assert_allclose(moved.std(axis=0), np.sqrt(np.diagonal(covariance, axis1=1, axis2=2)[:, :3]), rtol=0.06)
