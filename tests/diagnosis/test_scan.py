"""The scan: projection, probabilities under the null, evidence."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from robcal.diagnosis.noise.blunders import worst_group
from robcal.diagnosis.scan.family_wise import simulate
from robcal.diagnosis.scan.statistics import (
    Entry,
    log_bayes_factor,
    orthonormal_basis,
    remove,
    restack,
    scan,
    stack_entries,
)

ROWS, PARAMETERS = 120, 12


def problem(seed: int, candidates: int = 30, width: int = 2) -> tuple[np.ndarray, list[Entry]]:
    rng = np.random.default_rng(seed)
    basis = orthonormal_basis(rng.normal(size=(ROWS, PARAMETERS)))
    entries = [Entry(i, 0, rng.normal(size=(ROWS, 1 + i % width))) for i in range(candidates)]
    return basis, entries


@given(st.integers(0, 1000))
@settings(max_examples=20, deadline=None)
def test_what_the_model_absorbs_is_not_tested(seed: int) -> None:
    basis, entries = problem(seed)
    absorbed = Entry(99, 0, basis[:, :2] @ np.array([[3.0, 1.0], [0.0, 2.0]]))
    stacks = stack_entries([*entries, absorbed], basis)
    result = scan(stacks, remove(basis, np.random.default_rng(seed).normal(size=(ROWS, 1)))[:, 0], ROWS - PARAMETERS)
    assert result.count[result.cause == 99] == 0
    assert result.log_evidence[result.cause == 99] == -np.inf


@given(st.integers(0, 1000))
@settings(max_examples=20, deadline=None)
def test_statistic_is_the_drop_of_the_square_sum(seed: int) -> None:
    basis, entries = problem(seed)
    r = remove(basis, np.random.default_rng(seed + 1).normal(size=(ROWS, 1)))[:, 0]
    result = scan(stack_entries(entries, basis), r, ROWS - PARAMETERS)
    for cause, chi2 in zip(result.cause, result.chi2, strict=True):
        full = np.column_stack([basis, entries[cause].columns])
        left = r - full @ np.linalg.lstsq(full, r, rcond=None)[0]
        assert np.isclose(chi2 * result.variance_factor, r @ r - left @ left, rtol=1e-8, atol=1e-9)


def test_family_wise_level_is_kept() -> None:
    basis, entries = problem(3)
    stacks = stack_entries(entries, basis)
    level = simulate(stacks, basis, ROWS - PARAMETERS, ROWS, runs=600, seed=1)
    rng = np.random.default_rng(2)
    p = []
    for _ in range(600):
        r = remove(basis, rng.normal(size=(ROWS, 1)) * 1.7)[:, 0]  # a misstated noise must not matter
        result = scan(stacks, r, ROWS - PARAMETERS)
        p.append(level.probability(float(result.log_p[result.best])))
    assert 0.02 < np.mean(np.array(p) < 0.05) < 0.085


def test_evidence_pays_for_columns_that_explain_nothing() -> None:
    singular = np.array([[30.0, 0.0], [30.0, 30.0]])
    z = np.array([[6.0, 0.0], [6.0, 0.1]])
    lean, fat = log_bayes_factor(singular, z)
    assert lean > fat > 0
    assert log_bayes_factor(singular[:1], np.array([[0.5, 0.0]]))[0] < 0


def test_gross_error_is_found_in_its_group() -> None:
    rng = np.random.default_rng(5)
    basis = orthonormal_basis(rng.normal(size=(ROWS, PARAMETERS)))
    noise = rng.normal(size=ROWS)
    noise[30:33] += 15.0
    r = remove(basis, noise[:, None])[:, 0]
    suspect = worst_group(r, basis, np.repeat(np.arange(ROWS // 3), 3))
    assert suspect.label == 10
    assert suspect.log_evidence > 20


def test_gross_error_of_a_whole_body_is_seen_in_the_ways_in_which_it_moves() -> None:
    rng = np.random.default_rng(6)
    basis = orthonormal_basis(rng.normal(size=(ROWS, PARAMETERS)))
    ways = rng.normal(size=(ROWS, 2))
    noise = rng.normal(size=ROWS)
    noise[24:36] += 4.0 * ways[24:36] @ np.array([0.8, -0.6])
    r = remove(basis, noise[:, None])[:, 0]
    group = np.repeat(np.arange(ROWS // 12), 12)
    together = worst_group(r, basis, group, ways[: len(group)])
    assert together.label == 2
    assert together.log_evidence > worst_group(r, basis, group).log_evidence + 5


def test_a_preferred_sign_shares_out_the_same_evidence() -> None:
    singular, z = np.full((2, 1), 5.0), np.array([[4.0], [-4.0]])
    plain = log_bayes_factor(singular, z)
    preferred = log_bayes_factor(singular, z, np.full(2, 0.9))
    assert plain[0] == pytest.approx(plain[1])
    assert preferred[0] - plain[0] == pytest.approx(np.log(1.8), abs=0.01)
    assert preferred[1] - plain[1] == pytest.approx(np.log(0.2), abs=0.05)
    # the two signs' evidences add up to what they are without a preference
    mirrored = log_bayes_factor(singular, z[::-1], np.full(2, 0.9))
    assert np.logaddexp(preferred, mirrored) == pytest.approx(plain + np.log(2.0))
    assert log_bayes_factor(singular, z, np.full(2, 0.5)) == pytest.approx(plain)


def test_restacking_equals_stacking_with_the_larger_model() -> None:
    basis, listed = problem(7, width=3)
    extra = listed[4].columns
    further = orthonormal_basis(remove(basis, extra))
    whole = np.concatenate([basis, further], axis=1)
    residual = remove(whole, np.random.default_rng(3).normal(size=(ROWS, 1)))[:, 0]
    redundancy = ROWS - whole.shape[1]
    direct = scan(stack_entries(listed, whole), residual, redundancy)
    again = scan(restack(stack_entries(listed, basis), further), residual, redundancy)
    assert np.array_equal(direct.count, again.count)
    assert np.allclose(direct.chi2, again.chi2, atol=1e-9)
    seen = direct.count > 0
    assert np.allclose(direct.log_evidence[seen], again.log_evidence[seen], atol=1e-9)
