"""Sums over groups and whitening matrices against their definitions."""

import numpy as np
import pytest

from robcal.estimation.grouping import sum_by, whitener


@pytest.mark.parametrize(("m", "n"), [(50, 4), (30_000, 7), (10, 1)])
def test_sums_are_those_of_a_loop(m: int, n: int) -> None:
    rng = np.random.default_rng(m)
    group, values = rng.integers(0, n, m), rng.normal(size=(m, 2, 3))
    expected = np.zeros((n, 2, 3))
    np.add.at(expected, group, values)
    np.testing.assert_allclose(sum_by(group, values, n), expected, atol=1e-10)


def test_sum_of_nothing_is_zero() -> None:
    assert sum_by(np.empty(0, dtype=np.int64), np.empty((0, 3)), 4).shape == (4, 3)
    assert not sum_by(np.empty(0, dtype=np.int64), np.empty((0, 3)), 4).any()


@pytest.mark.parametrize("k", [2, 3])
def test_whitener_is_a_root_of_the_inverse(k: int) -> None:
    A = np.random.default_rng(k).normal(size=(20, k, k))
    C = A @ np.swapaxes(A, 1, 2) + 0.1 * np.eye(k)
    W = whitener(C)
    np.testing.assert_allclose(np.swapaxes(W, 1, 2) @ W, np.linalg.inv(C), rtol=1e-8, atol=1e-10)


@pytest.mark.parametrize("k", [2, 3])
def test_covariance_that_is_not_positive_definite_is_an_error(k: int) -> None:
    C = np.eye(k)
    C[1, 1] = -1.0
    with pytest.raises(np.linalg.LinAlgError):
        whitener(C[None])
