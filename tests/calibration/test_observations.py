"""Residuals and derivatives of every operator against differences."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from robcal import transforms as tf
from robcal.calibration.observations import (
    DistanceObservations,
    FrameObservations,
    PixelObservations,
    PointObservations,
    SensorPointObservations,
    Stack,
    basis_points,
)
from robcal.errors import InvalidInput
from robcal.photogrammetry.core.camera import Camera


def _operators(rng: np.random.Generator, T: np.ndarray) -> list:
    n = len(T)
    pose = np.repeat(np.arange(n), 2)
    eye3 = np.broadcast_to(1e-8 * np.eye(3), (2 * n, 3, 3))
    p = rng.normal(0, 0.2, (2 * n, 3))
    world = tf.transform(T[pose], p) + rng.normal(0, 1e-3, (2 * n, 3))
    camera = Camera.from_size(2000, 1500)
    c_T_w = tf.frame_from_xyzrpy([0.1, 0.2, 8.0, 0.1, 0.2, 0.3])
    return [
        FrameObservations.isotropic(tf.retract(T, rng.normal(0, 1e-2, (n, 6))), 1e-4, 1e-4),
        PointObservations(pose, p, world, eye3, np.tile([1, 2], n)),
        SensorPointObservations(pose, p, world, eye3),
        DistanceObservations(np.arange(n), np.linalg.norm(T[:, :3, 3], axis=1) + 1e-3, np.full(n, 1e-4)),
        PixelObservations(
            pose,
            np.zeros(2 * n, dtype=int),
            p,
            rng.uniform(0, 1500, (2 * n, 2)),
            np.broadcast_to(np.eye(2), (2 * n, 2, 2)),
            (camera,),
            c_T_w[None],
        ),
    ]


@given(seed=st.integers(0, 1000))
@settings(max_examples=8, deadline=None)
def test_derivatives_agree_with_differences(seed: int) -> None:
    rng = np.random.default_rng(seed)
    T = tf.frame_from_xyzrpy(np.concatenate([rng.normal(0, 1, (4, 3)), rng.uniform(-1, 1, (4, 3))], axis=1))
    for operator in _operators(rng, T):
        _, B = operator.evaluate(T)
        for k in range(6):
            d = np.zeros(6)
            d[k] = 1e-6
            up, down = (operator.evaluate(tf.retract(T, s * d))[0] for s in (1, -1))
            expected = -(up - down) / 2e-6
            scale = max(1.0, float(np.abs(expected).max()))
            np.testing.assert_allclose(B[..., k], expected, atol=2e-6 * scale, err_msg=type(operator).__name__)


def test_stack_keeps_all_rows_by_pose_and_subset_renumbers() -> None:
    rng = np.random.default_rng(0)
    T = tf.frame_from_xyzrpy(rng.normal(size=(5, 6)))
    operators = _operators(rng, T)
    stack = Stack(operators, 5)
    stacked = stack.evaluate(T)
    assert stack.rows == sum(len(o.pose) * o.dimension for o in operators) == stacked.used.sum()
    total = sum(float(np.sum(o.evaluate(T)[0] ** 2)) for o in operators)
    assert np.sum(stacked.r**2) == pytest.approx(total)
    for operator in operators:
        picked = operator.subset([3, 1])
        assert set(picked.pose.tolist()) <= {0, 1}
        np.testing.assert_array_equal(
            picked.evaluate(T[[3, 1]])[0][picked.pose == 1], operator.evaluate(T)[0][operator.pose == 1]
        )
    r, J = operators[0].linearise(T, rng.normal(size=(5, 6, 3)))
    assert r.shape == (30,)
    assert J.shape == (30, 3)


def test_basis_norm_is_that_of_the_thesis() -> None:
    rng = np.random.default_rng(0)
    T = tf.frame_from_xyzrpy(rng.normal(size=(3, 6)))
    measured = tf.retract(T, rng.normal(0, 1e-3, (3, 6)))
    points = basis_points(FrameObservations.isotropic(measured, 1e-4, 1e-4))
    r, _ = points.evaluate(T)
    e = np.concatenate([np.eye(3), np.ones((1, 3))])
    expected = np.sum(((measured - T)[:, :3] @ e) ** 2)
    assert np.sum(r**2) == pytest.approx(expected)


def test_bad_rows_are_named() -> None:
    good = np.broadcast_to(np.eye(4), (2, 4, 4)).copy()
    good[1, 0, 3] = np.nan
    with pytest.raises(InvalidInput, match="row 1"):
        FrameObservations.isotropic(good, 1e-4, 1e-4)
    with pytest.raises(InvalidInput, match="positive definite"):
        FrameObservations.isotropic(np.eye(4)[None], 0.0, 1e-4)
    with pytest.raises(InvalidInput, match="sigma"):
        DistanceObservations(np.arange(1), np.ones(1), np.zeros(1))
    with pytest.raises(InvalidInput, match="there are 1 poses"):
        Stack([FrameObservations.isotropic(np.broadcast_to(np.eye(4), (2, 4, 4)), 1e-4, 1e-4)], 1)
    with pytest.raises(InvalidInput, match="nothing"):
        Stack([], 3)
