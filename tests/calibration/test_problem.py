from pathlib import Path

import numpy as np
import pytest

from robcal.calibration.observations import FrameObservations, Stack
from robcal.calibration.problem import CellEvaluator, Evaluator, State
from robcal.files.robot_file import read_robot
from robcal.robot.kernel import Kernel
from robcal.transforms import frame_from_xyzrpy

ROBOTS = Path(__file__).parents[2] / "configs" / "robots"


@pytest.mark.parametrize("robot", ["ur10", "scara_600", "kr150_class_on_track"])
def test_cell_evaluator_agrees_with_the_kernel_in_base_and_tool(robot: str) -> None:
    rng = np.random.default_rng(4)
    kernel = Kernel(read_robot(ROBOTS / f"{robot}.yaml"))
    n = 7
    poses = kernel.poses(rng.uniform(-0.5, 0.5, (n, kernel.model.n_joints)))
    measured = frame_from_xyzrpy(rng.normal(size=(n, 6)))
    observations = FrameObservations(np.arange(n), measured, np.broadcast_to(1e-8 * np.eye(6), (n, 6, 6)))
    whole = Evaluator(kernel, poses, Stack([observations], n))
    cell = CellEvaluator(whole)
    ends = frame_from_xyzrpy(rng.normal(size=(2, 6)))
    state = State(cell.theta, ends[0], ends[1])
    expected, found = whole(state), cell(state)
    columns = [*cell.base, *cell.tool]
    np.testing.assert_allclose(found.T, expected.T, atol=1e-12)
    np.testing.assert_allclose(found.J[:, :, columns], expected.J[:, :, columns], atol=1e-12)
    np.testing.assert_allclose(found.r, expected.r, atol=1e-12)
