"""LinearCause-wise level with the tails that residuals have."""

import numpy as np
import pytest

from robcal.diagnosis.scan.family_wise import simulate, tails
from robcal.diagnosis.scan.statistics import Entry, orthonormal_basis, remove, scan, stack_entries

ROWS, FREEDOM = 300, 4.5


def student(rng: np.random.Generator) -> np.ndarray:
    """Unit variance, three rows to an observation."""
    scale = np.sqrt((FREEDOM - 2.0) / rng.chisquare(FREEDOM, ROWS // 3))
    return rng.standard_normal(ROWS) * np.repeat(scale, 3)


def test_tails_are_long_only_where_they_are() -> None:
    rng = np.random.default_rng(1)
    gaussian = [tails(rng.standard_normal(ROWS), ROWS) for _ in range(60)]
    assert np.mean(np.isfinite(gaussian)) < 0.1
    long = np.array([tails(student(rng), ROWS) for _ in range(60)])
    assert np.mean(np.isfinite(long)) > 0.7
    assert np.median(long[np.isfinite(long)]) == pytest.approx(FREEDOM, abs=3.0)


def test_effects_in_few_rows_are_no_false_alarm_with_long_tails() -> None:
    rng = np.random.default_rng(2)
    basis = orthonormal_basis(rng.normal(size=(ROWS, 8)))
    columns = np.zeros((ROWS, 100))
    for k in range(100):
        columns[3 * k : 3 * k + 3, k] = 30.0
    stacks = stack_entries([Entry(k, 0, columns[:, k : k + 1]) for k in range(100)], basis)
    redundancy, block = ROWS - 8, np.repeat(np.arange(100), 3)
    plain = simulate(stacks, basis, redundancy, ROWS, runs=400, seed=3)
    long = simulate(stacks, basis, redundancy, ROWS, runs=400, seed=3, freedom=FREEDOM, block=block)
    alarms = np.zeros(2)
    for _ in range(200):
        residual = remove(basis, student(rng)[:, None])[:, 0]
        log_p = float(scan(stacks, residual, redundancy).log_p.min())
        alarms += [plain.probability(log_p) < 0.05, long.probability(log_p) < 0.05]
    assert alarms[0] > 30
    assert alarms[1] < 22
