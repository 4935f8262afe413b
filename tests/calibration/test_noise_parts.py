"""Measurement noise, scatter of the joints and lack of fit are told apart, and never called by one another's name."""

import numpy as np
import pytest

from robcal.calibration.noise_parts import NoiseParts, noise_parts
from robcal.calibration.observations import DistanceObservations, FrameObservations, PointObservations

SIGMA, LEVER = 5e-5, 1.5


def _parts(
    *, scatter: float = 0.0, lack: float = 0.0, stated: float | None = SIGMA, repeats: int = 3, seed: int = 1
) -> NoiseParts:
    """Sixty places, each driven to `repeats` times, by frames of 50 um a coordinate."""
    rng = np.random.default_rng(seed)
    n = 60 * repeats
    q = np.repeat(rng.uniform(-1, 1, (60, 6)), repeats, axis=0)
    residuals = SIGMA * rng.normal(size=(n, 3)) + scatter * rng.normal(size=(n, 3))
    residuals += np.repeat(lack * rng.normal(size=(60, 3)), repeats, axis=0)
    frames = FrameObservations.isotropic(np.broadcast_to(np.eye(4), (n, 4, 4)), stated or 1e-4, 1e-5)
    return noise_parts(q, residuals, 0, [frames], stated=stated is not None, lever=LEVER)


def test_measurement_alone() -> None:
    found = _parts()
    assert found.source == "stated"
    assert found.measurement == pytest.approx(np.sqrt(3) * SIGMA)
    assert found.repeats == 120
    assert found.lack_of_fit == 0.0
    assert found.joint_scatter is not None
    assert found.joint_scatter * LEVER < 0.5 * SIGMA
    assert found.notes == ()


def test_scatter_of_the_joints_is_in_the_repetitions() -> None:
    found = _parts(scatter=1e-4)
    assert found.joint_scatter == pytest.approx(np.sqrt(3) * 1e-4 / LEVER, rel=0.1)
    assert found.lack_of_fit == 0.0


def test_lack_of_fit_is_beyond_them() -> None:
    found = _parts(lack=2e-4)
    assert found.p_value is not None
    assert found.p_value < 1e-6
    assert found.lack_of_fit > np.sqrt(3) * 2e-4
    assert found.joint_scatter is not None
    assert found.joint_scatter * LEVER < 0.5 * SIGMA


def test_without_repetitions_nothing_is_said_of_the_joints() -> None:
    found = _parts(lack=2e-4, repeats=1)
    assert found.joint_scatter is None
    assert found.p_value is None
    assert found.lack_of_fit == pytest.approx(np.sqrt(3) * 2e-4, rel=0.15)


@pytest.mark.parametrize(("stated", "source", "notes"), [(2 * SIGMA, "stated", 0), (5 * SIGMA, "stated", 1)])
def test_disagreement_is_told(stated: float, source: str, notes: int) -> None:
    found = _parts(stated=stated)
    assert found.source == source
    assert len(found.notes) == notes


def test_a_stated_sigma_ten_times_too_large_is_replaced() -> None:
    found = _parts(stated=20 * SIGMA)
    assert found.source == "repeats"
    assert found.measurement == pytest.approx(np.sqrt(3) * SIGMA, rel=0.1)
    assert any("not believed" in note for note in found.notes)


def test_unstated_noise_comes_from_repetitions_or_is_unknown() -> None:
    assert _parts(stated=None).source == "repeats"
    assert _parts(stated=None, repeats=1).source == "none"


def test_lengths_on_the_body_refute_a_stated_sigma_from_both_sides() -> None:
    rng = np.random.default_rng(2)
    n, on_tool = 80, rng.uniform(-0.2, 0.2, (4, 3))
    pose, target = np.repeat(np.arange(n), 4), np.tile(np.arange(4), n)
    centre = np.repeat(rng.uniform(-1, 1, (n, 3)), 4, axis=0)
    p_world = np.tile(on_tool, (n, 1)) + centre + SIGMA * rng.normal(size=(4 * n, 3))
    for stated in (20 * SIGMA, SIGMA / 20):
        C = np.broadcast_to(stated**2 * np.eye(3), (4 * n, 3, 3))
        points = PointObservations(pose, np.tile(on_tool, (n, 1)), p_world, C, target)
        residuals = p_world - np.tile(on_tool, (n, 1)) - centre
        found = noise_parts(rng.uniform(-1, 1, (n, 6)), residuals, 0, [points], stated=True, lever=LEVER)
        assert found.source == "lengths"
        assert found.measurement == pytest.approx(np.sqrt(3) * SIGMA, rel=0.15)


def test_distances() -> None:
    rng = np.random.default_rng(3)
    o = DistanceObservations(np.arange(50), rng.uniform(1, 2, 50), np.full(50, SIGMA))
    found = noise_parts(rng.uniform(-1, 1, (50, 6)), SIGMA * rng.normal(size=(50, 1)), 6, [o], stated=True, lever=LEVER)
    assert found.measurement == pytest.approx(SIGMA)
    assert found.lack_of_fit < SIGMA


def test_noise_is_no_larger_than_what_is_left() -> None:
    rng = np.random.default_rng(2)
    q, residuals = rng.uniform(-1, 1, (60, 6)), SIGMA * rng.normal(size=(60, 3))
    frames = FrameObservations.isotropic(np.broadcast_to(np.eye(4), (60, 4, 4)), 4 * SIGMA, 1e-5)
    found = noise_parts(q, residuals, 0, [frames], stated=True, lever=LEVER, left=1 / 16)
    assert found.source == "residuals"
    assert found.measurement == pytest.approx(np.sqrt(3) * SIGMA)
    assert found.stated == pytest.approx(np.sqrt(3) * 4 * SIGMA)
