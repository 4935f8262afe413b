"""Gauss-Newton with halving line search, dependent parameters, covariance and redundancy of a whitened problem.

A problem is linearised at a state as whitened residuals ``r = measured - model`` (m,) and Jacobian
``J = d model / d step`` (m, p), so a step solves ``min |r - J step|``. The state may be anything that a step can move
(an array, a frame, a network).
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy import linalg, special

from robcal.errors import InvalidInput

Array = NDArray[np.float64]
State = TypeVar("State")

RELEASE = 4.0
"""Factor by which steps may grow after one that lowered the cost as foreseen, or shrink after a halved one."""
RELATIVE_PIVOT = 1e-11  # squared; below this a column is numerically a combination of others


@dataclass(frozen=True)
class TerminationSettings:
    """When to stop.

    Attributes
    ----------
    max_iterations : Gauss-Newton steps at most.
    max_halvings : halvings of one step at most.
    cost_tolerance : stop when a step lowers, or promises to lower, half the sum of squares by less than this fraction
        of it (plus the same fraction of one),
    negligible : or by less than this, for whitened residuals: 1e-4 are 0.014 standard deviations of one parameter.
    """

    max_iterations: int = 30
    max_halvings: int = 12
    cost_tolerance: float = 1e-8
    negligible: float = 0.0


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


def solve_step(r: Array, J: Array, usual: Array | None = None) -> Array:
    """Least-squares step (p,) by scaled normal equations; by the pseudo-inverse where they are singular.

    ``usual`` (p,): sizes that steps have; a step in units of these counts like a measured residual.
    """
    scale = np.linalg.norm(J, axis=0)
    scale[scale == 0] = 1.0
    scaled = J / scale
    N, b = scaled.T @ scaled, scaled.T @ r
    if usual is not None:
        N[np.diag_indices_from(N)] += 1.0 / (usual * scale) ** 2
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
    settings: TerminationSettings = TerminationSettings(),
    usual: Array | None = None,
) -> tuple[State, SolveSummary]:
    """Minimise ``|r|^2`` by Gauss-Newton steps, halved until the cost falls (thesis section 5.2).

    Parameters
    ----------
    linearise : whitened residuals (m,) and Jacobian (m, p) at a state.
    residuals : the residuals alone, for the line search.
    retract : moves a state by a step (p,).
    start : first state.
    settings : termination.
    usual : (p,) sizes that steps have, or None. Where the data leave a direction nearly open (almost parallel axes), a
        full step would follow it beyond all linearity; one damped by these sizes does not (Levenberg 1944).

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

    room = 1.0
    for _ in range(settings.max_iterations):
        step = solve_step(r, J, None if usual is None else room * usual)
        predicted = J @ step
        promise = float(r @ predicted - 0.5 * predicted @ predicted)
        small = max(settings.cost_tolerance * (1.0 + cost), settings.negligible)
        if promise <= small:
            return state, summary(True, "a further step would not lower the cost")
        length = 1.0
        for _ in range(settings.max_halvings + 1):
            candidate = retract(state, length * step)
            trial = residuals(candidate)
            new_cost = 0.5 * float(trial @ trial)
            if np.isfinite(new_cost) and new_cost < cost:
                break
            length *= 0.5
            halvings += 1
        else:
            near = promise <= 1e-3 + 1e-6 * cost  # a few hundredths of a standard deviation
            return state, summary(near, "no fraction of the step lowers the cost")
        gained, state, cost = cost - new_cost, candidate, new_cost
        # as long as steps keep their promise the damping fades, and the last ones are undamped
        room = room * RELEASE if gained > 0.75 * promise else room if length == 1.0 else room / RELEASE
        history.append(cost)
        if gained <= small and length == 1.0:
            return state, summary(True, "the last step lowered the cost by less than the tolerance")
        r, J = linearise(state)
    return state, summary(False, f"stopped after {settings.max_iterations} iterations")


