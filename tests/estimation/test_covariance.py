"""Statistics of an estimate against the inverse normal matrix and the chi-square distribution."""

import numpy as np
import pytest

from robcal.estimation.covariance import global_test, linear_statistics


def test_cofactor_and_condition() -> None:
    J = np.random.default_rng(1).normal(size=(50, 4)) * [1, 1e3, 1e-3, 1]
    s = linear_statistics(J)
    np.testing.assert_allclose(s.cofactor @ (J.T @ J), np.eye(4), atol=1e-8)
    assert s.condition < 3 < s.condition_raw
    assert np.diag(s.correlations) == pytest.approx(1.0)


def test_global_test_judges_the_variance() -> None:
    sigma0, p = global_test(0.5 * 100.0, 100)
    assert sigma0 == pytest.approx(1.0)
    assert 0.4 < p < 0.6
    assert global_test(0.5 * 400.0, 100)[1] < 1e-10
    assert global_test(1.0, 0) == (1.0, 1.0)
