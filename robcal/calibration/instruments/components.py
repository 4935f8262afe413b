"""Variance components: how much more, or less, each instrument scatters than it states.

Each group's sum of squares is set against its own redundancy and the estimation repeated until both agree (Helmert
1907 in the simplified form of Foerstner 1979).
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from robcal.calibration.instruments.evaluator import JointEvaluator
from robcal.calibration.measurements import RobotObservations, rescaled
from robcal.calibration.observations import FrameObservations
from robcal.calibration.outliers import PoseStatistics
from robcal.calibration.problem import State
from robcal.transforms import Array

LEVEL = 0.01
"""The stated covariance holds unless chi-square contradicts it at this level."""
ALIKE = 0.02
"""Factors that change by less than this share are settled."""
LEAST_REDUNDANCY = 0.05


@dataclass(frozen=True)
class Component:
    """How an instrument's residuals compare with the covariance that they were weighted with.

    Attributes
    ----------
    sigma0, redundancy, p_value : of this instrument alone (chi-square; small if it scatters too much).
    factors : for each kind of its observations the factor on the variances: (2,) of position and rotation of frames,
        else (1,).
    """

    sigma0: float
    redundancy: float
    p_value: float
    factors: tuple[Array, ...] = field(repr=False)


def components(evaluator: JointEvaluator, state: State, weights: Array, poses: PoseStatistics) -> list[Component]:
    """The component of every part, at a solution with weights (n,) and the statistics of its poses."""
    T = evaluator(state).T
    out = []
    for k, rows in enumerate(evaluator.rows):
        used = weights[rows] > 0
        mine = rows[used]
        numbers = int(evaluator.stack.used[mine].sum())
        redundancy = max(float(poses.redundancy[mine].sum()), LEAST_REDUNDANCY * max(numbers, 1))
        square = float(np.sum(poses.residuals[mine] ** 2))
        share = redundancy / max(numbers, 1)
        factors = tuple(_factors(o, T[rows], used, share) for o in evaluator.observations_at(state, k))
        p_value = float(stats.chi2.sf(square, redundancy))
        out.append(Component(float(np.sqrt(square / redundancy)), redundancy, p_value, factors))
    return out


def _factors(o: RobotObservations, T: Array, used: NDArray[np.bool_], share: float) -> Array:
    """Mean squares of whitened residuals over their share of the redundancy, taken as even within an instrument."""
    keep = used[o.pose]
    r, _ = o.evaluate(T)
    white = np.linalg.solve(np.linalg.cholesky(o.noise(T)), r[..., None])[..., 0][keep]
    groups = [white[:, :3], white[:, 3:]] if isinstance(o, FrameObservations) else [white]
    return np.array([max(float(np.mean(g**2)) / share, 1e-12) if g.size else 1.0 for g in groups])


def settled(factors: Sequence[Array]) -> bool:
    """Whether another round would not change the weights."""
    return all(bool(np.all(np.abs(f - 1.0) < ALIKE)) for f in factors)


def reweighted(
    observations: Sequence[RobotObservations], found: Component, stated: bool
) -> tuple[RobotObservations, ...]:
    """Observations with variances as the residuals show them.

    Of an instrument that states none, position and rotation of frames are told apart; one that states them keeps their
    ratios.
    """
    even = found.sigma0**2
    factors = [np.full(len(f), even) for f in found.factors] if stated else list(found.factors)
    return rescaled(observations, factors)
