"""Identification of a robot from any mixture of observations.

Start values by construction, whitening with the measured covariances, Gauss-Newton with halving line search, named
elimination of dependent parameters, choice of elasticities by evidence, outlier poses, covariance and diagnostics.
Sources: thesis chapter 5 for objective and solver; adjustment statistics after Foerstner and Wrobel (2016), chapter 4.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy import special

from robcal import transforms as tf
from robcal.calibration.identifiability import (
    Candidates,
    check_poses,
    choose_by_evidence,
    choose_candidates,
    observability_indices,
    plausible_limits,
)
from robcal.calibration.observations import FrameObservations, Observations, Stack, basis_points
from robcal.calibration.problem import CellEvaluator, Evaluator, Problem, State, whitening
from robcal.calibration.start_values import candidates
from robcal.errors import InvalidInput, NotIdentifiable
from robcal.least_squares import (
    Eliminated,
    SolveSummary,
    TerminationSettings,
    gauss_newton,
    global_test,
    linear_statistics,
    split_dependent,
)
from robcal.robot.kernel import Kernel, PoseInputs
from robcal.robot.model import RobotModel

Array = NDArray[np.float64]

LATE_SHARE = 0.2
"""Share of the plausible sigma below which a parameter may enter that was dependent at the start values."""
MISFIT = 1.5
"""Sum of squares over that of all candidates together above which the elimination was too strict."""
OUTLIER_LEVEL = 1e-3
"""Probability that the largest of all poses is called an outlier by chance."""
OUTLIER_SHARE = 0.15
"""More suspicious poses than this share are no outliers but a misfit of the model: all are kept."""


@dataclass(frozen=True)
class IdentifyOptions:
    """How to identify.

    Attributes
    ----------
    parameters : 'standard', 'geometry', 'table5.4' or a list of names; base, tool and terms are always added.
    robust : leave out single poses that contradict all others (and report them).
    objective : 'maximum_likelihood' (whitened with the measured covariance) or 'basis' (the thesis' norm).
    statics : 'one_step' or 'converged'.
    joint_sigma : repeatability of the joints, rad or m, one number or one a joint; adds to the covariances.
    priors : standard deviations (around zero) by parameter name, for those that have one.
    covariance : 'stated' (as measured), 'estimated' (times sigma0 squared), or 'auto': estimated if the residuals
        contradict the stated covariance (chi-square, 1 %), or if there is none worth the name.
    termination : of the Gauss-Newton iteration.
    """

    parameters: str | Sequence[str] = "standard"
    robust: bool = True
    objective: Literal["maximum_likelihood", "basis"] = "maximum_likelihood"
    statics: Literal["one_step", "converged"] = "one_step"
    joint_sigma: float | Sequence[float] | None = None
    priors: Mapping[str, float] = field(default_factory=dict)
    covariance: Literal["auto", "stated", "estimated"] = "auto"
    termination: TerminationSettings = field(default_factory=TerminationSettings)


@dataclass(frozen=True)
class IdentifiedRobot:
    """A calibrated robot and what is known about it.

    Attributes
    ----------
    model : parameters filled, references of base and tool set (their deviations folded in).
    names, theta, covariance : identified parameters (p,), values, and covariance (p, p) after scaling; those of base
        and tool are right perturbations of the references.
    covariance_scale : factor applied to the covariance (sigma0 squared or one).
    sigma0, redundancy, p_value : root of the whitened sum of squares over redundancy, and its chi-square test.
    eliminated : by name, why a candidate was not identified and what it is tied to.
    rejected_elasticities : p-values of the elasticities for which the data show no evidence.
    condition, condition_raw, correlations, observability : gauges of the poses.
    residuals : (n, D) whitened residuals by pose; normalised : (n,) their studentised norm per degree of freedom
        (near one); leverage : (n,) share of a pose's rows in its own prediction; redundancy_numbers : (n,).
    outliers : rows of poses left out; used : (n,) mask of the others.
    first_summary, summary : of the first iteration (from the start values) and of the last one, after the choice of
        parameters; iterations counts all Gauss-Newton steps; seconds : kernel, start and solution.
    """

    model: RobotModel
    kernel: Kernel
    names: tuple[str, ...]
    theta: Array
    covariance: Array
    covariance_scale: float
    sigma0: float
    redundancy: int
    p_value: float
    eliminated: Mapping[str, Eliminated]
    rejected_elasticities: Mapping[str, float]
    condition: float
    condition_raw: float
    correlations: Array
    observability: Mapping[str, float]
    residuals: Array
    normalised: Array
    leverage: Array
    redundancy_numbers: Array
    outliers: tuple[int, ...]
    used: NDArray[np.bool_]
    options: IdentifyOptions
    first_summary: SolveSummary
    summary: SolveSummary
    iterations: int
    seconds: float
    seconds_kernel: float

    @property
    def sigma(self) -> Array:
        """Standard deviations (p,)."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def values(self) -> dict[str, float]:
        """Identified values by name; base and tool are zero, their values live in the references."""
        return dict(zip(self.names, self.theta.tolist(), strict=True))

    @property
    def columns(self) -> NDArray[np.intp]:
        """Indices of the identified parameters in the kernel's theta."""
        return np.array([self.kernel.index[n] for n in self.names], dtype=np.intp)

    @property
    def full_theta(self) -> Array:
        """All parameters of the kernel."""
        return self.kernel.theta0

    def strong_correlations(self, level: float = 0.95) -> list[tuple[str, str, float]]:
        """Pairs of parameters correlated more than ``level``, strongest first."""
        upper = np.triu(np.abs(self.correlations) > level, 1)
        pairs = [(self.names[i], self.names[j], float(self.correlations[i, j])) for i, j in np.argwhere(upper)]
        return sorted(pairs, key=lambda t: -abs(t[2]))


def identify(
    model: RobotModel,
    poses: PoseInputs,
    observations: Sequence[Observations],
    options: IdentifyOptions = IdentifyOptions(),
    kernel: Kernel | None = None,
) -> IdentifiedRobot:
    """Identify a robot with its base and tool.

    Parameters
    ----------
    model : the robot; its parameters are start values. Base and tool references need not be given.
    poses : from :meth:`Kernel.poses` of a kernel of the same model.
    observations : any operators of :mod:`robcal.calibration.observations`.
    kernel : reuse one that was built for this very model and statics.

    Raises
    ------
    InvalidInput : nothing measured, or unknown names.
    NotIdentifiable : fewer measurements than parameters of base and tool, or no start values can be constructed.
    """
    clock = time.perf_counter()
    if kernel is None or kernel.model is not model or kernel.statics != options.statics:
        kernel = Kernel(model, options.statics)
        kernel.function("jacobian")
    seconds_kernel = time.perf_counter() - clock
    if options.objective == "basis":
        as_points: list[Observations] = []
        for o in observations:
            if isinstance(o, FrameObservations):
                as_points.append(basis_points(o))
            else:
                as_points.append(o)
        observations = as_points
    stack = Stack(observations, len(poses))
    check_poses(poses.q, stack.rows, ())
    evaluator = Evaluator(kernel, poses, stack)
    state = start_state(evaluator, observations)
    choice = choose_candidates(model, options.parameters)
    for name in (*choice.names, *options.priors):
        if name not in kernel.index:
            raise InvalidInput(f"robot '{model.name}' has no parameter '{name}'")

    engine = _Engine(evaluator, options, choice)
    outliers: list[int] = []
    weights = np.ones(len(poses))
    first = engine.solve(state, weights)
    if options.robust:
        suspects = _outliers(first, stack)
        if suspects:
            outliers, weights, first = _without_outliers(engine, first.state, suspects, stack)
    final = engine.choose(first, weights) if choice.own_axis or choice.cross_axis else first
    return _result(engine, final, weights, outliers, clock, seconds_kernel)


def start_state(evaluator: Evaluator, observations: Sequence[Observations]) -> State:
    """State with the kernel's own parameters and base and tool constructed from the data; the best of all candidates.

    Raises
    ------
    NotIdentifiable : nothing can be constructed and the model gives no references.
    """
    kernel = evaluator.kernel
    cell = CellEvaluator(evaluator)
    theta = cell.theta
    pairs = candidates(cell.base_T_flange, observations)
    if kernel.model.world_T_base is not None and kernel.model.flange_T_tool is not None:
        given = kernel.theta0
        pairs.append((
            kernel.world_T_base @ tf.frame_from_xyzrpy(given[cell.base]),
            kernel.flange_T_tool @ tf.frame_from_xyzrpy(given[cell.tool]),
        ))
    if not pairs:
        raise NotIdentifiable(
            "no start values for base and tool can be constructed: measure at least 3 poses in 6D, 4 poses with one "
            "target, or give world_T_base and flange_T_tool in the robot file",
            ("base", "tool"),
        )
    if len(pairs) == 1:
        return State(theta, *pairs[0])
    best: tuple[float, State] | None = None
    for pair in pairs:
        state = State(theta, *pair)
        problem = Problem(cell, [*cell.base, *cell.tool], whitening(cell, state))
        try:
            state, summary = gauss_newton(
                problem.linearise, problem.residuals, problem.retract, state, TerminationSettings(15, 6, 1e-3)
            )
        except InvalidInput:
            continue
        if best is None or summary.cost < best[0]:
            best = (summary.cost, state)
    if best is None:
        raise NotIdentifiable("none of the constructed start values fits the measurements", ("base", "tool"))
    return best[1]


@dataclass(frozen=True)
class _Solution:
    problem: Problem
    state: State
    names: tuple[str, ...]
    eliminated: dict[str, Eliminated]
    rejected: dict[str, float]
    first: SolveSummary
    summary: SolveSummary
    iterations: int


class _Engine:
    """Elimination, iteration and choice for one set of data."""

    def __init__(
        self, evaluator: Evaluator, options: IdentifyOptions, choice: Candidates
    ) -> None:
        self.evaluator, self.options, self.choice = evaluator, options, choice
        self.kernel, self.poses, self.stack = evaluator.kernel, evaluator.poses, evaluator.stack
        self.scatter, self.slack = 1.0, 1.0
        self._whitened: tuple[State, Array] | None = None
        self.priors = {self.kernel.index[name]: s for name, s in options.priors.items()}

    def columns(self, names: Sequence[str]) -> list[int]:
        return [self.kernel.index[n] for n in names]

    def problem(self, state: State, names: Sequence[str], weights: Array) -> Problem:
        if self._whitened is None or self._whitened[0] is not state:
            self._whitened = (state, whitening(self.evaluator, state, self.options.joint_sigma))
        return Problem(self.evaluator, self.columns(names), self._whitened[1], weights, self.priors)

    def solve(self, state: State, weights: Array, names: Sequence[str] | None = None) -> _Solution:
        """Eliminate, iterate, and look again at the solution whether the elimination still holds."""
        names = (*self.choice.forced, *self.choice.own_axis) if names is None else tuple(names)
        iterations = 0
        first: SolveSummary | None = None
        best: tuple[float, _Solution] | None = None
        rows = int(weights.astype(bool) @ self.stack.used.sum(axis=1))
        kept, eliminated = self._eliminate(state, names, weights)
        for round_ in range(4):
            problem = self.problem(state, kept, weights)
            state, summary = gauss_newton(
                problem.linearise, problem.residuals, problem.retract, state, self.options.termination
            )
            iterations += summary.iterations
            first = summary if first is None else first
            self.scatter = self._scatter(state, names, weights)
            # What looks weak where it is linearised may matter further on: no look may make the fit worse than the
            # parameters that it saves are worth (Bayesian information criterion).
            worth = self._worth(summary.cost, len(kept), rows)
            worse = best is not None and worth > best[0]
            if best is None or not worse:
                best = (worth, _Solution(problem, state, tuple(kept), eliminated, {}, first, summary, iterations))
            strict = 2.0 * best[1].summary.cost / self.scatter**2 > MISFIT * rows
            if round_ == 3 or (worse and not strict):
                break
            if strict and round_ > 0:  # something that matters was left out as weak: look again with more patience
                self.slack *= 10.0
                state = best[1].state
                kept, eliminated = self._eliminate(state, names, weights)
                continue
            # Deviations make some parameters visible that are dependent at nominal (parallel axes), and hide others.
            # Only the first look adds any; later ones only take away, so nothing can go round in circles.
            again, eliminated = self._eliminate(state, names if round_ == 0 else kept, weights, eliminated)
            if again == kept and strict:
                self.slack *= 10.0
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

    def choose(self, solution: _Solution, weights: Array) -> _Solution:
        """Choose among the elasticities at a solution and iterate with those that stay."""
        own, cross = self.choice.own_axis, self.choice.cross_axis
        forced = [n for n in solution.names if n not in own]
        names = (*forced, *own, *cross)
        problem = self.problem(solution.state, names, weights)
        r, J = problem.linearise(solution.state)
        current = np.array([solution.state.theta[self.kernel.index[n]] for n in (*own, *cross)])
        r = r + J[:, len(forced) :] @ current  # residuals for all optional parameters at zero
        keep, _ = split_dependent(J.T @ J, names, self._limits(solution.state, names), ties=False)
        optional = [k for k in keep if k >= len(forced)]
        chosen_from = [*range(len(forced)), *optional]
        n_own = sum(1 for k in optional if k < len(forced) + len(own))
        Jc = J[:, chosen_from]
        rows = len(r) - int((weights == 0) @ self.stack.used.sum(axis=1)) - len(problem.prior)
        picked = choose_by_evidence(Jc.T @ Jc, Jc.T @ r, float(r @ r), rows, len(forced), n_own)
        taken = [names[optional[k]] for k in picked.taken]
        rejected = {
            names[k]: float(p) for k, p in zip(optional, picked.p_values, strict=True) if names[k] not in taken
        }
        state = self._reset(solution.state, [n for n in (*own, *cross) if n not in taken])
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

    def _reset(self, state: State, names: Sequence[str]) -> State:
        theta = state.theta.copy()
        theta[self.columns(names)] = self.kernel.theta0[self.columns(names)]
        elastic = [k for n, k in zip(names, self.columns(names), strict=True) if ".elastic_" in n]
        theta[elastic] = 0.0
        return State(theta, state.world_T_base, state.flange_T_tool)

    def _worth(self, cost: float, parameters: int, rows: int) -> float:
        """Bayesian information criterion, in units of the data's own scatter; the smaller the better."""
        return 2.0 * cost / self.scatter**2 + parameters * float(np.log(max(2, rows)))

    def _scatter(self, state: State, names: Sequence[str], weights: Array) -> float:
        """How far the stated covariance can be trusted: sigma0 of the data with all candidates free, one at least.

        With all candidates, also the dependent ones (pseudo-inverse), or a parameter left out too early would make the
        data look so bad that it could not come back.
        """
        r, J = self.problem(state, names, weights).linearise(state)
        scale = np.linalg.norm(J, axis=0)
        scale[scale == 0] = 1.0
        scaled = J / scale
        values, vectors = np.linalg.eigh(scaled.T @ scaled)
        good = values > 1e-10 * values[-1]
        along = vectors[:, good].T @ (scaled.T @ r)
        left = float(r @ r - np.sum(along**2 / values[good]))
        rows = int(weights.astype(bool) @ self.stack.used.sum(axis=1))
        return max(1.0, float(np.sqrt(max(0.0, left) / max(1, rows - int(good.sum())))))

    def _limits(self, state: State, names: Sequence[str]) -> Array:
        limits = plausible_limits(self.kernel.model, self.evaluator(state).moments, names)
        return limits * (self.slack / self.scatter)

    def _eliminate(
        self, state: State, names: Sequence[str], weights: Array, before: Mapping[str, Eliminated] | None = None
    ) -> tuple[list[str], dict[str, Eliminated]]:
        """Names that stay, in order, and all that were eliminated, those of ``before`` included."""
        _, J = self.problem(state, names, weights).linearise(state)
        limits = self._limits(state, names)
        if before is not None:
            # what enters late lies in a curved valley: only if the data say much more about it than was known
            limits = np.where([n in before for n in names], LATE_SHARE * limits, limits)
        kept, gone = split_dependent(J.T @ J, names, limits, ties=before is not None)
        if not kept:
            raise NotIdentifiable("the measurements do not depend on any parameter of the robot", names)
        stay = [names[k] for k in kept]
        check_poses(self.poses.q, int(weights.astype(bool) @ self.stack.used.sum(axis=1)) + len(self.priors), stay)
        old = {n: e for n, e in (before or {}).items() if n not in stay}
        return stay, old | {e.name: e for e in gone}


def _pose_statistics(solution: _Solution, weights: Array, stack: Stack) -> tuple[Array, Array, Array, Array]:
    """Whitened residuals (n, D), studentised mean squares (n,), leverage (n,), redundancy numbers (n,) of the poses.

    For poses left out the residuals are predictions: their spread is I + A Q A', not I - A Q A'.
    """
    problem = solution.problem
    r, A = problem.unweighted().blocks(solution.state)
    _, J = problem.linearise(solution.state)
    Q = linear_statistics(J).cofactor
    H = A @ Q @ np.swapaxes(A, 1, 2)
    sign = np.where(weights > 0, -1.0, 1.0)[:, None, None]
    spread = np.eye(H.shape[1]) + sign * H
    count = stack.used.sum(axis=1)
    # a pose that alone determines something has a singular spread: count only what it can contradict
    values, vectors = np.linalg.eigh(spread)
    projected = np.einsum("nji,nj->ni", vectors, r) ** 2
    good = values > 1e-6
    square = np.sum(np.where(good, projected / np.where(good, values, 1.0), 0.0), axis=1)
    freedom = np.maximum(np.sum(good, axis=1) - (H.shape[1] - count), 0)
    trace = np.trace(H, axis1=1, axis2=2)
    return r, square / np.maximum(freedom, 1), trace / np.maximum(count, 1), count - np.where(weights > 0, trace, 0.0)


def _outliers(solution: _Solution, stack: Stack) -> list[int]:
    """Poses whose studentised square stands out against the median of all (scaled F approximation)."""
    n = stack.n
    _, square, _, _ = _pose_statistics(solution, np.ones(n), stack)
    count = stack.used.sum(axis=1)
    measured = count > 0
    if measured.sum() < 8:
        return []
    typical = float(np.median(square[measured] / (special.chdtri(count[measured], 0.5) / count[measured])))
    limit = special.chdtri(np.maximum(count, 1), OUTLIER_LEVEL / measured.sum()) / np.maximum(count, 1)
    return np.flatnonzero(measured & (square > limit * max(typical, 1e-300) * 1.5)).tolist()


def _without_outliers(
    engine: _Engine, state: State, suspects: list[int], stack: Stack
) -> tuple[list[int], Array, _Solution]:
    """Take out the suspects, and look again, so that one gross error does not make others look bad or hide them."""
    n = stack.n
    weights = np.ones(n)
    solution: _Solution | None = None
    for _ in range(4):
        weights = np.ones(n)
        weights[suspects] = 0.0
        if len(suspects) > max(1, OUTLIER_SHARE * n):
            weights = np.ones(n)
            return [], weights, engine.solve(state, weights)
        solution = engine.solve(state, weights)
        _, square, _, _ = _pose_statistics(solution, weights, stack)
        count = np.maximum(stack.used.sum(axis=1), 1)
        typical = float(np.median((square / (special.chdtri(count, 0.5) / count))[weights > 0]))
        limit = special.chdtri(count, OUTLIER_LEVEL / n) / count * typical * 1.5
        now = np.flatnonzero(square > limit).tolist()
        if set(now) == set(suspects):
            break
        suspects = now
        if not suspects:
            return [], np.ones(n), engine.solve(state, np.ones(n))
    if solution is None:
        solution = engine.solve(state, weights)
    return np.flatnonzero(weights == 0).tolist(), weights, solution


def _result(
    engine: _Engine, solution: _Solution, weights: Array, outliers: list[int], clock: float, seconds_kernel: float
) -> IdentifiedRobot:
    kernel, options, stack = engine.kernel, engine.options, engine.stack
    r, J = solution.problem.linearise(solution.state)
    statistics = linear_statistics(J)
    rows = int(weights.astype(bool) @ stack.used.sum(axis=1))
    redundancy = rows + len(solution.problem.prior) - len(solution.names)
    if redundancy < 0:
        raise NotIdentifiable(
            f"{rows} measured numbers cannot determine {len(solution.names)} parameters: measure more poses or choose "
            "fewer parameters",
            solution.names,
        )
    sigma0, p_value = global_test(0.5 * float(r @ r), redundancy)
    scaled = options.covariance == "estimated" or (options.covariance == "auto" and p_value < 0.01)
    scale = sigma0**2 if scaled and redundancy > 0 else 1.0
    residuals, square, leverage, numbers = _pose_statistics(solution, weights, stack)
    state = solution.state
    values = {n: float(v) for n, v in zip(kernel.names, state.theta, strict=True)}
    model = replace(
        kernel.model.with_parameters(values), world_T_base=state.world_T_base, flange_T_tool=state.flange_T_tool
    )
    calibrated = kernel.with_references(state.world_T_base, state.flange_T_tool)
    calibrated.model, calibrated.theta0 = model, state.theta
    theta = state.theta[solution.problem.columns]
    return IdentifiedRobot(
        model=model, kernel=calibrated, names=solution.names, theta=theta, covariance=statistics.cofactor * scale,
        covariance_scale=scale, sigma0=sigma0, redundancy=redundancy, p_value=p_value, eliminated=solution.eliminated,
        rejected_elasticities=solution.rejected, condition=statistics.condition,
        condition_raw=statistics.condition_raw, correlations=statistics.correlations,
        observability=observability_indices(statistics.singular_values), residuals=residuals,
        normalised=np.sqrt(square), leverage=leverage, redundancy_numbers=numbers, outliers=tuple(outliers),
        used=weights > 0, options=options, first_summary=solution.first,
        summary=solution.summary, iterations=solution.iterations,
        seconds=time.perf_counter() - clock, seconds_kernel=seconds_kernel,
    )


def predict_frames(robot: IdentifiedRobot | RobotModel, poses: PoseInputs) -> tuple[Array, Array]:
    """Tool frames (n, 4, 4) and the covariance (n, 6, 6) of their right twist from that of the parameters.

    For a bare model the covariance is zero.
    """
    if isinstance(robot, RobotModel):
        kernel = Kernel(robot)
        return kernel.frames(kernel.theta0, poses), np.zeros((len(poses), 6, 6))
    T, J = robot.kernel.frames_and_jacobian(robot.full_theta, poses, robot.columns)
    return T, tf.transport_covariance(J, robot.covariance)
