"""Views that are proposed can be reached, see the board, and tell more than chance would."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from fixtures.hand_eye import board_points, place, scene, turn
from robcal.errors import InvalidInput
from robcal.files.robot_import import read_any_robot
from robcal.handeye.next_poses import ViewRequest, information_of, propose_views
from robcal.handeye.unknowns import Variances
from robcal.photogrammetry.core.bodies import Body
from robcal.photogrammetry.core.camera import Camera, project
from robcal.robot.chain import chain_of, forward
from robcal.transforms import invert, transform
from tests.handeye.test_calibration import data_of

pytestmark = pytest.mark.unit
ROBOT = Path(__file__).parents[2] / "configs" / "robots" / "irb120_like.yaml"


def request(**more: object) -> ViewRequest:
    board = board_points()
    below = place(turn(np.array([np.pi, 0, 0])), np.array([0.3, 0.1, 0.0]))
    X = place(turn(np.array([0.1, -0.1, 0.4])), np.array([0.03, 0.02, 0.05]))
    camera = Camera(1280, 960, 1400.0, 1400.0, 640.0, 480.0)
    body = Body("board", np.arange(len(board)), board)
    asked = ViewRequest(read_any_robot(ROBOT), camera, body, "hand", X, below, count=8, candidates=250)
    return replace(asked, **more)  # type: ignore[arg-type]


def test_poses_see_the_board_and_beat_a_random_choice() -> None:
    asked = request()
    plan = propose_views(asked)
    assert len(plan.q) == 8
    F = forward(chain_of(asked.model), plan.q)
    xy = project(asked.camera, transform((invert(F @ asked.X) @ asked.Z)[:, None], asked.body.points))
    assert np.all(np.mean(np.all((xy > 0) & (xy < [1280, 960]), axis=-1), axis=1) > 0.65)
    few = propose_views(replace(asked, candidates=60, count=60))
    chance = propose_views(replace(asked, candidates=30, count=8, seed=5))
    assert np.prod(plan.sigma[:6]) < np.prod(chance.sigma[:6])
    assert np.prod(few.sigma[:6]) < np.prod(chance.sigma[:6])


def test_what_an_image_tells_agrees_with_the_covariance_that_images_give() -> None:
    seen = scene(np.random.default_rng(1), "world", 10, 0.1, (1e-4, 1e-4))
    data = data_of(seen)
    told = information_of(data, seen.X, seen.Z, Variances(1.0, 1e-4, 1e-4))
    sigma = np.sqrt(np.diag(np.linalg.inv(told.sum(axis=0))))
    assert np.all(sigma[:3] < 5e-4)
    assert np.all(sigma > 1e-6)


def test_a_board_out_of_reach_is_refused() -> None:
    with pytest.raises(InvalidInput, match="can be reached"):
        propose_views(request(Z=place(np.eye(3), np.array([5.0, 0.0, 0.0]))))
