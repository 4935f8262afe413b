"""Motions that a hand-eye calibration cannot do with, and what is said of them."""

from pathlib import Path

import numpy as np
import pytest

from robcal.errors import NotIdentifiable
from robcal.files.robot_import import read_any_robot
from robcal.handeye.motion import check_motion
from robcal.robot.chain import chain_of, forward

ROBOT = Path(__file__).parents[2] / "configs/robots/irb120_like.yaml"


def test_angles_that_may_be_radians_are_doubted() -> None:
    model = read_any_robot(ROBOT, None, None)
    degrees = np.random.default_rng(1).uniform(-60.0, 60.0, (20, 6))
    right, wrong = np.radians(degrees), np.radians(np.radians(degrees))
    check_motion(forward(chain_of(model), right), "hand", model, right)
    with pytest.raises(NotIdentifiable, match="are they in radians"):
        check_motion(forward(chain_of(model), wrong), "hand", model, wrong)


def test_one_joint_that_moves_a_little_is_no_doubt_about_units() -> None:
    model = read_any_robot(ROBOT, None, None)
    q = np.zeros((5, 6))
    q[:, 5] = np.radians([0.0, 0.5, 1.0, 1.5, 2.0])
    with pytest.raises(NotIdentifiable) as told:
        check_motion(forward(chain_of(model), q), "hand", model, q)
    assert "radians" not in str(told.value)
