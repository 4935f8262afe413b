"""Which parameters, and their values: elimination of dependent ones, Gauss-Newton, choice of elasticities by evidence.

Whether a parameter is dependent is decided from the normal equations at a state, and again where the iteration ends,
since deviations make some parameters visible that are dependent at nominal (parallel axes), and hide others.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import linalg, special

from robcal.calibration.identifiability import Candidates, check_poses, choose_by_evidence, limit_rules, limits_at
from robcal.calibration.problem import Evaluator, Problem, State, whitening
from robcal.errors import NotIdentifiable
from robcal.estimation.dependence import Eliminated, split_dependent, with_ties
from robcal.estimation.gauss_newton import gauss_newton
from robcal.estimation.summary import SolveSummary, TerminationSettings

Array = NDArray[np.float64]

LATE_SHARE = 0.2
"""Share of the plausible sigma below which a parameter may enter that was dependent at the start values."""
PRIOR_SCALE = 5.0
"""Deviations that robots may have, as a standard deviation in units of the plausible ones."""
TRUST_SCALE = 2.5
"""Size of the trust region of the iteration, in units of the plausible deviations."""
MISFIT_LEVEL, MISFIT_SHARE = 1e-6, 0.25
"""Too much was eliminated if all candidates together would take more than this share off the expected sum of squares,
and that is no chance (p-value)."""


@dataclass(frozen=True)
class Solution:
    """Where the iteration ended, with which parameters, and what was left out why."""

    problem: Problem
    state: State
    names: tuple[str, ...]
    eliminated: dict[str, Eliminated]
    rejected: dict[str, float]
    first: SolveSummary
    summary: SolveSummary
    iterations: int


@dataclass(frozen=True)
class Normals:
    """Normal matrix (p, p), right side (p,) and sum of squares of the residuals."""

    N: Array
    b: Array
    sum_of_squares: float

    def shifted(self, back: Array) -> "Normals":
        """For residuals from which the linear effect of going back by ``back`` (p,) is taken: ``r + J back``."""
        turned = self.N @ back
        return Normals(self.N, self.b + turned, self.sum_of_squares + float(back @ (2.0 * self.b + turned)))


class Engine:
    """Elimination, iteration and choice for one set of data.

    Parameters
    ----------
    evaluator : kernel, poses and observations. choice : candidates in order of preference.
    joint_sigma, priors, termination : as in :class:`robcal.calibration.identification.IdentifyOptions`.
    """

    def __init__(
        self,
        evaluator: Evaluator,
        choice: Candidates,
        joint_sigma: float | Sequence[float] | None = None,
        priors: Mapping[str, float] | None = None,
        termination: TerminationSettings | None = None,
    ) -> None:
        self.evaluator, self.choice = evaluator, choice
        self.joint_sigma, self.termination = joint_sigma, termination or TerminationSettings()
        self.kernel, self.poses, self.stack = evaluator.kernel, evaluator.poses, evaluator.stack
        self.scatter, self.patience = 1.0, 1.0
        self._whitened: tuple[State, Array] | None = None
        self._normals: tuple[State, Array, Normals] | None = None
        self._rules = limit_rules(self.kernel.model, choice.names)
        self._at = {name: k for k, name in enumerate(choice.names)}
        self.priors = {evaluator.index[name]: s for name, s in (priors or {}).items()}

    def columns(self, names: Sequence[str]) -> list[int]:
        return [self.evaluator.index[n] for n in names]

    def problem(self, state: State, names: Sequence[str], weights: Array) -> Problem:
        if self._whitened is None or self._whitened[0] is not state:
            self._whitened = (state, whitening(self.evaluator, state, self.joint_sigma))
        return Problem(self.evaluator, self.columns(names), self._whitened[1], weights, self.priors)

    def solve(self, state: State, weights: Array, names: Sequence[str] | None = None) -> Solution:
        """Eliminate, iterate, and look again at the solution whether the elimination still holds."""
        names = (*self.choice.forced, *self.choice.own_axis) if names is None else tuple(names)
        iterations = 0
        first: SolveSummary | None = None
        best: tuple[float, Solution] | None = None
        rows = self._rows(weights)
        kept, eliminated = self._eliminate(state, names, weights)
        for round_ in range(4):
            problem = self.problem(state, kept, weights)
            state, summary = gauss_newton(
                problem.linearise,
                problem.residuals,
                problem.retract,
                state,
                self.termination,
                TRUST_SCALE * self._plausible(state, kept),
            )
            iterations += summary.iterations
            first = summary if first is None else first
            self.scatter, least, free = self._with_all(state, names, weights)
            # What looks weak where it is linearised may matter further on: no look may make the fit worse than the
            # parameters that it saves are worth (Bayesian information criterion).
            worth = self._worth(summary.cost, len(kept), rows)
            worse = best is not None and worth > best[0]
            if best is None or not worse:
                best = (worth, Solution(problem, state, tuple(kept), eliminated, {}, first, summary, iterations))
            gain = (2.0 * best[1].summary.cost - least) / self.scatter**2
            left_out = max(1.0, free - len(best[1].names))
            strict = gain > MISFIT_SHARE * rows and special.chdtrc(left_out, gain) < MISFIT_LEVEL
            if round_ == 3 or (worse and not strict):
                break
            if strict and round_ > 0:  # something that matters was left out as weak: look again with more patience
                self.patience *= 10.0
                state = best[1].state
                kept, eliminated = self._eliminate(state, names, weights)
                continue
            # Deviations make some parameters visible that are dependent at nominal (parallel axes), and hide others.
            # Only the first look adds any; later ones only take away, so nothing can go round in circles.
            again, eliminated = self._eliminate(state, names if round_ == 0 else kept, weights, eliminated)
            if again == kept and strict:
                self.patience *= 10.0
                again, eliminated = self._eliminate(state, names, weights)
            if again == kept:
                best = (worth, replace(best[1], eliminated=eliminated))
                break
            lost = [n for n in kept if n not in again and not n.startswith(("base.", "tool."))]
            if lost:
                state = self._reset(state, lost)
            kept = again
        if best is None:
            raise NotIdentifiable("the iteration ended before its first step", kept)
        return replace(best[1], iterations=iterations)

    def choose(self, solution: Solution, weights: Array) -> Solution:
        """Choose among the elasticities at a solution and iterate with those that stay."""
        own, cross = self.choice.own_axis, self.choice.cross_axis
        forced = [n for n in solution.names if n not in own]
        names = (*forced, *own, *cross)
        normals = self.normals(solution.state, names, weights)
        current = np.array([solution.state.theta[self.evaluator.index[n]] for n in (*own, *cross)])
        at_zero = normals.shifted(np.concatenate([np.zeros(len(forced)), current]))  # optional parameters at zero
        keep, _ = split_dependent(normals.N, names, self._limits(solution.state, names), ties=False)
        optional = [k for k in keep if k >= len(forced)]
        chosen_from = [*range(len(forced)), *optional]
        n_own = sum(1 for k in optional if k < len(forced) + len(own))
        rows = self._rows(weights)
        N = at_zero.N[np.ix_(chosen_from, chosen_from)]
        picked = choose_by_evidence(N, at_zero.b[chosen_from], at_zero.sum_of_squares, rows, len(forced), n_own)
        taken = [names[optional[k]] for k in picked.taken]
        rejected = {names[k]: float(p) for k, p in zip(optional, picked.p_values, strict=True) if names[k] not in taken}
        state = self._moved(solution.state, (*forced, *taken), (*own, *cross), names, at_zero)
        gone = {n: e for n, e in solution.eliminated.items() if n not in taken}
        if set(taken) == set(solution.names) - set(forced):
            final = solution
        else:
            final = self.solve(state, weights, (*forced, *taken))
            final = replace(final, eliminated={**gone, **final.eliminated})
            if self._worth(final.summary.cost, len(final.names), rows) > self._worth(
                solution.summary.cost, len(solution.names), rows
            ):
                final = solution
        iterations = solution.iterations + (final.iterations if final is not solution else 0)
        return replace(final, rejected=rejected, first=solution.first, iterations=iterations)

    def _moved(
        self, state: State, names: Sequence[str], zeroed: Sequence[str], all_names: Sequence[str], normals: Normals
    ) -> State:
        """Where the linear problem with the chosen names puts the state, those of ``zeroed`` counted from zero."""
        at = [all_names.index(n) for n in names]
        size = np.sqrt(np.maximum(np.diag(normals.N)[at], 1e-300))
        try:
            factor = linalg.cho_factor(normals.N[np.ix_(at, at)] / np.outer(size, size), check_finite=False)
        except linalg.LinAlgError:
            return self._reset(state, [n for n in zeroed if n not in names])
        step = linalg.cho_solve(factor, normals.b[at] / size, check_finite=False) / size
        return Problem(self.evaluator, self.columns(names), np.zeros(0)).retract(self._reset(state, zeroed), step)

    def _reset(self, state: State, names: Sequence[str]) -> State:
        theta = state.theta.copy()
        theta[self.columns(names)] = self.evaluator.theta0[self.columns(names)]
        elastic = [k for n, k in zip(names, self.columns(names), strict=True) if ".elastic_" in n]
        theta[elastic] = 0.0
        return State(theta, state.world_T_base, state.flange_T_tool)

    def _worth(self, cost: float, parameters: int, rows: int) -> float:
        """Bayesian information criterion, in units of the data's own scatter; the smaller the better."""
        return 2.0 * cost / self.scatter**2 + parameters * float(np.log(max(2, rows)))

    def _with_all(self, state: State, names: Sequence[str], weights: Array) -> tuple[float, float, float]:
        """What a fit with all candidates would leave: sigma0 (one at least), sum of squares, parameters used.

        With all candidates, also the dependent ones, or a parameter left out too early would make the data look so bad
        that it could not come back. Only by deviations that robots have, though: what is missing in the model can
        always be imitated by enormous ones that nearly cancel. The first says how far the stated covariance can be
        trusted.
        """
        normals = self.normals(state, names, weights)
        size = PRIOR_SCALE * self._plausible(state, names)
        wide = ~np.isfinite(size)
        size[wide] = 1.0 / np.sqrt(np.maximum(np.diag(normals.N)[wide], 1e-300))
        scaled = normals.N * np.outer(size, size)
        factor = linalg.cho_factor(scaled + np.diag(np.where(wide, 1e-10, 1.0)), lower=True, check_finite=False)
        b = normals.b * size
        left = max(0.0, normals.sum_of_squares - float(b @ linalg.cho_solve(factor, b, check_finite=False)))
        used = float(np.trace(linalg.cho_solve(factor, scaled, check_finite=False)))
        return max(1.0, float(np.sqrt(left / max(1.0, self._rows(weights) - used)))), left, used

    def _rows(self, weights: Array) -> int:
        """Measured numbers of the poses that are not left out."""
        return int(weights.astype(bool) @ self.stack.used.sum(axis=1))

    def normals(self, state: State, names: Sequence[str], weights: Array) -> Normals:
        """Normal equations of some candidates at a state; those of all of them are made once a state."""
        if self._normals is None or self._normals[0] is not state or self._normals[1] is not weights:
            whitener = self.problem(state, (), weights).whitener
            r, J = Problem(self.evaluator, self.columns(self.choice.names), whitener).linearise(state)
            self._normals = (state, weights, Normals(J.T @ J, J.T @ r, float(r @ r)))
        every = self._normals[2]
        at = [self._at[n] for n in names]
        N, b, square = every.N[np.ix_(at, at)], every.b[at], every.sum_of_squares
        off = self.evaluator.deviations(state) if self.priors else state.theta
        for k, column in enumerate(self.columns(names) if self.priors else ()):
            if column in self.priors:
                sigma, value = self.priors[column], off[column]
                N[k, k] += sigma**-2
                b[k] -= value * sigma**-2
                square += (value / sigma) ** 2
        return Normals(N, b, square)

    def _plausible(self, state: State, names: Sequence[str]) -> Array:
        at = [self._at[n] for n in names]
        return limits_at(self._rules[0][at], self._rules[1][at], self.evaluator(state).moments)

    def _limits(self, state: State, names: Sequence[str]) -> Array:
        return self._plausible(state, names) * (self.patience / self.scatter)

    def tied(self, solution: Solution, weights: Array) -> dict[str, Eliminated]:
        """What was eliminated, each with the parameters of the solution that do the same."""
        gone = list(solution.eliminated.values())
        names = [*solution.names, *(e.name for e in gone)]
        N = self.normals(solution.state, names, weights).N
        return {e.name: e for e in with_ties(N, names, len(solution.names), gone)}

    def _eliminate(
        self, state: State, names: Sequence[str], weights: Array, before: Mapping[str, Eliminated] | None = None
    ) -> tuple[list[str], dict[str, Eliminated]]:
        """Names that stay, in order, and all that were eliminated, those of ``before`` included."""
        limits = self._limits(state, names)
        if before is not None:
            # what enters late lies in a curved valley: only if the data say much more about it than was known
            limits = np.where([n in before for n in names], LATE_SHARE * limits, limits)
        kept, gone = split_dependent(self.normals(state, names, weights).N, names, limits, ties=before is not None)
        if not kept:
            raise NotIdentifiable("the measurements do not depend on any parameter of the robot", names)
        stay = [names[k] for k in kept]
        check_poses(self.poses.q, self._rows(weights) + len(self.priors), stay)
        old = {n: e for n, e in (before or {}).items() if n not in stay}
        return stay, old | {e.name: e for e in gone}
