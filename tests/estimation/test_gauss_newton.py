"""The solver on problems whose answer is known."""

from collections.abc import Callable

import numpy as np
import pytest

from robcal.errors import InvalidInput
from robcal.estimation.gauss_newton import gauss_newton, solve_step
from robcal.estimation.summary import TerminationSettings


def _circle(
    points: np.ndarray,
) -> tuple[Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]], Callable[[np.ndarray], np.ndarray]]:
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


def test_damping_keeps_nearly_open_directions_in_bounds_and_fades() -> None:
    """Two columns nearly alike: the first step stays near the prior scale, the last ones find the exact minimum."""
    rng = np.random.default_rng(3)
    J = rng.normal(size=(40, 2))
    J[:, 1] = J[:, 0] + 1e-3 * J[:, 1]
    truth = np.array([3.0, -2.0])
    seen: list[np.ndarray] = []

    def lin(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        seen.append(x)
        return J @ (truth - x), J

    prior_scale = np.full(2, 0.05)
    x, summary = gauss_newton(lin, lambda x: J @ (truth - x), lambda x, d: x + d, np.zeros(2), prior_scale=prior_scale)
    assert summary.converged
    assert np.abs(seen[1]).max() < 1.0  # the undamped step would go to the truth at once
    np.testing.assert_allclose(J @ x, J @ truth, atol=1e-2)
