"""Many small problems at once: each ends as it would alone, and nothing it does touches the others."""

from collections.abc import Callable

import numpy as np

from robcal.estimation.batched import NormalEquations, minimise_each
from robcal.estimation.grouping import members
from robcal.estimation.summary import TerminationSettings


def _circles(points: np.ndarray, group: np.ndarray, n: int) -> Callable[[np.ndarray, np.ndarray], NormalEquations]:
    """Normal equations of circles (centre, radius) through their own points."""

    def equations(x: np.ndarray, chosen: np.ndarray) -> NormalEquations:
        rows, place = members(group, chosen, n)
        d = points[rows] - x[place, :2]
        length = np.linalg.norm(d, axis=1)
        r = length - x[place, 2]
        J = np.column_stack([-d / length[:, None], -np.ones(len(rows))])
        return NormalEquations.of_rows(place, r[:, None], -J[:, None], len(chosen))

    return equations


def _data(n: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(0)
    truth = np.column_stack([rng.normal(size=(n, 2)), rng.uniform(1, 2, n)])
    group = np.repeat(np.arange(n), 12)
    angle = rng.uniform(0, 2 * np.pi, len(group))
    points = truth[group, :2] + truth[group, 2:] * np.column_stack([np.cos(angle), np.sin(angle)])
    return truth, group, points


def test_each_problem_finds_its_own_minimum_and_covariance() -> None:
    truth, group, points = _data(20)
    equations = _circles(points, group, 20)
    start = truth + np.random.default_rng(1).normal(size=truth.shape) * 0.2
    found = minimise_each(equations, np.add, start, TerminationSettings(negligible=1e-20))
    assert found.converged.all()
    np.testing.assert_allclose(found.state, truth, atol=1e-8)
    np.testing.assert_allclose(
        found.equations.inverse() @ found.equations.matrix, np.tile(np.eye(3), (20, 1, 1)), atol=1e-9
    )
    alone = minimise_each(_circles(points[group == 7], np.zeros(12, int), 1), np.add, start[7:8], TerminationSettings())
    np.testing.assert_allclose(alone.state[0], truth[7], atol=1e-5)


def test_problems_that_have_ended_are_not_evaluated_again() -> None:
    truth, group, points = _data(5)
    equations = _circles(points, group, 5)
    asked: list[list[int]] = []

    def noted(x: np.ndarray, chosen: np.ndarray) -> NormalEquations:
        asked.append(chosen.tolist())
        return equations(x, chosen)

    start = truth.copy()
    start[3] += [0.3, -0.3, 0.2]
    found = minimise_each(noted, np.add, start, TerminationSettings(negligible=1e-12))
    assert asked[0] == [0, 1, 2, 3, 4]
    assert asked[1:] == [[3]] * found.iterations
    assert found.iterations > 1


def test_a_step_that_raises_the_cost_is_damped() -> None:
    """Gauss-Newton alone diverges from 5 on arctan, whose curvature vanishes far out."""

    def equations(x: np.ndarray, chosen: np.ndarray) -> NormalEquations:
        slope = 1.0 / (1.0 + x**2)
        return NormalEquations(slope[:, :, None] ** 2, -slope * np.arctan(x), np.arctan(x[:, 0]) ** 2)

    found = minimise_each(equations, np.add, np.array([[5.0], [0.1]]), TerminationSettings(60, negligible=1e-14))
    assert found.converged.all()
    np.testing.assert_allclose(found.state, 0.0, atol=1e-6)


def test_rows_outside_the_domain_and_open_directions() -> None:
    """A row that is not finite makes its problem's cost infinite; a parameter without influence stays."""
    r, J = np.array([[1.0], [np.nan], [2.0]]), np.array([[[1.0, 0.0]], [[1.0, 0.0]], [[1.0, 0.0]]])
    system = NormalEquations.of_rows(np.array([0, 1, 1]), r, J, 2)
    assert np.isinf(system.cost).tolist() == [False, True]
    np.testing.assert_array_equal(system.right, [[1.0, 0.0], [2.0, 0.0]])
    assert np.isnan(system.inverse()).all()

    def equations(x: np.ndarray, chosen: np.ndarray) -> NormalEquations:
        return NormalEquations.of_rows(np.zeros(1, int), 3.0 - x[:, :1], np.array([[[1.0, 0.0]]]), 1)

    found = minimise_each(equations, np.add, np.array([[0.0, 5.0]]), TerminationSettings(negligible=1e-14))
    np.testing.assert_allclose(found.state, [[3.0, 5.0]], atol=1e-6)
