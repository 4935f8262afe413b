"""Gauss-Newton with halving line search, dependent parameters, covariance and redundancy of a whitened problem.

A problem is a function ``linearise(theta) -> (r, J)`` with whitened residuals ``r = measured - model`` (m,) and
``J = d model / d theta`` (m, p), so a step solves ``min |r - J d|``.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from robcal.errors import NotIdentifiable

Array = NDArray[np.float64]


@dataclass(frozen=True)
class TerminationSettings:
    """When to stop.

    Attributes
    ----------
    max_iterations : Gauss-Newton steps at most.
    max_halvings : halvings of one step at most.
    cost_tolerance : stop when a step promises to lower the cost by less than this fraction (plus the same of one).
    """

    max_iterations: int = 30
    max_halvings: int = 12
    cost_tolerance: float = 1e-9


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
