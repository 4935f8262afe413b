"""Images with three identified targets: one of the poses is right, and the other dots show which."""

import numpy as np
import pytest

from robcal.photogrammetry.survey.identification import place_late
from tests.photogrammetry.networks import Truth, make_network


@pytest.fixture
def truth() -> Truth:
    return make_network(np.random.default_rng(8), images=5, targets=30)


def _image(truth: Truth, image: int) -> tuple[np.ndarray, np.ndarray]:
    rows = np.flatnonzero(truth.marks.image == image)
    return truth.marks.target[rows], truth.marks.xy[rows]


def test_the_other_dots_choose_the_pose(truth: Truth) -> None:
    for image in range(5):
        target, xy = _image(truth, image)
        three = np.array([0, len(target) // 2, len(target) - 1])
        T = place_late(truth.camera, truth.points, target[three], xy[three], xy, 12.0)
        assert T is not None
        d = np.linalg.inv(truth.camera_T_body[image]) @ T
        np.testing.assert_allclose(d, np.eye(4), atol=2e-3)


def test_dots_that_no_pose_explains(truth: Truth) -> None:
    target, xy = _image(truth, 0)
    three = np.array([0, len(target) // 2, len(target) - 1])
    others = np.random.default_rng(1).uniform([0, 0], [2400, 1800], xy.shape)
    others[three] = xy[three]
    assert place_late(truth.camera, truth.points, target[three], xy[three], others, 12.0) is None


def test_three_targets_in_a_line_carry_no_pose(truth: Truth) -> None:
    points = np.array(truth.points)
    points[1], points[2] = points[0] + [0.1, 0, 0], points[0] + [0.2, 0, 0]
    xy = np.array([[100.0, 100.0], [200.0, 100.0], [300.0, 100.0]])
    assert place_late(truth.camera, points, np.array([0, 1, 2]), xy, xy, 12.0) is None
