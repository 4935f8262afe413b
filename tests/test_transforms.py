"""Laws of frames: group axioms, small perturbations, covariance transport; near identity and near half a turn."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from robcal.errors import DegenerateGeometry, InvalidInput
from robcal.transforms import (
    adjoint,
    difference,
    exp_so3,
    fit_frame,
    frame,
    frame_from_xyzrpy,
    gram_schmidt_frame,
    invert,
    log_so3,
    retract,
    rotation_from_rpy,
    rpy_from_rotation,
    skew,
    transform,
    transport_covariance,
    xyzrpy_from_frame,
)

seeds = st.integers(0, 2**32 - 1)
shapes = st.sampled_from([(), (1,), (5,), (2, 3), (0,)])
# sizes of turns: around zero, ordinary, around half a turn
angles = st.one_of(
    st.sampled_from([0.0, 1e-12, 1e-8, 1e-6, 1e-5, 1e-3]),
    st.floats(0.0, 3.0),
    st.sampled_from([np.pi - 1e-3, np.pi - 1e-6, np.pi - 1e-9]),
)


def axis_angle(rng: np.random.Generator, shape: tuple[int, ...], angle: float) -> np.ndarray:
    v = rng.normal(size=(*shape, 3))
    return angle * v / np.linalg.norm(v, axis=-1, keepdims=True)


def some_frames(rng: np.random.Generator, shape: tuple[int, ...], angle: float = 1.0) -> np.ndarray:
    return frame(exp_so3(axis_angle(rng, shape, angle)), rng.normal(size=(*shape, 3)))


@given(seeds, shapes, angles)
@settings(max_examples=80, deadline=None)
def test_exp_is_a_rotation_and_log_undoes_it(seed: int, shape: tuple[int, ...], angle: float) -> None:
    w = axis_angle(np.random.default_rng(seed), shape, angle)
    R = exp_so3(w)
    assert R.shape == (*shape, 3, 3)
    np.testing.assert_allclose(R @ np.swapaxes(R, -1, -2), np.broadcast_to(np.eye(3), R.shape), atol=1e-14)
    np.testing.assert_allclose(np.linalg.det(R), 1.0, atol=1e-13)
    np.testing.assert_allclose(R.reshape(-1, 3, 3), Rotation.from_rotvec(w.reshape(-1, 3)).as_matrix(), atol=1e-13)
    # near half a turn the axis is fine although sin(angle) is not
    np.testing.assert_allclose(log_so3(R), w, atol=1e-9 if angle < 3.1 else 2e-7)


def test_log_at_exactly_half_a_turn() -> None:
    for axis in np.eye(3):
        R = 2.0 * np.outer(axis, axis) - np.eye(3)
        w = log_so3(R)
        np.testing.assert_allclose(np.abs(w), np.pi * axis, atol=1e-12)
        np.testing.assert_allclose(exp_so3(w), R, atol=1e-12)


@given(seeds, shapes, angles)
@settings(max_examples=50, deadline=None)
def test_group_axioms(seed: int, shape: tuple[int, ...], angle: float) -> None:
    rng = np.random.default_rng(seed)
    a, b, c = (some_frames(rng, shape, angle) for _ in range(3))
    unit = np.broadcast_to(np.eye(4), a.shape)
    np.testing.assert_allclose(a @ invert(a), unit, atol=1e-12)
    np.testing.assert_allclose(invert(a @ b), invert(b) @ invert(a), atol=1e-12)
    np.testing.assert_allclose((a @ b) @ c, a @ (b @ c), atol=1e-12)
    p = rng.normal(size=(*shape, 3))
    np.testing.assert_allclose(transform(a, transform(b, p)), transform(a @ b, p), atol=1e-12)
    np.testing.assert_allclose(transform(invert(a), transform(a, p)), p, atol=1e-12)


@given(seeds, shapes, angles)
@settings(max_examples=50, deadline=None)
def test_difference_undoes_retract(seed: int, shape: tuple[int, ...], angle: float) -> None:
    rng = np.random.default_rng(seed)
    T = some_frames(rng, shape, 2.0)
    d = np.concatenate([rng.normal(size=(*shape, 3)), axis_angle(rng, shape, angle)], axis=-1)
    np.testing.assert_allclose(difference(T, retract(T, d)), d, atol=1e-7)
    np.testing.assert_allclose(retract(T, np.zeros(6)), T, atol=1e-14)


@given(seeds)
@settings(max_examples=50, deadline=None)
def test_rpy_round_trip_and_order(seed: int) -> None:
    rng = np.random.default_rng(seed)
    rpy = rng.uniform([-3.1, -1.5, -3.1], [3.1, 1.5, 3.1], (4, 3))
    R = rotation_from_rpy(rpy)
    np.testing.assert_allclose(R, Rotation.from_euler("xyz", rpy).as_matrix(), atol=1e-13)
    np.testing.assert_allclose(rpy_from_rotation(R), rpy, atol=1e-9)
    six = np.concatenate([rng.normal(size=(4, 3)), rpy], axis=1)
    np.testing.assert_allclose(xyzrpy_from_frame(frame_from_xyzrpy(six)), six, atol=1e-9)


@pytest.mark.parametrize("pitch", [np.pi / 2, -np.pi / 2])
def test_rpy_at_the_lock_gives_the_same_rotation(pitch: float) -> None:
    R = rotation_from_rpy([0.4, pitch, -1.1])
    rpy = rpy_from_rotation(R)
    assert rpy[0] == 0.0
    np.testing.assert_allclose(rotation_from_rpy(rpy), R, atol=1e-9)


@given(seeds)
@settings(max_examples=30, deadline=None)
def test_adjoint_moves_small_perturbations(seed: int) -> None:
    rng = np.random.default_rng(seed)
    T = some_frames(rng, (), 2.0)
    d = 1e-6 * rng.normal(size=6)
    left = retract(np.eye(4), adjoint(T) @ d) @ T
    np.testing.assert_allclose(left, retract(T, d), atol=1e-10)
    a, b = some_frames(rng, (), 1.0), some_frames(rng, (), 2.5)
    np.testing.assert_allclose(adjoint(a @ b), adjoint(a) @ adjoint(b), atol=1e-10)


def test_covariance_transport_against_samples() -> None:
    rng = np.random.default_rng(3)
    T, S = some_frames(rng, (), 1.0), rng.normal(size=(6, 6))
    C = 1e-8 * S @ S.T
    A = adjoint(T)
    d = rng.multivariate_normal(np.zeros(6), C, 20000)
    moved = difference(np.eye(4), retract(T, d) @ invert(T))
    np.testing.assert_allclose(np.cov(moved.T), transport_covariance(A, C), atol=0.06 * np.max(np.diag(A @ C @ A.T)))


@given(seeds, shapes)
@settings(max_examples=30, deadline=None)
def test_skew_is_the_cross_product(seed: int, shape: tuple[int, ...]) -> None:
    rng = np.random.default_rng(seed)
    v, w = rng.normal(size=(2, *shape, 3))
    np.testing.assert_allclose(np.einsum("...ij,...j->...i", skew(v), w), np.cross(v, w), atol=1e-13)


@given(seeds, angles)
@settings(max_examples=40, deadline=None)
def test_fit_frame_recovers_a_frame(seed: int, angle: float) -> None:
    rng = np.random.default_rng(seed)
    T, p = some_frames(rng, (), angle), rng.normal(size=(6, 3))
    np.testing.assert_allclose(fit_frame(transform(T, p), p), T, atol=1e-10)
    flat = p * [1.0, 1.0, 0.0]  # a plane needs the sign of the determinant
    np.testing.assert_allclose(fit_frame(transform(T, flat), flat), T, atol=1e-10)


def test_fit_frame_refuses_lines_and_too_few() -> None:
    line = np.outer(np.arange(5.0), [1.0, 2.0, 3.0])
    with pytest.raises(DegenerateGeometry, match="one line"):
        fit_frame(line, line)
    with pytest.raises(InvalidInput, match="three pairs"):
        fit_frame(line[:2], line[:2])


def test_gram_schmidt_frame_follows_its_definition() -> None:
    rng = np.random.default_rng(5)
    p = rng.normal(size=(4, 3, 3))
    T = gram_schmidt_frame(p)
    local = transform(invert(T)[:, None], p)
    np.testing.assert_allclose(local[:, 0], 0.0, atol=1e-12)
    np.testing.assert_allclose(local[:, 1, 1:], 0.0, atol=1e-12)
    np.testing.assert_allclose(local[:, 2, 2], 0.0, atol=1e-12)
    assert (local[:, 1, 0] > 0).all()
    assert (local[:, 2, 1] > 0).all()
    with pytest.raises(DegenerateGeometry, match="one line"):
        gram_schmidt_frame(np.outer(np.arange(3.0), [1.0, 1.0, 0.0]))
