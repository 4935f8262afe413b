"""Bent lines of sight: the law seen from a place that is not known, and from the origin."""

from dataclasses import replace

import numpy as np
import pytest

from robcal.physics.cause import ObservationData
from robcal.physics.measuring import measuring_causes
from robcal.transforms import frame_from_xyzrpy

AXES = "xyz"


def data(points: np.ndarray) -> ObservationData:
    m = len(points)
    return ObservationData(
        "points",
        np.arange(m),
        np.arange(m) % 5,
        np.tile(np.eye(4), (m, 1, 1)),
        np.zeros((m, 3)),
        points,
        None,
        {"index": np.arange(m, dtype=float)},
    )


def bend_from(points: np.ndarray, viewpoint: np.ndarray, up: np.ndarray) -> np.ndarray:
    ray = points - viewpoint
    distance = np.linalg.norm(ray, axis=1, keepdims=True)
    along = ray / distance
    return 0.5 * distance**2 * (up - along * (along @ up)[:, None])


@pytest.mark.parametrize("axis", range(3))
def test_the_law_covers_every_viewpoint(axis: int) -> None:
    rng = np.random.default_rng(axis)
    points = rng.normal(size=(30, 3)) + np.array([2.0, -1.0, 0.5])
    seen = data(points)
    named = [f for f in measuring_causes(seen, (0, 1, 2, 3, 4), "plate") if f.name == "refraction"]
    general = next(f for f in named if f.direction == AXES[axis] and len(f.parameters) == 4)
    columns = general.observation_shift(seen, {}).reshape(90, 4)
    shifts = np.tile(np.eye(3), (30, 1))
    for viewpoint in (np.array([3.2, -1.4, 0.9]), np.zeros(3)):
        true = bend_from(points, viewpoint, np.eye(3)[axis]).ravel()
        span = np.column_stack([columns, shifts])
        found = np.linalg.lstsq(span, true, rcond=None)[0]
        assert np.allclose(span @ found, true, atol=1e-10)
        assert found[0] == pytest.approx(1.0)


def test_an_instrument_at_the_origin_needs_one_number() -> None:
    points = np.random.default_rng(4).normal(size=(20, 3)) + np.array([0.0, 3.0, 0.0])
    seen = data(points)
    named = [f for f in measuring_causes(seen, (0, 1, 2, 3, 4), "plate") if f.name == "refraction"]
    upright = next(f for f in named if f.direction == "z" and len(f.parameters) == 1)
    assert np.allclose(
        upright.observation_shift(seen, {})[:, :, 0], bend_from(points, np.zeros(3), np.array([0.0, 0.0, 1.0]))
    )


def test_frames_are_displaced_as_the_points_on_them() -> None:
    rng = np.random.default_rng(5)
    T = frame_from_xyzrpy(rng.normal(size=(8, 6)))
    corners = 1e-4 * np.vstack([np.eye(3), -np.eye(3)])
    frames = replace(data(T[:, :3, 3]), kind="frames", world_T_tool=T)
    of_points = data((corners @ np.swapaxes(T[:, :3, :3], 1, 2) + T[:, None, :3, 3]).reshape(-1, 3))
    named = [f for f in measuring_causes(of_points, (0, 1, 2, 3, 4), "plate") if f.name == "refraction"]
    assert len(named) == 7
    for cause in named:
        twist = cause.observation_shift(frames, {})
        assert twist.shape == (8, 6, len(cause.parameters))
        moved = cause.observation_shift(of_points, {}).reshape(8, 6, 3, -1)
        for k in range(8):
            local = np.einsum("ij,pik->pjk", T[k, :3, :3], moved[k])  # as seen in the frame
            turned = np.cross(corners[:, :, None], local, axis=1).sum(axis=0) / (4 * 1e-8)
            assert np.allclose(twist[k, :3], local.mean(axis=0), atol=1e-6)
            assert np.allclose(twist[k, 3:], turned, atol=1e-6)
