"""Frames fitted onto points: exact without noise, covariances that cover the scatter, common parts."""

import numpy as np

from robcal.photogrammetry.core.bodies import Body
from robcal.photogrammetry.measure.frame_fit import FrameFit, fit_frames
from robcal.transforms import Array, difference, retract, transform

POINTS = np.array([[0, 0, 0], [0.3, 0.02, 0.01], [0.05, 0.25, -0.02], [0.2, 0.2, 0.1]])
IDS = np.array([3, 5, 8, 9])


def _frames(rng: np.random.Generator, n: int) -> Array:
    return np.array([retract(np.eye(4), np.concatenate([rng.uniform(-2, 2, 3), rng.normal(size=3)])) for _ in range(n)])


def _columns(T: Array, sigma: float, rng: np.random.Generator) -> tuple[Array, Array, Array, Array]:
    n, t = len(T), len(POINTS)
    p = transform(T[:, None], POINTS) + sigma * rng.normal(size=(n, t, 3))
    covariance = np.tile(max(sigma, 1e-6) ** 2 * np.eye(3), (n * t, 1, 1))
    return np.repeat(np.arange(n) * 10, t), np.tile(np.arange(t), n), p.reshape(-1, 3), covariance


def _offsets(fit: FrameFit, T: Array) -> Array:
    return np.array([difference(a, b) for a, b in zip(T, fit.world_T_body, strict=True)])


def test_exact_points_give_exact_frames() -> None:
    rng = np.random.default_rng(1)
    T = _frames(rng, 5)
    fit = fit_frames(*_columns(T, 0.0, rng), Body("plate", IDS, POINTS))
    assert fit.pose.tolist() == [0, 10, 20, 30, 40]
    assert fit.targets == ((3, 5, 8, 9),) * 5
    assert fit.redundancy.tolist() == [6] * 5
    np.testing.assert_allclose(fit.world_T_body, T, atol=1e-10)
    assert fit.common_covariance.max() == 0.0


def test_covariance_covers_the_scatter() -> None:
    rng = np.random.default_rng(2)
    T = _frames(rng, 400)
    fit = fit_frames(*_columns(T, 2e-4, rng), Body("plate", IDS, POINTS))
    d = _offsets(fit, T)
    nees = np.einsum("ni,nij,nj->n", d, np.linalg.inv(fit.covariance), d)
    assert 5.4 < nees.mean() < 6.6
    assert 5.4 < fit.chi2.mean() < 6.6


def test_common_part_of_the_station_is_the_linear_response() -> None:
    rng = np.random.default_rng(3)
    T = _frames(rng, 2)
    pose, row, p, covariance = _columns(T, 0.0, rng)
    J = rng.normal(size=(len(p), 3, 1))
    body = Body("plate", IDS, POINTS)
    step = 1e-6
    fit = fit_frames(pose, row, p, covariance, body, J, np.array([[step**2]]))
    moved = fit_frames(pose, row, p + step * J[:, :, 0], covariance, body)
    d = _offsets(moved, T)
    np.testing.assert_allclose(fit.common_covariance, d[:, :, None] * d[:, None, :], atol=1e-4 * np.max(d**2))


def test_common_part_of_the_body_is_a_shift_of_all_its_coordinates() -> None:
    rng = np.random.default_rng(4)
    T = _frames(rng, 3)
    # all coordinates move together along x: the frame moves by the same amount against it, in the body's axes
    C = np.kron(np.ones((4, 4)), np.diag([1e-8, 0.0, 0.0]))
    fit = fit_frames(*_columns(T, 0.0, rng), Body("plate", IDS, POINTS, C))
    expected = np.zeros((6, 6))
    expected[0, 0] = 1e-8
    np.testing.assert_allclose(fit.common_covariance, np.tile(expected, (3, 1, 1)), atol=1e-14)


def test_no_points_give_no_frames() -> None:
    none = np.empty(0, dtype=np.int64)
    fit = fit_frames(none, none, np.empty((0, 3)), np.empty((0, 3, 3)), Body("plate", IDS, POINTS))
    assert len(fit.pose) == 0