@dataclass(frozen=True)
class Eliminated:
    """A parameter that the data cannot tell apart.

    Attributes
    ----------
    name : of the parameter.
    reason : 'no influence', 'dependent' (a combination of others does the same), or 'weak' (its sigma would exceed what
        is plausible, so the data say nothing that was not known).
    tied_to : change of other parameters that does the same as one unit of this one; empty for no influence.
    sigma : standard deviation it would have with the others free (infinite where dependent).
    """

    name: str
    reason: str
    tied_to: Mapping[str, float]
    sigma: float


def split_dependent(
    N: Array,
    names: Sequence[str],
    limits: Array | None = None,
    relative_pivot: float = RELATIVE_PIVOT,
    ties: bool = True,
) -> tuple[list[int], list[Eliminated]]:
    """Walk through the parameters in the given order; keep those that the ones kept so far cannot replace.

    Cholesky with elimination where a pivot vanishes (thesis section 5.3), here also where the pivot, the information
    that is left, is too small for the plausible size of the parameter.

    Parameters
    ----------
    N : normal matrix (p, p) of whitened columns, in order of preference.
    names : names (p,).
    limits : largest sigma (p,) worth keeping; None for no such limit.
    relative_pivot : pivot over diagonal below which a column counts as dependent.
    ties : find out what the eliminated ones are tied to (else ``tied_to`` stays empty).

    Returns
    -------
    kept : indices in the order given.
    eliminated : the others with what they are tied to.
    """
    p = len(names)
    diagonal = np.diag(N).copy()
    largest = float(diagonal.max(initial=0.0))
    scale = np.sqrt(np.where(diagonal > 0, diagonal, 1.0))
    scaled = N / np.outer(scale, scale)
    kept: list[int] = []
    dropped: list[tuple[int, str, float]] = []
    floor = np.zeros(p) if limits is None else 1.0 / (np.asarray(limits) * scale) ** 2
    if p and largest > 0 and np.all(diagonal > 1e-30 * largest):
        factor, failed = linalg.lapack.dpotrf(scaled, lower=1)
        if not failed and np.all(np.diag(factor) ** 2 > np.maximum(relative_pivot, floor)):
            kept = list(range(p))
    rows = np.zeros((p, p), order="F")  # transposed Cholesky factor of the columns kept, grown column by column
    for k in range(0 if not kept else p, p):
        m = len(kept)
        if diagonal[k] <= 1e-30 * largest or diagonal[k] == 0.0:
            dropped.append((k, "no influence", np.inf))
            continue
        part = scaled[kept, k]
        if m:
            part = linalg.blas.dtrsv(rows[:m, :m], part, trans=1)
        pivot = float(scaled[k, k] - part @ part)
        if pivot <= relative_pivot:
            dropped.append((k, "dependent", np.inf))
            continue
        if pivot < floor[k]:
            dropped.append((k, "weak", float(1.0 / np.sqrt(pivot) / scale[k])))
            continue
        rows[:m, m], rows[m, m] = part, np.sqrt(pivot)
        kept.append(k)
    eliminated = []
    if limits is not None:
        kept, weak = _drop_weak_directions(N, kept, np.asarray(limits))
        dropped += weak
    if dropped and not ties:
        return kept, [Eliminated(names[k], reason, {}, sigma) for k, reason, sigma in dropped]
    if dropped:
        Nk = N[np.ix_(kept, kept)] / np.outer(scale[kept], scale[kept])
        right = N[np.ix_(kept, [k for k, _, _ in dropped])] / scale[kept][:, None]
        shares = linalg.lstsq(Nk, right, cond=1e-14)[0] if kept else np.zeros((0, len(dropped)))
        for column, (k, reason, sigma) in enumerate(dropped):
            share = shares[:, column] / scale[k]  # in units of column norms: comparable between metres and radians
            strong = np.flatnonzero(np.abs(share) > 0.02 * max(1e-300, np.abs(share).max(initial=0.0)))
            tied = (
                {}
                if reason == "no influence"
                else {names[kept[s]]: float(shares[s, column] / scale[kept[s]]) for s in strong}
            )
            eliminated.append(Eliminated(names[k], reason, tied, sigma))
    return kept, eliminated


