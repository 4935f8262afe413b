"""Gauss-Newton with halving line search on a whitened problem.

A problem is linearised at a state as whitened residuals ``r = measured - model`` (m,) and Jacobian
``J = d model / d step`` (m, p), so a step solves ``min |r - J step|``. The state may be anything that a step can move
(an array, a frame, a network).
"""

import time
from collections.abc import Callable
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from robcal.errors import InvalidInput
from robcal.estimation.summary import DEFAULT_TERMINATION, SolveSummary, TerminationSettings

Array = NDArray[np.float64]
State = TypeVar("State")

TRUST_FACTOR = 4.0
"""Factor by which steps may grow after one that lowered the cost as predicted, or shrink after a halved one."""


def solve_step(r: Array, J: Array, prior_scale: Array | None = None) -> Array:
    """Least-squares step (p,) by scaled normal equations; by the pseudo-inverse where they are singular.

    ``prior_scale`` (p,): typical sizes of a step; a step in units of these counts like a measured residual.
    """
    scale = np.linalg.norm(J, axis=0)
    scale[scale == 0] = 1.0
    scaled = J / scale
    N, b = scaled.T @ scaled, scaled.T @ r
    if prior_scale is not None:
        N[np.diag_indices_from(N)] += 1.0 / (prior_scale * scale) ** 2
    try:
        factor = linalg.cho_factor(N, check_finite=False)
        step = linalg.cho_solve(factor, b, check_finite=False)
    except linalg.LinAlgError:
        step = linalg.lstsq(scaled, r, cond=1e-12, check_finite=False)[0]
    return np.asarray(step / scale)


def gauss_newton(
    linearise: Callable[[State], tuple[Array, Array]],
    residuals: Callable[[State], Array],
    retract: Callable[[State, Array], State],
    start: State,
    settings: TerminationSettings = DEFAULT_TERMINATION,
    prior_scale: Array | None = None,
) -> tuple[State, SolveSummary]:
    """Minimise ``|r|^2`` by Gauss-Newton steps, halved until the cost falls (Nocedal and Wright 2006, section 10.3).

    Parameters
    ----------
    linearise : whitened residuals (m,) and Jacobian (m, p) at a state.
    residuals : the residuals alone, for the line search.
    retract : moves a state by a step (p,).
    start : first state.
    settings : termination.
    prior_scale : (p,) typical sizes of a step, or None. Where the data leave a direction nearly open (almost parallel
        axes), a full step would follow it beyond all linearity; one damped by these sizes does not (Levenberg 1944).

    Raises
    ------
    InvalidInput : the residuals at the start are not finite.
    """
    clock = time.perf_counter()
    state, halvings = start, 0
    r, J = linearise(state)
    cost = 0.5 * float(r @ r)
    if not np.isfinite(cost) or not np.all(np.isfinite(J)):
        raise InvalidInput("the residuals at the start values are not finite: check measurements and covariances")
    history = [cost]

    def summary(converged: bool, why: str) -> SolveSummary:
        seconds = time.perf_counter() - clock
        return SolveSummary(converged, len(history) - 1, why, history[0], cost, tuple(history), halvings, seconds)

    trust = 1.0
    for _ in range(settings.max_iterations):
        step = solve_step(r, J, None if prior_scale is None else trust * prior_scale)
        change = J @ step
        predicted_gain = float(r @ change - 0.5 * change @ change)
        # measurements that scatter more than they state make all differences of the cost larger
        variance = max(1.0, 2.0 * cost / max(1, J.shape[0] - J.shape[1]))
        small = max(settings.cost_tolerance * (1.0 + cost), settings.negligible * variance)
        if predicted_gain <= small:
            return state, summary(True, "a further step would not lower the cost")
        found = _line_search(retract, residuals, state, step, cost, settings.max_halvings)
        halvings += settings.max_halvings + 1 if found is None else found[2]
        if found is None:
            near = predicted_gain <= 1e-3 + 1e-6 * cost  # a few hundredths of a standard deviation
            return state, summary(near, "no fraction of the step lowers the cost")
        gain, whole = cost - found[1], found[2] == 0
        state, cost = found[:2]
        # as long as steps gain what was predicted the damping fades, and the last ones are undamped
        if gain > 0.75 * predicted_gain:
            trust *= TRUST_FACTOR
        elif not whole:
            trust /= TRUST_FACTOR
        history.append(cost)
        if gain <= small and whole:
            return state, summary(True, "the last step lowered the cost by less than the tolerance")
        r, J = linearise(state)
    return state, summary(False, f"stopped after {settings.max_iterations} iterations")


def _line_search(
    retract: Callable[[State, Array], State],
    residuals: Callable[[State], Array],
    state: State,
    step: Array,
    cost: float,
    most: int,
) -> tuple[State, float, int] | None:
    """State and cost after the largest of the fractions 1, 1/2, 1/4 ... of a step that lowers the cost, and how often
    it was halved; None if none does."""
    for halvings in range(most + 1):
        candidate = retract(state, 0.5**halvings * step)
        trial = residuals(candidate)
        new_cost = 0.5 * float(trial @ trial)
        if np.isfinite(new_cost) and new_cost < cost:
            return candidate, new_cost, halvings
    return None
