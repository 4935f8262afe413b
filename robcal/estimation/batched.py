"""Levenberg-Marquardt on many small problems at once, each with its own damping and its own end.

The state of n problems is an array (n, ...); a problem of p parameters is its normal equations (p, p). Problems that
have ended are not evaluated any more. Sources: Levenberg (1944); Marquardt (1963), scaling of the damping by the
diagonal; Madsen, Nielsen, Tingleff (2004), "Methods for non-linear least squares problems", section 3.2.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from robcal.columns import Columns
from robcal.estimation.grouping import Array, IntArray, sum_by
from robcal.estimation.summary import TerminationSettings

_LEAST_DAMPING = 1e-10
"""Relative to a unit diagonal: solves singular systems with the least step in the directions that are open."""
_AFTER_REJECTION = 1e-3
"""Damping at least after a step that raised the cost: smaller ones would hardly change it."""


@dataclass(frozen=True)
class NormalEquations(Columns):
    """Normal equations of n problems: ``matrix`` (n, p, p), ``right`` (n, p), ``cost`` (n,) sums of squares."""

    matrix: Array
    right: Array
    cost: Array

    @classmethod
    def of_rows(cls, group: IntArray, r: Array, J: Array, n: int) -> "NormalEquations":
        """Sum of whitened residuals (m, d) and Jacobians (m, d, p) over the problem ``group`` (m,) of each row.

        Rows that are not finite take no part in the step but make the cost of their problem infinite.
        """
        finite = np.asarray(np.isfinite(r).all(axis=1) & np.isfinite(J).all(axis=(1, 2)))
        if not finite.all():
            r, J = np.where(finite[:, None], r, 0.0), np.where(finite[:, None, None], J, 0.0)
        turned = np.swapaxes(J, -1, -2)
        matrix, right = sum_by(group, turned @ J, n), sum_by(group, (turned @ r[..., None])[..., 0], n)
        cost = sum_by(group, np.sum(r**2, axis=1), n)
        cost[group[~finite]] = np.inf
        return cls(matrix, right, cost)

    def inverse(self) -> Array:
        """(n, p, p) covariances; NaN where a problem is singular."""
        scale = np.sqrt(np.maximum(np.diagonal(self.matrix, axis1=1, axis2=2), 1e-300))
        outer = scale[:, :, None] * scale[:, None, :]
        unit = self.matrix / outer
        regular = np.linalg.eigvalsh(unit)[:, 0] > 1e-12
        inverse = np.full_like(unit, np.nan)
        if regular.any():
            inverse[regular] = np.linalg.inv(unit[regular]) / outer[regular]
        return inverse


@dataclass(frozen=True)
class Damping:
    """Levenberg damping: at the start, factors after accepted and rejected steps, and the value that ends a problem."""

    start: float = 1e-6
    shrink: float = 0.1
    grow: float = 10.0
    largest: float = 1e6


@dataclass(frozen=True)
class Solutions:
    """Solutions of n problems: ``state`` (n, ...), ``equations`` there, ``converged`` (n,), ``iterations``."""

    state: Array
    equations: NormalEquations
    converged: NDArray[np.bool_]
    iterations: int


def marquardt_step(equations: NormalEquations, damping: Array) -> Array:
    """Steps (n, p) with the damping (n,) in units of the diagonal."""
    scale = 1.0 / np.sqrt(np.maximum(np.diagonal(equations.matrix, axis1=1, axis2=2), 1e-300))
    unit = equations.matrix * scale[:, :, None] * scale[:, None, :]
    at = np.arange(unit.shape[-1])
    unit[:, at, at] = 1.0 + np.maximum(damping, _LEAST_DAMPING)[:, None]
    return np.linalg.solve(unit, (equations.right * scale)[..., None])[..., 0] * scale


def minimise_each(
    equations: Callable[[Array, IntArray], NormalEquations],
    retract: Callable[[Array, Array], Array],
    start: Array,
    settings: TerminationSettings,
    damping: Damping = Damping(),
    solve: Callable[[NormalEquations, Array], Array] = marquardt_step,
    cost_accuracy: float = 0.0,
) -> Solutions:
    """Minimise the sums of squares of n problems.

    Parameters
    ----------
    equations : normal equations of the problems ``rows`` (a,) at their states (a, ...). A state outside the domain has
        an infinite cost.
    retract : moves states (a, ...) by steps (a, p); may shorten them.
    start : (n, ...) first states.
    settings : a problem has converged when a step is predicted to lower its sum of squares by no more than
        ``max(negligible, cost_tolerance * cost)``; ``max_halvings`` is not used.
    solve : steps (a, p) from normal equations and damping (a,).
    cost_accuracy : relative accuracy of a computed cost; a rise below it does not reject a step.
    """
    x = np.array(start, dtype=float)
    n = len(x)
    rows = np.arange(n)
    best = equations(x, rows)
    factor = np.full(n, damping.start)
    converged = best.cost <= settings.negligible
    active, steps = rows[~converged], 0
    while len(active) and steps < settings.max_iterations:
        steps += 1
        now = best.select(active)
        step = solve(now, factor[active])
        predicted = np.einsum("np,np->n", step, 2.0 * now.right - (now.matrix @ step[..., None])[..., 0])
        trial = retract(x[active], step)
        new = equations(trial, active)
        better = new.cost <= now.cost * (1.0 + cost_accuracy)
        accepted = active[better]
        x[accepted] = trial[better]
        best.put(accepted, new, better)
        used, cost = factor[active], best.cost[active]
        factor[active] = np.where(better, damping.shrink * used, np.maximum(damping.grow * used, _AFTER_REJECTION))
        small = predicted <= np.maximum(settings.negligible, settings.cost_tolerance * cost)
        small &= np.isfinite(cost) & (used <= 1.0)  # a step may also be small because it is damped
        small |= cost <= settings.negligible
        converged[active[small]] = True
        active = active[~small & (factor[active] <= damping.largest)]
    return Solutions(x, best, converged, steps)
