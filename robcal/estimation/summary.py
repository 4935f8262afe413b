"""When an iteration stops, and how it ended."""

from dataclasses import dataclass


@dataclass(frozen=True)
class TerminationSettings:
    """When to stop.

    Attributes
    ----------
    max_iterations : steps at most.
    max_halvings : halvings of one step at most.
    cost_tolerance : stop when a step lowers, or is predicted to lower, half the sum of squares by less than this
        fraction of it (plus the same fraction of one),
    negligible : or by less than this times the variance of the whitened residuals (one at least): 1e-4 are 0.014
        standard deviations of one parameter.
    """

    max_iterations: int = 30
    max_halvings: int = 12
    cost_tolerance: float = 1e-8
    negligible: float = 0.0


DEFAULT_TERMINATION = TerminationSettings()


@dataclass(frozen=True)
class SolveSummary:
    """How an iteration ended; non-convergence is data, not an exception.

    Attributes
    ----------
    converged : the termination criterion was met.
    iterations : steps taken.
    termination : reason in words.
    cost_start, cost : half the sum of squared whitened residuals, before and after.
    history : cost after each step, the start included.
    halvings : halvings of the line search in total.
    seconds : wall time.
    """

    converged: bool
    iterations: int
    termination: str
    cost_start: float
    cost: float
    history: tuple[float, ...] = ()
    halvings: int = 0
    seconds: float = 0.0
