"""Gauss-Newton with fallback to damping for one large problem that brings its own normal equations.

Undamped as long as steps lower the cost; where one raises it, or the equations are singular, the damping grows until
one does not (Levenberg 1944, Marquardt 1963), and fades again. What a problem holds fixed while it is linearised
(robust weights, small corrections) may change from one linearisation to the next.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, TypeVar

import numpy as np

from robcal.estimation.summary import SolveSummary, TerminationSettings

State = TypeVar("State")

_FIRST, _NONE = 1e-6, 1e-8
_ROUNDING = 1e-12
"""A cost may rise by this share (and as much in all) by rounding."""


@dataclass(frozen=True)
class Schedule:
    """Damping at the start, its factors after rejected and accepted steps, and below what a step counts as undamped."""

    start: float = 0.0
    grow: float = 10.0
    shrink: float = 0.1
    undamped: float = 1e-3


@dataclass(frozen=True)
class Linearised(Generic[State]):
    """A problem linearised at a state.

    Attributes
    ----------
    cost : half the sum of squares there.
    propose : the state after a step with some damping, and the cost that the step is predicted to save. Raises
        LinAlgError where the damped equations are singular.
    evaluate : cost of another state, with everything held fixed that the linearisation holds fixed; NaN outside the
        domain.
    settled : true if what is held fixed hardly changes up to another state.
    """

    cost: float
    propose: Callable[[float], tuple[State, float]]
    evaluate: Callable[[State], float]
    settled: Callable[[State], bool] = lambda _: True


def levenberg(
    linearise: Callable[[State], Linearised[State]],
    start: State,
    settings: TerminationSettings,
    schedule: Schedule = Schedule(),
) -> tuple[State, SolveSummary]:
    """Minimise; ``max_halvings`` is how often the damping may grow in one step.

    Converged when a step is predicted to save less than ``max(cost_tolerance * (1 + cost), negligible)`` of the cost.
    """
    begin = time.perf_counter()
    state, damping, halvings = start, schedule.start, 0
    history: list[float] = []
    converged, why = False, f"stopped after {settings.max_iterations} iterations"
    for _ in range(settings.max_iterations):
        local = linearise(state)
        if not history:
            history.append(local.cost)
        small = max(settings.cost_tolerance * (1.0 + local.cost), settings.negligible)
        accepted, predicted = False, np.inf
        for _ in range(settings.max_halvings + 1):
            try:
                trial, predicted = local.propose(damping)
            except np.linalg.LinAlgError:
                damping = max(schedule.grow * damping, 1e-3 * _FIRST)
                continue
            cost = local.evaluate(trial)
            accepted = cost <= local.cost * (1.0 + _ROUNDING) + _ROUNDING
            if accepted or predicted < small:
                break
            halvings += 1
            damping = max(schedule.grow * damping, _FIRST)
        if not accepted:
            converged = predicted < small
            why = "a further step would not lower the cost" if converged else "no step lowers the cost"
            break
        state = trial
        history.append(cost)
        damping *= schedule.shrink
        damping = 0.0 if damping < _NONE else damping
        if predicted < small and damping < schedule.undamped and local.settled(state):
            converged, why = True, "the last step lowered the cost by less than the tolerance"
            break
    seconds = time.perf_counter() - begin
    steps = len(history) - 1
    return state, SolveSummary(converged, steps, why, history[0], history[-1], tuple(history), halvings, seconds)
