"""Base and tool of a robot whose other parameters are known."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from robcal.calibration.observations import Observations, Stack
from robcal.calibration.problem import CellEvaluator, Evaluator, Problem, State, whitening
from robcal.calibration.start_values import candidates
from robcal.errors import NotIdentifiable
from robcal.estimation.gauss_newton import gauss_newton
from robcal.robot.kernel import Kernel, PoseInputs
from robcal.robot.model import RobotModel


def with_fitted_cell(
    kernel: Kernel,
    poses: PoseInputs,
    observations: Sequence[Observations],
    joint_sigma: ArrayLike = 0.0,
    *,
    anew: bool = False,
) -> RobotModel:
    """The model of a kernel with base and tool fitted to observations (generalised least squares).

    Parameters
    ----------
    joint_sigma : scatter of the joints, rad or m, in units in which the observations have their stated covariance.
    anew : start from values constructed from the observations instead of the references of the model.

    Raises
    ------
    NotIdentifiable : no start values can be constructed.
    """
    evaluator = CellEvaluator(Evaluator(kernel, poses, Stack(observations, len(poses))))
    pairs = [(kernel.world_T_base, kernel.flange_T_tool)]
    if anew:
        pairs = list(candidates(evaluator.base_T_flange, observations))
    if not pairs:
        raise NotIdentifiable("base and tool cannot be found from these measurements alone", ("base", "tool"))
    fitted = []
    for pair in pairs:
        state = State(evaluator.theta, *pair)
        problem = Problem(
            evaluator,
            [*evaluator.base, *evaluator.tool],
            whitening(evaluator, state, joint_sigma if np.any(joint_sigma) else None),
        )
        fitted.append(gauss_newton(problem.linearise, problem.residuals, problem.retract, state))
    best = fitted[int(np.argmin([summary.cost for _, summary in fitted]))][0]
    values = dict(zip(kernel.names, best.theta.tolist(), strict=True))
    return replace(
        kernel.model.with_parameters(values), world_T_base=best.world_T_base, flange_T_tool=best.flange_T_tool
    )
