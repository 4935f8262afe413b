"""Capsules of links: distances against brute force, self-collision, obstacles."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from robcal.calibration.collision import (
    Ball,
    Box,
    Capsule,
    HalfSpace,
    link_capsules,
    link_pairs,
    obstacle_clearance,
    place_capsules,
    segment_distance,
    self_clearance,
)
from robcal.errors import InvalidInput
from robcal.transforms import frame_from_xyzrpy
from tests.robot.chains import kr_like

STRETCHED = np.zeros((1, 6))
UPRIGHT = np.array([[0.0, -np.pi / 2, np.pi / 2, 0.0, 0.0, 0.0]])


@given(seed=st.integers(0, 2**20), kind=st.sampled_from(["general", "parallel", "points"]))
@settings(max_examples=60, deadline=None)
def test_segment_distance_is_the_smallest_distance_of_points(seed, kind):
    rng = np.random.default_rng(seed)
    p0, p1, q0, q1 = rng.normal(size=(4, 3))
    if kind == "parallel":
        q1 = q0 + (p1 - p0) * rng.normal()
    if kind == "points":
        q1 = q0
    s = np.linspace(0, 1, 400)[:, None]
    points_p, points_q = p0 + s * (p1 - p0), q0 + s * (q1 - q0)
    brute = np.linalg.norm(points_p[:, None] - points_q[None], axis=-1).min()
    found = segment_distance(p0, p1, q0, q1)
    assert found <= brute + 1e-12
    assert found >= brute - 0.02


def test_default_capsules_follow_the_links():
    model = kr_like()
    capsules = link_capsules(model, 0.1)
    assert capsules[0].frame == "base"
    assert [c.frame for c in capsules[1:4]] == ["axis1", "axis2", "axis3"]
    placed = place_capsules(model, STRETCHED, capsules)
    assert placed.end[0, 0] == pytest.approx(placed.start[0, 1])
    assert placed.start[0, 2] == pytest.approx([0.35, 0, 0.75])


def test_floor_ball_and_box():
    model = kr_like()
    placed = place_capsules(model, np.vstack([STRETCHED, UPRIGHT]), link_capsules(model, 0.1))
    floor = obstacle_clearance(placed, [HalfSpace((0, 0, 1), 0.0)])
    assert floor[0] == pytest.approx(0.75 - 0.05 - 0.1, abs=0.02)
    ball = obstacle_clearance(placed, [Ball((1.0, 0.0, 0.4), 0.2)])
    assert ball[0] == pytest.approx(0.35 - 0.3, abs=1e-9)
    assert ball[1] > ball[0]
    box = Box(frame_from_xyzrpy([1.0, 0, 0.75, 0, 0, 0.3]), (0.2, 0.2, 0.2))
    boxed = obstacle_clearance(placed, [box])
    assert boxed[0] < 0 < boxed[1]
    post = obstacle_clearance(placed, [Capsule("base", (1.0, 0.5, 0), (1.0, 0.5, 2.0), 0.1)])
    assert post[0] == pytest.approx(0.3, abs=1e-9)
    assert np.all(np.isinf(obstacle_clearance(placed, [])))


def test_folded_arm_collides_with_its_own_column():
    model = kr_like()
    capsules = link_capsules(model, 0.12)
    rng = np.random.default_rng(0)
    pairs = link_pairs(place_capsules(model, rng.uniform(-1.5, 1.5, (300, 6)), capsules))
    folded = np.array([[0.0, 0.6, 2.4, 0.0, 0.0, 0.0]])
    placed = place_capsules(model, np.vstack([UPRIGHT, folded]), capsules)
    clearance = self_clearance(placed, pairs)
    assert clearance[1] < 0 < clearance[0]


def test_what_the_flange_carries_moves_with_the_body():
    model = kr_like()
    tool = Capsule("body", (0, 0, 0), (0, 0, 0.5), 0.05)
    placed = place_capsules(model, STRETCHED, [tool], frame_from_xyzrpy([0, 0, 0.1, 0, 0, 0]))
    # the flange's z is the arm's x
    assert placed.end[0, 0] - placed.start[0, 0] == pytest.approx([0.5, 0, 0], abs=1e-12)


def test_bad_capsules_are_refused():
    model = kr_like()
    with pytest.raises(InvalidInput, match="'elbow'"):
        place_capsules(model, STRETCHED, [Capsule("elbow", (0, 0, 0), (1, 0, 0), 0.1)])
    with pytest.raises(InvalidInput, match="radius"):
        place_capsules(model, STRETCHED, [Capsule("axis1", (0, 0, 0), (1, 0, 0), -0.1)])
    with pytest.raises(InvalidInput, match="radius"):
        link_capsules(model, 0.0)
