"""The four subproblems against the conditions that they solve, and the structures that they are used for."""

import numpy as np
import pytest

from robcal.robot.chain import chain_of
from robcal.robot.inverse_analytic import angle_between, to_distance, to_plane, two_turns
from robcal.robot.structure import ParallelArm, SphericalWrist, find_structure, meeting_point, parallel
from robcal.transforms import exp_so3
from tests.robot.chains import random_chain
from tests.robot.test_inverse import random_wrist_arm

RNG = np.random.default_rng(4)


def directions(n: int) -> np.ndarray:
    w = RNG.normal(size=(n, 3))
    return w / np.linalg.norm(w, axis=1, keepdims=True)


def turned(w: np.ndarray, t: np.ndarray, u: np.ndarray) -> np.ndarray:
    """rot(w, t) u for angles (n, k)."""
    return np.einsum("nkij,nj->nki", exp_so3(w[:, None] * t[..., None]), u)


W, W2, U, T = directions(200), directions(200), RNG.normal(size=(200, 3)), RNG.uniform(-3, 3, (200, 1))


def test_angle_between_gives_the_turn_back():
    assert angle_between(W, U, turned(W, T, U)[:, 0]) == pytest.approx(T[:, 0], abs=1e-9)


def test_two_turns_carry_the_point_over():
    v = np.einsum("nij,nj->ni", exp_so3(W * RNG.uniform(-3, 3, (200, 1))), turned(W2, T, U)[:, 0])
    t1, t2 = two_turns(W, W2, U, v)
    for k in range(2):
        middle = turned(W2, t2[:, k : k + 1], U)[:, 0]
        assert turned(W, t1[:, k : k + 1], middle)[:, 0] == pytest.approx(v, abs=1e-6)


def test_distance_and_plane_conditions_hold():
    v = RNG.normal(size=(200, 3))
    there = turned(W, T, U)[:, 0]
    t = to_distance(W, U, v, np.sum((v - there) ** 2, axis=1))
    assert np.sum((v[:, None] - turned(W, t, U)) ** 2, axis=-1) == pytest.approx(
        np.repeat(np.sum((v - there) ** 2, axis=1)[:, None], 2, axis=1), abs=1e-9
    )
    assert np.all(np.min(np.abs(np.sin(0.5 * (t - T))), axis=1) < 1e-6)
    height = np.sum(W2 * there, axis=1)
    t = to_plane(W, U, W2, height)
    assert np.einsum("ni,nki->nk", W2, turned(W, t, U)) == pytest.approx(
        np.repeat(height[:, None], 2, axis=1), abs=1e-9
    )


def test_conditions_out_of_reach_have_no_solution():
    assert np.all(np.isnan(to_distance(W, U, np.zeros((200, 3)), 2.0 * np.sum(U * U, axis=1) + 1.0)))
    assert np.all(np.isnan(to_plane(W, U, W2, np.linalg.norm(U, axis=1) + 1.0)))


@pytest.mark.parametrize("kind", ["parallel_23", "meeting_12", "parallel_12", "parallel_arm"])
def test_structures_are_recognised_and_lost_with_a_deviation(kind):
    structure = find_structure(chain_of(random_wrist_arm(np.random.default_rng(6), kind)))
    if kind == "parallel_arm":
        assert isinstance(structure, ParallelArm)
    else:
        assert isinstance(structure, SphericalWrist)
        assert structure.arm == kind
        assert (structure.shoulder is not None) == (kind == "meeting_12")
    assert find_structure(chain_of(random_chain(np.random.default_rng(6)))) is None


def test_lines_meet_in_their_point():
    point, axes = RNG.normal(size=3), directions(3)
    assert meeting_point(axes, point + RNG.normal(size=(3, 1)) * axes) == pytest.approx(point, abs=1e-9)
    assert meeting_point(axes, point + np.array([[0.0, 0.0, 0.0], [0.1, 0.0, 0.0], [0.0, 0.0, 0.2]])) is None
    assert meeting_point(np.repeat(axes[:1], 3, axis=0), RNG.normal(size=(3, 3))) is None
    assert parallel(axes[0], -axes[0])
    assert not parallel(axes[0], axes[1])
