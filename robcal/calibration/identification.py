"""Identification of a robot from any mixture of observations.

Start values by construction, whitening with the measured covariances, Gauss-Newton with halving line search, named
elimination of dependent parameters, choice of elasticities by evidence, outlier poses, covariance and diagnostics.
Source of the adjustment statistics: Foerstner and Wrobel (2016), Photogrammetric Computer Vision, chapter 4.
"""

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from robcal import transforms as tf
from robcal.calibration.calibrated import CalibratedRobot
from robcal.calibration.deficiency import describe_deficiency
from robcal.calibration.identifiability import check_poses, choose_candidates, observability_indices
from robcal.calibration.observations import FrameObservations, Observations, Stack, basis_points
from robcal.calibration.outliers import PoseStatistics, find_outliers, pose_statistics
from robcal.calibration.problem import CellEvaluator, Evaluator, Problem, State, whitening
from robcal.calibration.solution import Engine, Solution
from robcal.calibration.start_values import candidates
from robcal.errors import InvalidInput, NotIdentifiable
from robcal.estimation.covariance import global_test, linear_statistics
from robcal.estimation.dependence import Eliminated
from robcal.estimation.gauss_newton import gauss_newton
from robcal.estimation.summary import SolveSummary, TerminationSettings
from robcal.robot.kernel import Kernel, PoseInputs
from robcal.robot.model import RobotModel

Array = NDArray[np.float64]


@dataclass(frozen=True)
class IdentifyOptions:
    """How to identify.

    Attributes
    ----------
    parameters : 'standard', 'geometry', 'table5.4' or a list of names; base, tool and terms are always added.
    robust : leave out single poses that contradict all others (and report them).
    objective : 'maximum_likelihood' (whitened with the measured covariance) or 'basis' (equal weights).
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
    termination: TerminationSettings = field(default_factory=lambda: TerminationSettings(60, negligible=1e-4))


@dataclass(frozen=True, kw_only=True)
class IdentifiedRobot(CalibratedRobot):
    """A calibrated robot and how its identification went.

    Attributes
    ----------
    model : parameters filled, references of base and tool set (their deviations folded in).
    covariance : after scaling by covariance_scale (sigma0 squared or one).
    sigma0, redundancy, p_value : root of the whitened sum of squares over redundancy, and its chi-square test.
    eliminated : by name, why a candidate was not identified and what it is tied to.
    rejected_elasticities : p-values of the elasticities for which the data show no evidence.
    condition, condition_raw, correlations, observability : gauges of the poses.
    residuals : (n, D) whitened residuals by pose; normalised : (n,) their studentised norm per degree of freedom
        (near one); leverage : (n,) share of a pose's rows in its own prediction; redundancy_numbers : (n,).
    outliers : rows of poses left out; used : (n,) mask of the others.
    first_summary, summary : of the first iteration (from the start values) and of the last one, after the choice of
        parameters; iterations counts all Gauss-Newton steps; seconds : kernel, start and solution.
    deficiency : why the poses cannot separate base and tool, with the remedy; empty where they do.
    """

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
    seconds: float = 0.0
    seconds_kernel: float = 0.0
    deficiency: str = ""

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

    engine = Engine(evaluator, choice, options.joint_sigma, options.priors, options.termination)
    final, weights, outliers, statistics = estimate(engine, state, options.robust)
    result = _result(engine, options, final, weights, outliers, statistics)
    return replace(result, seconds=time.perf_counter() - clock, seconds_kernel=seconds_kernel)


def estimate(
    engine: Engine, state: State, robust: bool, groups: Sequence[NDArray[np.intp]] | None = None
) -> tuple[Solution, Array, list[int], PoseStatistics]:
    """Iterate from a state, leave out outlier poses, choose elasticities: solution, weights (n,), outliers, statistics.

    ``groups`` : rows of poses that are compared with one another in the search for outliers.
    """
    weights = np.ones(engine.stack.n)
    first = engine.solve(state, weights)
    outliers: list[int] = []
    statistics: PoseStatistics | None = None
    if robust:
        outliers, weights, first, statistics = find_outliers(engine, first, groups)
    final = engine.choose(first, weights) if engine.choice.own_axis or engine.choice.cross_axis else first
    if statistics is None or final is not first:
        statistics = pose_statistics(final, weights, engine.stack)
    return final, weights, outliers, statistics


def start_state(evaluator: Evaluator, observations: Sequence[Observations]) -> State:
    """State with the kernel's own parameters and base and tool constructed from the data; the best of all candidates.

    Raises
    ------
    NotIdentifiable : nothing can be constructed and the model gives no references.
    """
    kernel = evaluator.kernel
    cell = CellEvaluator(evaluator)
    theta = cell.theta
    pairs = candidates(cell.base_T_flange, observations, kernel.model.flange_T_tool)
    if kernel.model.world_T_base is not None and kernel.model.flange_T_tool is not None:
        given = kernel.theta0
        pairs.append(
            (
                kernel.world_T_base @ tf.frame_from_xyzrpy(given[cell.base]),
                kernel.flange_T_tool @ tf.frame_from_xyzrpy(given[cell.tool]),
            )
        )
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


def _result(
    engine: Engine,
    options: IdentifyOptions,
    solution: Solution,
    weights: Array,
    outliers: list[int],
    poses: PoseStatistics,
) -> IdentifiedRobot:
    kernel, stack = engine.kernel, engine.stack
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
    used = weights > 0
    flange = CellEvaluator(engine.evaluator).base_T_flange
    sigma = dict(zip(solution.names, np.sqrt(scale * np.diag(statistics.cofactor)).tolist(), strict=True))
    eliminated = engine.tied(solution, weights)
    deficiency = describe_deficiency(kernel.model, engine.poses.q[used], flange[used], eliminated, sigma)
    joint_sigma = np.sqrt(scale) * np.asarray(options.joint_sigma or 0.0, dtype=float)
    return IdentifiedRobot(
        model=_model_at(kernel, solution.state),
        names=solution.names,
        statics=options.statics,
        joint_sigma=joint_sigma.tolist(),
        covariance=statistics.cofactor * scale,
        covariance_scale=scale,
        sigma0=sigma0,
        redundancy=redundancy,
        p_value=p_value,
        eliminated=eliminated,
        rejected_elasticities=solution.rejected,
        condition=statistics.condition,
        condition_raw=statistics.condition_raw,
        correlations=statistics.correlations,
        observability=observability_indices(statistics.singular_values),
        residuals=poses.residuals,
        normalised=np.sqrt(poses.mean_square),
        leverage=poses.leverage,
        redundancy_numbers=poses.redundancy,
        outliers=tuple(outliers),
        used=used,
        deficiency=deficiency,
        options=options,
        first_summary=solution.first,
        summary=solution.summary,
        iterations=solution.iterations,
    )


def _model_at(kernel: Kernel, state: State) -> RobotModel:
    """The kernel's robot with the parameters and references of a state."""
    values = {n: float(v) for n, v in zip(kernel.names, state.theta, strict=True)}
    return replace(
        kernel.model.with_parameters(values), world_T_base=state.world_T_base, flange_T_tool=state.flange_T_tool
    )
