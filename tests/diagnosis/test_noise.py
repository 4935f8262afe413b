"""Variance components of a recording: the stated covariance's factor, the joints' repeatability, shared errors."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from fixtures.plan import Noise as Measured
from robcal.diagnosis.noise import estimate_noise
from robcal.diagnosis.recording import Recording
from tests.diagnosis.recordings import concealed


def with_shared_errors(recording: Recording, count: int, sigma: float) -> Recording:
    """The recording with `count` errors that all poses share in it, and told to it."""
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
    told = estimate_noise(found.model, shared, found.names)
    untold = estimate_noise(found.model, replace(shared, common=None), found.names)
    assert told.factor == pytest.approx(1.0, abs=0.35)
    assert untold.factor > 2.0 * told.factor


def test_repeatability_of_the_joints_is_told_from_the_factor(tmp_path: Path) -> None:
    noise = Measured(0.06, 0.006, joint_repeatability_rad=60e-6)
    found, identify, _, _ = concealed(tmp_path, seed=12, effects=[], noise=noise)
    estimate = estimate_noise(found.model, identify, found.names)
    assert estimate.joint_sigma == pytest.approx(60e-6, rel=0.3)
    assert estimate.factor == pytest.approx(1.0, abs=0.2)
