"""Weights of robust estimation belong to their costs."""

from collections.abc import Callable
from functools import partial

import numpy as np
import pytest

from robcal.estimation import robust

PAIRS = [
    (partial(robust.huber_costs, limit=1.5), partial(robust.huber_weights, limit=1.5)),
    (robust.geman_mcclure_costs, robust.geman_mcclure_weights),
]


@pytest.mark.parametrize(("costs", "weights"), PAIRS, ids=["huber", "geman-mcclure"])
def test_weight_is_the_slope_of_the_cost(costs: Callable, weights: Callable) -> None:  # type: ignore[type-arg]
    """An iteration with weights w finds the minimum of the cost if d cost = w d(length^2)."""
    length = np.linspace(0.05, 6.0, 60)
    slope = (costs(length + 1e-6) - costs(length - 1e-6)) / (4e-6 * length)
    np.testing.assert_allclose(weights(length), slope, rtol=1e-5, atol=1e-9)


def test_what_is_not_finite_has_no_weight() -> None:
    length = np.array([np.nan, np.inf, 1.0])
    assert robust.huber_weights(length, 2.0).tolist() == [0.0, 0.0, 1.0]
    assert robust.geman_mcclure_weights(length).tolist() == [0.0, 0.0, 0.25]
    assert robust.geman_mcclure_costs(length).tolist() == [1.0, 1.0, 0.5]


def test_scale_from_the_median_withstands_gross_errors() -> None:
    r = 0.3 * np.random.default_rng(0).normal(size=(4000, 2))
    r[:200] += 50.0
    assert robust.median_scale(r) == pytest.approx(0.3, rel=0.05)
