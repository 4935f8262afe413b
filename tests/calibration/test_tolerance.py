"""Errors against a tolerance, and what they promise of further poses."""

import numpy as np
import pytest

from robcal.calibration.tolerance import conformity


def test_what_the_measurement_cannot_tell_is_undecided() -> None:
    found = conformity([0.1e-3, 0.28e-3, 0.31e-3, 0.5e-3, np.nan], 0.3e-3, 0.05e-3)
    assert (found.places, found.within, found.beyond, found.undecided, found.over) == (4, 1, 1, 2, 2)
    assert not found.kept
    assert found.uncertainty == pytest.approx(1.645 * 0.05e-3, rel=1e-3)
    assert "2 of 4 kept-out errors miss the tolerance of 0.3 mm, 1 of them beyond doubt" in found.statement


def test_without_a_miss_the_share_is_that_of_the_rule_of_three() -> None:
    assert conformity(np.full(60, 1e-4), 2e-4).share == pytest.approx(0.05 ** (1 / 60))
    assert conformity([3e-4], 2e-4).share == 0.0


def test_the_promised_share_is_kept_in_95_of_100_campaigns() -> None:
    rng = np.random.default_rng(3)
    true = 0.9
    limit = float(np.quantile(np.linalg.norm(rng.normal(size=(200_000, 3)), axis=1), true))
    errors = np.linalg.norm(rng.normal(size=(400, 40, 3)), axis=2)
    promised = np.array([conformity(e, limit).share for e in errors])
    assert 0.92 < np.mean(promised <= true) <= 1.0  # the bound is exact or cautious, as counts are whole
