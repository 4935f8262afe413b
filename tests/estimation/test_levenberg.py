"""The damped loop and reduced normal equations on problems whose answer is known."""

import numpy as np
import pytest

from robcal.estimation.levenberg import Linearised, levenberg
from robcal.estimation.reliability import critical_value, mark_statistics, variance_factors, worst_marks
from robcal.estimation.schur import Factor, Normals
from robcal.estimation.summary import TerminationSettings


def _arctan(x: float) -> Linearised[float]:
    """Residual -arctan(x): plain Gauss-Newton diverges from |x| > 1.39."""
    slope, r = 1.0 / (1.0 + x**2), -np.arctan(x)

    def propose(damping: float) -> tuple[float, float]:
        step = slope * r / (slope**2 * (1.0 + damping))
        return x + step, 0.5 * step * slope * r

    return Linearised(0.5 * r**2, propose, lambda t: 0.5 * float(np.arctan(t)) ** 2)


def test_damping_grows_where_a_step_would_raise_the_cost() -> None:
    x, summary = levenberg(_arctan, 5.0, TerminationSettings(60, 20, 1e-12))
    assert abs(x) < 1e-5
    assert summary.converged
    assert summary.halvings > 0
    assert all(b <= a for a, b in zip(summary.history, summary.history[1:], strict=False))


def test_no_convergence_is_said() -> None:
    _, summary = levenberg(_arctan, 1.0, TerminationSettings(1, 20, 1e-12))
    assert not summary.converged
    assert "1 iterations" in summary.termination
    uphill = Linearised(1.0, lambda damping: (1.0, 1.0), lambda x: 2.0)
    _, summary = levenberg(lambda x: uphill, 0.0, TerminationSettings())
    assert not summary.converged
    assert "no step" in summary.termination


def test_what_is_held_fixed_must_settle_before_the_end() -> None:
    """A residual x - c whose c is looked up at every linearisation only: c = x / 2 has the fixed point 0."""

    def local(x: float) -> Linearised[float]:
        r = x - 0.5 * x
        return Linearised(
            0.5 * r**2, lambda _: (x - r, 0.5 * r**2), lambda t: 0.5 * (t - 0.5 * x) ** 2, lambda t: abs(t - x) < 1e-6
        )

    x, summary = levenberg(local, 1e-3, TerminationSettings())
    assert summary.converged
    assert abs(x) < 2e-6


def _system(seed: int) -> tuple[Normals, np.ndarray, np.ndarray]:
    """Normal equations of 4 shared unknowns and 3 stations, the full matrix (22, 22) and right side."""
    rng = np.random.default_rng(seed)
    J = rng.normal(size=(60, 22))
    for j in range(3):  # a row sees one station only
        J[20 * j : 20 * (j + 1), [c for c in range(4, 22) if not 4 + 6 * j <= c < 10 + 6 * j]] = 0.0
    N, b = J.T @ J, J.T @ rng.normal(size=60)
    at = [slice(4 + 6 * j, 10 + 6 * j) for j in range(3)]
    G, V = np.array([N[:4, a] for a in at]), np.array([N[a, a] for a in at])
    return Normals(N[:4, :4], G, V, b[:4], b[4:].reshape(3, 6)), N, b


def test_reduced_system_has_the_solution_and_cofactors_of_the_full_one() -> None:
    normals, N, b = _system(0)
    factor = Factor(normals, np.zeros((4, 0)), np.zeros(4, dtype=bool))
    shared, stations = factor.solve(normals.b, normals.s)
    np.testing.assert_allclose(np.concatenate([shared, stations.ravel()]), np.linalg.solve(N, b), rtol=1e-9)
    inverse = np.linalg.inv(N)
    Q = factor.cofactors(np.zeros((4, 0)))
    np.testing.assert_allclose(Q, inverse[:4, :4], rtol=1e-8, atol=1e-12)
    own, mixed = factor.station_cofactors(Q)
    np.testing.assert_allclose(own[1], inverse[10:16, 10:16], rtol=1e-8, atol=1e-12)
    np.testing.assert_allclose(mixed[:, 2], inverse[:4, 16:22], rtol=1e-8, atol=1e-12)
    damped, _ = Factor(normals, np.zeros((4, 0)), np.zeros(4, dtype=bool), 0.5).solve(normals.b, normals.s)
    expected = np.linalg.solve(N + 0.5 * np.diag(np.diag(N)), b)[:4]
    np.testing.assert_allclose(damped, expected, rtol=1e-9)


def test_snooping_takes_the_worst_of_each_image_and_target() -> None:
    rng = np.random.default_rng(1)
    R = np.tile(0.5 * np.eye(2), (50, 1, 1))
    r = np.sqrt(0.5) * rng.normal(size=(50, 2))
    r[[3, 4, 20]] += 9.0
    r[4] += 1.0
    statistic = mark_statistics(r, R)
    image, target = np.repeat(np.arange(5), 10), np.tile(np.arange(10), 5)
    taken = worst_marks(statistic, critical_value(50, 0.01), image, target)
    assert set(taken.tolist()) == {4, 20}  # 3 waits: it shares its image with 4
    clean = np.ones(50, dtype=bool)
    clean[[3, 4, 20]] = False
    factors = variance_factors(r[clean], np.full(47, 1.0), np.zeros(47, dtype=np.int64), 2)
    assert factors[0] == pytest.approx(1.0, abs=0.35)
    assert np.isnan(factors[1])
