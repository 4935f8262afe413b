"""Evidence of causes over their grids."""

from dataclasses import replace

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from scipy import special

from robcal.diagnosis.scan.posterior import posterior
from robcal.diagnosis.scan.statistics import ScanResult
from robcal.physics.cause import LinearCause
from robcal.physics.joint_play import BACKLASH

BLANK = LinearCause(BACKLASH, "axis1", "z", ("width",), (1e-4,), lambda v, c: {})


def scanned(seed: int, count: int) -> tuple[list[LinearCause], ScanResult]:
    rng = np.random.default_rng(seed)
    causes = [
        replace(BLANK, grid=tuple({"k": float(g)} for g in range(rng.integers(1, 5))), weight=rng.uniform(0.1, 1.0))
        for _ in range(count)
    ]
    cause = np.repeat(np.arange(count), [len(f.grid) for f in causes])
    grid = np.concatenate([np.arange(len(f.grid)) for f in causes])
    order = rng.permutation(len(grid))
    evidence = 100.0 * rng.standard_normal(len(grid))
    evidence[rng.uniform(size=len(grid)) < 0.3] = -np.inf
    none = np.zeros(len(grid))
    return causes, ScanResult(cause[order], grid[order], none, none, none, evidence, 1.0, 100)


@given(st.integers(0, 10_000), st.integers(1, 12))
def test_the_evidence_is_the_mean_over_the_grid_times_the_weight(seed: int, count: int) -> None:
    causes, result = scanned(seed, count)
    ranked = posterior(causes, result)
    for f, cause in enumerate(causes):
        mine = result.cause == f
        values = result.log_evidence[mine]
        if not np.any(np.isfinite(values)):
            assert ranked.log_weight[f] == -np.inf
            continue
        expected = special.logsumexp(values) - np.log(len(cause.grid)) + np.log(cause.weight)
        np.testing.assert_allclose(ranked.log_weight[f], expected, rtol=1e-12, atol=1e-9)
        assert ranked.best_grid[f] == result.grid[mine][np.argmax(values)]


def test_probabilities_of_the_chosen_add_up_to_one() -> None:
    causes, result = scanned(3, 8)
    ranked = posterior(causes, result)
    chosen = np.arange(8) % 2 == 0
    probability = ranked.probability(chosen)
    np.testing.assert_allclose(probability.sum(), 1.0)
    assert np.all(probability[~chosen] == 0.0)
