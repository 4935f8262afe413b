"""Parameters that may go back to nominal."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from robcal.calibration.identifiability import weak_parameters


@given(st.integers(0, 10_000), st.integers(2, 8), st.integers(0, 3))
def test_the_others_are_within_their_limits_afterwards(seed: int, size: int, weak: int) -> None:
    rng = np.random.default_rng(seed)
    jacobian = rng.standard_normal((40, size))
    for k in range(min(weak, size - 1)):  # nearly the same as its neighbour
        jacobian[:, k] = jacobian[:, k + 1] + 1e-3 * rng.standard_normal(40)
    names = [f"p{k}" for k in range(size)]
    limits = rng.uniform(0.5, 3.0, size)
    gone = weak_parameters(names, np.linalg.inv(jacobian.T @ jacobian), limits)
    stays = [k for k, name in enumerate(names) if name not in gone]
    left = np.linalg.inv(jacobian[:, stays].T @ jacobian[:, stays])
    assert np.all(np.sqrt(np.diag(left)) <= limits[stays] * (1 + 1e-6))
    for name in gone:  # none went without need: with all that went after it, it would be too uncertain again
        tried = sorted({*stays, *(names.index(n) for n in gone[gone.index(name) :])})
        cofactor = np.linalg.inv(jacobian[:, tried].T @ jacobian[:, tried])
        k = names.index(name)
        assert np.sqrt(cofactor[tried.index(k), tried.index(k)]) > limits[k] * (1 - 1e-6)


def test_of_two_that_say_the_same_one_stays() -> None:
    covariance = np.array([[100.0, -99.99, 0.0], [-99.99, 100.0, 0.0], [0.0, 0.0, 0.01]])
    assert len(weak_parameters(("a", "b", "c"), covariance, np.ones(3))) == 1
    assert weak_parameters(("a", "b", "c"), covariance, np.full(3, np.inf)) == ()
