"""Terms of ISO 9283 of visits whose errors are known."""

from __future__ import annotations

import numpy as np
import pytest

from robcal.calibration.iso9283 import characteristics

PLACES = np.array([[0.0, 0.0, 0.0], [0.4, 0.0, 0.0], [0.4, 0.3, 0.0]])


def visits(cycles: int, error: np.ndarray, seed: int = 0, sigma: float = 0.0) -> tuple[np.ndarray, ...]:
    labels = np.tile(np.arange(len(PLACES)), cycles)
    commanded = PLACES[labels]
    noise = sigma * np.random.default_rng(seed).normal(size=commanded.shape)
    return labels, commanded, commanded + error[labels] + noise


def test_constant_errors_are_accuracy_alone() -> None:
    error = np.array([[1e-4, 0, 0], [3e-4, 0, 0], [0, 2e-4, 0]])
    found = characteristics(*visits(30, error))
    assert found is not None
    assert (found.poses, found.cycles, found.complete) == (3, 30, True)
    assert found.ap == pytest.approx(3e-4)
    assert found.rp == pytest.approx(0, abs=1e-12)
    attained = np.linalg.norm(PLACES[2] + error[2] - error[0])
    assert found.ad == pytest.approx(attained - 0.5)
    assert found.rd == pytest.approx(0, abs=1e-12)
    assert found.dap == pytest.approx(0, abs=1e-12)
    assert np.isnan(found.vap)


def test_scatter_is_repeatability() -> None:
    found = characteristics(*visits(4000, np.zeros((3, 3)), sigma=1e-4))
    assert found is not None
    # distance of a normal error in space: mean sigma sqrt(8/pi), variance (3 - 8/pi) sigma^2
    expected = 1e-4 * (np.sqrt(8 / np.pi) + 3 * np.sqrt(3 - 8 / np.pi))
    assert found.rp == pytest.approx(expected, rel=0.03)
    assert found.rd == pytest.approx(3 * np.sqrt(2) * 1e-4, rel=0.05)


def test_drift_and_direction_are_told_apart() -> None:
    labels, commanded, attained = visits(30, np.zeros((3, 3)))
    drifting = attained + np.array([1e-5, 0, 0]) * (np.arange(90) // 3)[:, None]
    found = characteristics(labels, commanded, drifting)
    assert found is not None
    assert found.looks == 3
    assert found.dap == pytest.approx(2e-4)  # the means of cycles 1-10 and 21-30
    side = np.arange(90) % 2
    lagging = attained + np.array([0, 0, 5e-5]) * side[:, None]
    found = characteristics(labels, commanded, lagging, [int(s) for s in side])
    assert found is not None
    assert (found.vap, found.directions) == (pytest.approx(5e-5), 2)


def test_without_repetitions_there_is_nothing() -> None:
    assert characteristics([0, 1, 2], PLACES, PLACES) is None
    few = characteristics(*visits(4, np.zeros((3, 3))))
    assert few is not None
    assert not few.complete
    assert np.isnan(few.dap)
