"""Variance components of a recording: the stated covariance's factor, the joints' repeatability, shared errors."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from fixtures.plan import Noise as Measured
from robcal.calibration.noise import restricted_components
from robcal.diagnosis.core.recording import Recording
from robcal.diagnosis.noise.components import estimate_noise
from tests.diagnosis.recordings import concealed


def blocks(ratio: float, variance: float, seed: int = 0) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    rng = np.random.default_rng(seed)
    truth = rng.normal(size=5)
    out = []
    for _ in range(300):
        A, X = rng.normal(size=(6, 6)), rng.normal(size=(6, 5))
        r = np.sqrt(variance) * (rng.normal(size=6) + np.sqrt(ratio) * A @ rng.normal(size=6)) + X @ truth
        out.append((A, r, X))
    return out


def test_both_components_are_found_beside_fitted_parameters() -> None:
    found = restricted_components(blocks(0.5, 4.0))
    assert found.variance == pytest.approx(4.0, rel=0.15)
    assert found.ratio == pytest.approx(0.5, rel=0.2)
    assert found.p_value < 1e-20
    assert found.alone > 2 * found.variance


def test_no_scatter_is_not_invented() -> None:
    p_values = [restricted_components(blocks(0.0, 1.0, seed)).p_value for seed in range(20)]
    assert np.sum(np.array(p_values) < 0.05) <= 4
    assert restricted_components(blocks(0.0, 1.0)).alone == pytest.approx(1.0, rel=0.1)


def test_two_columns_that_say_the_same_are_one() -> None:
    double = [(A, r, np.column_stack([X, X[:, :1]])) for A, r, X in blocks(0.5, 1.0)]
    one, two = restricted_components(blocks(0.5, 1.0)), restricted_components(double)
    assert two.ratio == pytest.approx(one.ratio, rel=1e-2)


def with_shared_errors(recording: Recording, count: int, sigma: float) -> Recording:
    """The recording with `count` errors that all poses share in it, and reported to it."""
    rng = np.random.default_rng(8)
    observed = recording.observations
    columns = sigma * rng.normal(size=(len(observed.pose), 3, count)) / np.sqrt(count)
    moved = observed.p_world + columns @ rng.normal(size=count)
    return replace(recording, observations=replace(observed, p_world=moved), common=columns)


@pytest.mark.parametrize("count", [3, 400])
def test_shared_errors_that_are_known_are_no_noise(tmp_path: Path, count: int) -> None:
    found, identify, _, _ = concealed(tmp_path, seed=11, effects=[], noise=Measured(0.06, 0.006), poses=40)
    least = len(identify.observations.pose) * 3 - len(found.names)
    shared = with_shared_errors(identify, min(count, least + 5), 1.5e-4)
    reported = estimate_noise(found.model, shared, found.names)
    untold = estimate_noise(found.model, replace(shared, common=None), found.names)
    assert reported.factor == pytest.approx(1.0, abs=0.35)
    assert untold.factor > 2.0 * reported.factor


def test_repeatability_of_the_joints_is_told_from_the_factor(tmp_path: Path) -> None:
    noise = Measured(0.06, 0.006, joint_repeatability_rad=60e-6)
    found, identify, _, _ = concealed(tmp_path, seed=12, effects=[], noise=noise)
    estimate = estimate_noise(found.model, identify, found.names)
    assert estimate.joint_sigma == pytest.approx(60e-6, rel=0.3)
    assert estimate.factor == pytest.approx(1.0, abs=0.2)
