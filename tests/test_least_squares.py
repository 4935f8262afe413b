"""The solver on problems whose answer is known."""

from __future__ import annotations

import numpy as np
import pytest

from robcal.errors import InvalidInput
from robcal.least_squares import (
    TerminationSettings,
    gauss_newton,
    global_test,
    linear_statistics,
    solve_step,
    split_dependent,
)


def _circle(points: np.ndarray):  # type: ignore[no-untyped-def]
    def residuals(x: np.ndarray) -> np.ndarray:
        return x[2] * 0 - (np.hypot(points[:, 0] - x[0], points[:, 1] - x[1]) - x[2])

    def linearise(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        d = points - x[:2]
        length = np.linalg.norm(d, axis=1)
        return residuals(x), np.column_stack([-d / length[:, None], -np.ones(len(points))])

    return linearise, residuals


def test_circle_is_found_and_summary_tells_how() -> None:
    angle = np.linspace(0, 2, 30)
    points = np.column_stack([3 + 2 * np.cos(angle), -1 + 2 * np.sin(angle)])
    linearise, residuals = _circle(points)
    x, summary = gauss_newton(linearise, residuals, lambda x, d: x + d, np.array([2.0, 0.0, 1.0]))
    np.testing.assert_allclose(x, [3, -1, 2], atol=1e-5)  # residuals of unit weight: tolerance 1e-9 of one
    assert summary.converged
    assert summary.iterations == len(summary.history) - 1
    assert summary.cost < 1e-9 < summary.cost_start


def test_line_search_halves_a_step_that_overshoots() -> None:
    def linearise(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return -np.arctan(x), 1.0 / (1.0 + x[:, None] ** 2)

    x, summary = gauss_newton(linearise, lambda x: -np.arctan(x), lambda x, d: x + d, np.array([5.0]))
    assert abs(x[0]) < 1e-3
    assert summary.halvings > 0


def test_not_finite_start_is_refused_and_few_iterations_are_told() -> None:
    def linearise(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return np.array([np.nan]), np.ones((1, 1))

    with pytest.raises(InvalidInput, match="not finite"):
        gauss_newton(linearise, lambda x: x, lambda x, d: x + d, np.zeros(1))
    points = np.random.default_rng(0).normal(size=(20, 2))
    lin, res = _circle(points)
    settings = TerminationSettings(max_iterations=1)
    _, summary = gauss_newton(lin, res, lambda x, d: x + d, np.array([9.0, 9.0, 1.0]), settings)
    assert not summary.converged
    assert "1 iterations" in summary.termination


def test_singular_step_falls_back_to_the_pseudo_inverse() -> None:
    J = np.ones((5, 2))
    step = solve_step(np.ones(5), J)
    np.testing.assert_allclose(J @ step, np.ones(5), atol=1e-9)


def test_dependent_columns_are_named_with_their_ties() -> None:
    rng = np.random.default_rng(0)
    J = rng.normal(size=(40, 6))
    J[:, 3] = 2.0 * J[:, 0] - 0.5 * J[:, 1]
    J[:, 4] = 0.0
    J[:, 5] *= 1e-3
    kept, gone = split_dependent(J.T @ J, list("abcdef"), np.array([np.inf] * 5 + [10.0]))
    assert kept == [0, 1, 2]
    by_name = {e.name: e for e in gone}
    assert by_name["d"].reason == "dependent"
    assert by_name["d"].tied_to == pytest.approx({"a": 2.0, "b": -0.5}, abs=1e-6)
    assert by_name["e"].reason == "no influence"
    assert by_name["f"].reason == "weak"
    assert by_name["f"].sigma == pytest.approx(1e3 / np.sqrt(40), rel=0.5)
    assert split_dependent(J.T @ J, list("abcdef"))[0] == [0, 1, 2, 5]


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


def test_damping_keeps_nearly_open_directions_in_bounds_and_fades() -> None:
    """Two columns nearly alike: the first step stays near what is usual, the last ones find the exact minimum."""
    rng = np.random.default_rng(3)
    J = rng.normal(size=(40, 2))
    J[:, 1] = J[:, 0] + 1e-3 * J[:, 1]
    truth = np.array([3.0, -2.0])
    seen: list[np.ndarray] = []

    def lin(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        seen.append(x)
        return J @ (truth - x), J

    usual = np.full(2, 0.05)
    x, summary = gauss_newton(lin, lambda x: J @ (truth - x), lambda x, d: x + d, np.zeros(2), usual=usual)
    assert summary.converged
    assert np.abs(seen[1]).max() < 1.0  # the undamped step would go to the truth at once
    np.testing.assert_allclose(J @ x, J @ truth, atol=1e-2)
