"""Variance components of a fit: the same estimator as the identification's."""

from __future__ import annotations

import numpy as np
import pytest

from robcal.calibration.noise import restricted_components


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
