"""Variance components of simulated scatter."""

import numpy as np
import pytest

from robcal.calibration.identification import identify
from robcal.calibration.noise import estimate_noise
from tests.calibration.scenarios import scenario


def test_factor_alone() -> None:
    s = scenario(0)
    observed = s.frames(s.poses, 8e-5, 1.6e-4)
    stated = type(observed).isotropic(observed.world_T_tool, 5e-5, 1e-4)
    estimate = estimate_noise(identify(s.model, s.poses, [stated], kernel=s.kernel), s.poses, [stated])
    assert estimate.joint_sigma == 0.0
    assert estimate.p_value > 0.01
    assert estimate.factor == pytest.approx(1.6, rel=0.12)


def test_joint_repeatability_is_told_from_measuring_noise() -> None:
    found = []
    for seed in range(3):
        s = scenario(seed)
        observed = s.frames(s.poses.with_q(s.poses.q + 1e-4 * s.rng.normal(size=s.poses.q.shape)))
        estimate = estimate_noise(identify(s.model, s.poses, [observed], kernel=s.kernel), s.poses, [observed])
        assert estimate.p_value < 1e-6
        assert estimate.factor_alone > 2
        found.append((estimate.factor, estimate.joint_sigma))
    assert np.mean(found, axis=0) == pytest.approx([1.0, 1e-4], rel=0.15)