def _drop_weak_directions(N: Array, kept: list[int], limits: Array) -> tuple[list[int], list[tuple[int, str, float]]]:
    """Drop parameters until none has a sigma, with all others free, above what is plausible.

    Each may be well determined given those before it, and yet a mixture of many be open: then the last of them in the
    order of preference goes, whose fixing costs nothing since its own sigma is above its plausible size.
    """
    dropped: list[tuple[int, str, float]] = []
    kept = list(kept)
    while True:
        bounded = [k for k in kept if np.isfinite(limits[k])]
        free = [k for k in kept if not np.isfinite(limits[k])]
        if not bounded:
            return kept, dropped
        M = N[np.ix_(bounded, bounded)]
        if free:
            across = N[np.ix_(free, bounded)]
            M = M - across.T @ linalg.lstsq(N[np.ix_(free, free)], across, cond=1e-14)[0]
        scaled = M * np.outer(limits[bounded], limits[bounded])
        factor, failed = linalg.lapack.dpotrf(scaled, lower=1)
        if not failed:
            inverse = linalg.lapack.dtrtri(factor, lower=1)[0]
            if np.einsum("ij,ij->j", inverse, inverse).max() < 1.0:
                return kept, dropped
        values, vectors = linalg.eigh(scaled, check_finite=False)
        sigma = np.sqrt(np.sum(vectors**2 / np.maximum(values, 1e-14 * values[-1]), axis=1))
        if sigma.max() < 1.0:
            return kept, dropped
        last = int(np.flatnonzero(sigma >= max(1.0, 0.3 * sigma.max()))[-1])
        dropped.append((bounded[last], "weak", float(sigma[last] * limits[bounded[last]])))
        kept.remove(bounded[last])


@dataclass(frozen=True)
class LinearStatistics:
    """What a whitened Jacobian tells about the estimate.

    Attributes
    ----------
    cofactor : (p, p) inverse of the normal matrix: covariance for unit variance of the whitened residuals.
    condition : of the Jacobian with columns of unit length.
    condition_raw : of the Jacobian in SI units.
    correlations : (p, p).
    singular_values : of the Jacobian in SI units divided by sqrt(rows), largest first.
    """

    cofactor: Array
    condition: float
    condition_raw: float
    correlations: Array
    singular_values: Array


def cofactor(J: Array) -> Array:
    """Inverse (p, p) of the normal matrix of a Jacobian (m, p) of full column rank, by QR of unit columns."""
    return np.zeros((0, 0)) if J.shape[1] == 0 else _inverse_normal(*_triangle(J))


def linear_statistics(J: Array) -> LinearStatistics:
    """Cofactor matrix, condition numbers and correlations of a whitened Jacobian (m, p) of full column rank."""
    if J.shape[1] == 0:
        empty = np.zeros((0, 0))
        return LinearStatistics(empty, 1.0, 1.0, empty, np.zeros(0))
    R, scale = _triangle(J)
    values = linalg.svdvals(R, check_finite=False)
    raw = linalg.svdvals(R * scale, check_finite=False)
    inverse = _inverse_normal(R, scale)
    sigma = np.sqrt(np.diag(inverse))
    return LinearStatistics(
        inverse,
        float(values[0] / values[-1]),
        float(raw[0] / raw[-1]),
        inverse / np.outer(sigma, sigma),
        raw / np.sqrt(len(J)),
    )


def _triangle(J: Array) -> tuple[Array, Array]:
    """Triangular factor (p, p) of a Jacobian with columns of unit length, and their lengths (p,)."""
    scale = np.linalg.norm(J, axis=0)
    return linalg.qr(J / scale, mode="r", check_finite=False)[0][: J.shape[1]], scale


def _inverse_normal(R: Array, scale: Array) -> Array:
    inverse = linalg.lapack.dtrtri(R)[0]
    return np.asarray((inverse @ inverse.T) / np.outer(scale, scale))


def global_test(cost: float, redundancy: int) -> tuple[float, float]:
    """sigma0 and the p-value of a residual sum as large or larger (chi-square) if the stated covariance holds."""
    if redundancy <= 0:
        return 1.0, 1.0
    return float(np.sqrt(2.0 * cost / redundancy)), float(special.chdtrc(redundancy, 2.0 * cost))
