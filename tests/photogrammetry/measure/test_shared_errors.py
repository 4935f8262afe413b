import numpy as np
import pytest

from robcal import transforms as tf
from robcal.photogrammetry.core.bodies import Body
from robcal.photogrammetry.measure.frames import (
    MeasuredFrames,
    frame_sensitivities,
    measure_frames,
    unabsorbed_covariance,
)
from robcal.photogrammetry.measure.measured_points import MeasuredPoints

POINTS = np.array([[-0.2, -0.2, 0.0], [0.2, -0.2, 0.02], [0.2, 0.2, 0.0], [-0.2, 0.2, 0.03], [0.0, 0.0, 0.1]])
SIGMA = 2e-5


def recording(
    jacobian: str, sigma: float, body_sigma: float = 0.0, seed: int = 0, n: int = 25
) -> tuple[MeasuredPoints, MeasuredFrames]:
    """Exact points of a plate in n poses with a station whose only error is the named one."""
    rng = np.random.default_rng(seed)
    body = Body("plate", np.arange(5), POINTS, np.eye(15) * body_sigma**2 if body_sigma else None)
    T = tf.frame_from_xyzrpy(rng.uniform(-1, 1, (n, 6)) * [1, 1, 0.5, 1, 1, 2] + [0, 0, 2.5, 0, 0, 0])
    p = tf.transform(T[:, None], POINTS).reshape(-1, 3)
    J = {
        "shift": np.broadcast_to(np.eye(3), (5 * n, 3, 3)),
        "turn": -tf.skew(p),
        "scale": p[:, :, None],
        "bend": np.stack([p * 0, p * 0, p[:, :1] ** 2 * [0, 0, 1]], axis=2),
    }[jacobian]
    points = MeasuredPoints(
        np.repeat(np.arange(n), 5),
        np.tile(np.arange(5), n),
        p,
        np.broadcast_to(np.eye(3) * SIGMA**2, (5 * n, 3, 3)),
        np.full(5 * n, 2),
        np.ones(5 * n),
        J,
        np.eye(J.shape[2]) * sigma**2,
    )
    return points, measure_frames(points, body)


@pytest.mark.parametrize("kind", ["shift", "turn"])
def test_what_a_moved_world_does_is_absorbed(kind: str) -> None:
    points, frames = recording(kind, 1e-3)
    rest = unabsorbed_covariance(points, frames)
    assert np.sqrt(np.abs(rest).max()) < 1e-8


def test_sensitivities_against_frames_of_disturbed_points() -> None:
    points, frames = recording("bend", 1e-3)
    by_station, _ = frame_sensitivities(points, frames)
    step = 1e-5
    moved = points.p_world + points.station_jacobian[:, :, 2] * step
    for i in (0, 7, 24):
        rows = points.pose == i
        T = tf.fit_frame(moved[rows], POINTS)
        change = tf.difference(frames.world_T_body[i], T) / step
        np.testing.assert_allclose(by_station[i, :, 2], change, atol=2e-3 * np.abs(change).max())


@pytest.mark.parametrize("kind", ["scale", "bend"])
def test_what_remains_agrees_with_monte_carlo(kind: str) -> None:
    """Draw the station's error, disturb the frames, fit world and body frame, look at what is left."""
    sigma = 1e-4
    points, frames = recording(kind, sigma)
    by_station, _ = frame_sensitivities(points, frames)
    n = len(frames.pose)
    left = tf.adjoint(tf.invert(frames.world_T_body)).reshape(-1, 6)
    design = np.concatenate([left, np.tile(np.eye(6), (n, 1))], axis=1)
    weight = np.linalg.inv(np.linalg.cholesky(frames.covariance))
    white = (weight @ design.reshape(n, 6, 12)).reshape(-1, 12)
    rng = np.random.default_rng(3)
    draws = by_station @ rng.normal(0, sigma, (by_station.shape[2], 4000))
    rows = (weight @ draws).reshape(6 * n, -1)
    rest = rows - white @ np.linalg.lstsq(white, rows, rcond=1e-9)[0]
    rest = np.linalg.solve(weight, rest.reshape(n, 6, -1))
    observed = np.mean(rest[:, :3] ** 2, axis=(1, 2))
    predicted = np.trace(unabsorbed_covariance(points, frames)[:, :3, :3], axis1=1, axis2=2) / 3
    np.testing.assert_allclose(observed, predicted, rtol=0.12)
    assert predicted.max() > 1e-12


def test_body_errors_vanish_when_all_targets_are_always_seen() -> None:
    points, frames = recording("shift", 1e-4, body_sigma=1e-4)
    full = unabsorbed_covariance(points, frames)
    assert np.sqrt(np.abs(full).max()) < 2e-6  # one frame of the body, wrong by the same in every pose
