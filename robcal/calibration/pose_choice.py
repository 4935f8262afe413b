"""Which of many candidate poses to measure: equidistant in joint space, or by what they tell about the robot.

The information of a pose on the parameters is ``J' W J`` with J the twist of the tool per parameter and W the
information of the measured frame. Parameters have a prior of the size that is plausible for them, so that a design is
comparable before everything is determined (Bayesian D-optimality: Chaloner and Verdinelli 1995). Greedy addition and
exchange (Fedorov 1972) after that.
"""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from robcal.transforms import Array

Progress = Callable[[int, float], bool]
"""Called with the number of poses and the predicted error; False ends the addition."""


@dataclass(frozen=True)
class Design:
    """A problem of choice.

    Attributes
    ----------
    rows : (n, 6, p) whitened twist of the tool per parameter at each candidate (``W^(1/2) J``), scaled by the priors.
    checks : (m, 3, p) displacement of the tool's test points per (scaled) parameter where accuracy is wanted, m.
    """

    rows: Array
    checks: Array = field(repr=False)

    @property
    def n_parameters(self) -> int:
        """Number of parameters."""
        return int(self.rows.shape[2])


def spread(q: Array, ranges: Array, count: int, start: int = 0) -> NDArray[np.int_]:
    """Equidistant in joint space: each next candidate is the one farthest from all chosen (Gonzalez 1985).

    ``ranges`` (N,) weighs the joints.
    """
    scaled = q / ranges
    chosen = [start]
    distance = np.linalg.norm(scaled - scaled[start], axis=1)
    while len(chosen) < min(count, len(q)):
        following = int(np.argmax(distance))
        if distance[following] <= 0:
            break
        chosen.append(following)
        distance = np.minimum(distance, np.linalg.norm(scaled - scaled[following], axis=1))
    return np.array(chosen)


def covariance_of(design: Design, chosen: NDArray[np.int_] | list[int]) -> Array:
    """Covariance (p, p) of the scaled parameters after measuring the chosen candidates; the prior alone for none."""
    rows = design.rows[np.asarray(chosen, dtype=int)].reshape(-1, design.n_parameters)
    return np.linalg.inv(np.eye(design.n_parameters) + rows.T @ rows)


def predicted_errors(design: Design, covariance: Array) -> Array:
    """Predicted standard deviation (m,) of each test point's distance error: root of the trace of its covariance."""
    return np.sqrt(np.einsum("mip,pq,miq->m", design.checks, covariance, design.checks))


def choose_d_optimal(
    design: Design, count: int, *, progress: Progress | None = None, repeats: bool = False
) -> list[int]:
    """Greedy D-optimal choice: each next pose shrinks the parameters' volume most."""

    def score(covariance: Array) -> Array:
        return _volume_gain(design.rows, covariance)

    return _greedy(design, count, score, progress, repeats)


def choose_worst_case(
    design: Design, count: int, *, progress: Progress | None = None, repeats: bool = False
) -> list[int]:
    """Greedy choice by the tool: each next pose reduces the sum of the worst tenth of predicted variances most."""

    def score(covariance: Array) -> Array:
        errors = predicted_errors(design, covariance)
        worst = np.argsort(errors)[-max(1, len(errors) // 10) :]
        checks = design.checks[worst].reshape(-1, design.n_parameters)
        spread_rows = design.rows @ covariance  # (n, 6, p)
        inner = np.linalg.inv(spread_rows @ np.swapaxes(design.rows, 1, 2) + np.eye(6))
        cross = spread_rows @ checks.T  # (n, 6, checks)
        return np.einsum("nic,nij,njc->n", cross, inner, cross)

    return _greedy(design, count, score, progress, repeats)


def exchange(design: Design, chosen: list[int], *, passes: int = 2) -> list[int]:
    """Exchange poses for better ones by D-optimality while that gains; the number stays."""
    current = list(chosen)
    if len(current) < 2:
        return current
    for _ in range(passes):
        improved = False
        for place in range(len(current)):
            without = current[:place] + current[place + 1 :]
            covariance = covariance_of(design, without)
            gain = _volume_gain(design.rows, covariance)
            own = gain[current[place]]
            gain[without] = -np.inf
            best = int(np.argmax(gain))
            if gain[best] > own + 1e-9:
                current[place] = best
                improved = True
        if not improved:
            break
    return current


def _volume_gain(rows: Array, covariance: Array) -> Array:
    """Growth (n,) of the log determinant of the information by each candidate."""
    return np.asarray(np.linalg.slogdet(np.eye(6) + rows @ covariance @ np.swapaxes(rows, 1, 2))[1])


def _greedy(
    design: Design, count: int, score: Callable[[Array], Array], progress: Progress | None, repeats: bool
) -> list[int]:
    covariance = np.eye(design.n_parameters)
    chosen: list[int] = []
    for _ in range(min(count, len(design.rows)) if not repeats else count):
        values = score(covariance)
        if not repeats:
            values[chosen] = -np.inf
        best = int(np.argmax(values))
        chosen.append(best)
        # Woodbury: six rows more
        row = design.rows[best]
        half = covariance @ row.T
        covariance = covariance - half @ np.linalg.solve(np.eye(6) + row @ half, half.T)
        covariance = 0.5 * (covariance + covariance.T)
        if progress is not None and not progress(len(chosen), float(np.max(predicted_errors(design, covariance)))):
            break
    return chosen
