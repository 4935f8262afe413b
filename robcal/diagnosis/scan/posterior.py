"""From a scan to names: posterior over causes, refinement of constants, rivals."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import optimize, special

from robcal.diagnosis.core.result import Rival
from robcal.diagnosis.scan.statistics import Entry, ScanResult, Stack, log_bayes_factor, stack_entries
from robcal.diagnosis.scan.tangents import Tangents
from robcal.physics.cause import Array, Constants, LinearCause

SAME_SIGNATURE = 0.98
"""Share of the named signature that a rival must reproduce to be called indistinguishable."""
SET_LEVEL = 0.99


@dataclass(frozen=True)
class Posterior:
    """Causes ranked by evidence.

    Attributes
    ----------
    log_weight : (f,) logarithm of evidence times prior weight, -inf where nothing can be seen.
    best_grid : (f,) grid point with the largest evidence.
    """

    log_weight: Array
    best_grid: Array

    def order(self) -> Array:
        """Causes from the most to the least probable."""
        return np.argsort(-self.log_weight, kind="stable")

    def probability(self, chosen: Array) -> Array:
        """Posterior of the causes where `chosen` (f,) is true, relative to these."""
        weight = np.where(chosen, self.log_weight, -np.inf)
        top = weight.max(initial=-np.inf)
        return np.exp(weight - special.logsumexp(weight)) if np.isfinite(top) else np.zeros(len(weight))


def posterior(causes: Sequence[LinearCause], result: ScanResult) -> Posterior:
    """Evidence of each cause, averaged over its grid."""
    count = len(causes)
    top = np.full(count, -np.inf)
    np.maximum.at(top, result.cause, result.log_evidence)
    seen = np.isfinite(top)
    above = result.log_evidence - np.where(seen, top, 0.0)[result.cause]
    total = np.bincount(result.cause, weights=np.exp(above), minlength=count)
    places = np.array([len(cause.grid) / cause.weight for cause in causes])
    log_weight = np.where(seen, top + np.log(np.where(seen, total, 1.0)) - np.log(places), -np.inf)
    best = np.zeros(count, dtype=int)
    first = np.flatnonzero(above == 0.0)[::-1]  # the first of equals is written last
    best[result.cause[first]] = result.grid[first]
    return Posterior(log_weight, np.where(seen, best, 0))


def refine(cause: LinearCause, constants: Constants, at: Tangents, fitted: Array, residual: Array) -> Constants:
    """Constants moved from their grid point to the best fit of the linearised problem: between the grid's values for
    continuous ones, among the neighbours for those of which the grid holds a part only."""
    for name, values in cause.ordered.items():
        constants = _nearby(cause, constants, name, values, at, fitted, residual)
    if not cause.continuous:
        return constants
    names = [name for name in cause.continuous if np.isfinite(constants[name])]

    def badness(logs: Array) -> float:
        trial = dict(constants)
        for name, value in zip(names, logs, strict=True):
            low, high = cause.continuous[name]
            trial[name] = float(np.clip(value if low <= 0 else np.exp(value), low, high))
        columns = at.columns(cause, trial) * cause.sizes(trial)
        (stack,) = stack_entries([Entry(0, 0, columns)], fitted)
        z = np.einsum("mc,m->c", stack.basis[0], residual)
        return -float(log_bayes_factor(stack.singular, z[None, :])[0])

    start = np.array([constants[n] if cause.continuous[n][0] <= 0 else np.log(constants[n]) for n in names])
    spread = np.array(
        [
            0.02 * (cause.continuous[n][1] - cause.continuous[n][0]) if cause.continuous[n][0] <= 0 else 0.3
            for n in names
        ]
    )
    simplex = np.vstack([start, start + np.diag(spread)])
    options: Any = {"initial_simplex": simplex, "maxfev": 40 * len(names), "xatol": 1e-3, "fatol": 1e-3}
    found: Any = optimize.minimize(badness, start, method="Nelder-Mead", options=options)
    if found.fun >= badness(start):
        return constants
    refined = dict(constants)
    for name, value in zip(names, found.x, strict=True):
        low, high = cause.continuous[name]
        refined[name] = float(np.clip(value if low <= 0 else np.exp(value), low, high))
    return refined


def _nearby(
    cause: LinearCause,
    constants: Constants,
    name: str,
    values: Sequence[float],
    at: Tangents,
    fitted: Array,
    residual: Array,
) -> Constants:
    tried = sorted(point[name] for point in cause.grid)
    here = tried.index(constants[name])
    low, high = tried[max(here - 1, 0)], tried[min(here + 1, len(tried) - 1)]
    trials = [dict(constants) | {name: v} for v in values if low < v < high]
    if len(tried) == len(values) or len(trials) < 2:
        return constants
    listed = [Entry(0, g, at.columns(cause, trial) * cause.sizes(trial)) for g, trial in enumerate(trials)]
    best, chosen = -np.inf, constants
    for stack in stack_entries(listed, fitted):
        evidence = log_bayes_factor(stack.singular, residual @ stack.basis)
        if float(evidence.max()) > best:
            best, chosen = float(evidence.max()), trials[int(stack.grid[int(np.argmax(evidence))])]
    return chosen


def signature(columns: Array, values: Array, fitted: Array) -> Array:
    """Whitened effect (m,) of amplitudes, projected out of what the fitted model absorbs."""
    effect = columns @ values
    return effect - fitted @ (fitted.T @ effect)


def overlap(stacks: Sequence[Stack], projected: Array, causes: int) -> tuple[Array, Array]:
    """Largest share of a projected signature that each cause can reproduce, and at which grid point."""
    share = np.zeros(causes)
    grid = np.zeros(causes, dtype=int)
    size = float(projected @ projected)
    if size == 0:
        return share, grid
    for stack in stacks:
        part = np.sum((projected @ stack.basis) ** 2, axis=1) / size
        for e in range(len(part)):
            if part[e] > share[stack.cause[e]]:
                share[stack.cause[e]], grid[stack.cause[e]] = part[e], stack.grid[e]
    return share, grid


def rivals(
    causes: Sequence[LinearCause],
    named: int,
    ranked: Posterior,
    stacks: Sequence[Stack],
    projected: Array,
    eligible: Array,
) -> tuple[Rival, ...]:
    """The rest of the 99 % set, and every eligible cause with (nearly) the same signature and a fair evidence."""
    probability = ranked.probability(eligible)
    share, share_grid = overlap(stacks, projected, len(causes))
    chosen: dict[int, int] = {}
    total = 0.0
    for f in np.argsort(-probability):
        if total >= SET_LEVEL or probability[f] <= 0:
            break
        total += float(probability[f])
        chosen[int(f)] = int(ranked.best_grid[f])
    for f in np.flatnonzero(eligible & (share > SAME_SIGNATURE)):
        if ranked.log_weight[f] > ranked.log_weight[named] - 7.0:
            chosen.setdefault(int(f), int(share_grid[f]))
    chosen.pop(named, None)
    found = [Rival(causes[f], causes[f].grid[g], float(probability[f]), float(share[f])) for f, g in chosen.items()]
    return tuple(sorted(found, key=lambda rival: -rival.probability))
