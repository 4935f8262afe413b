"""How much the data really scatter: a factor on the stated covariance and the repeatability of the joints.

The covariance of a pose is ``V_i = f^2 (C_i + lambda G_i)`` with C_i as stated and G_i what unit scatter of all joints
does to the measured rows. Both are estimated by restricted maximum likelihood (Patterson and Thompson 1971; Koch 1999,
Parameter Estimation, section 3.6), which allows for the parameters taken from the same data.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import optimize, stats

from robcal.calibration.identification import IdentifiedRobot
from robcal.calibration.observations import Observations, Stack
from robcal.calibration.problem import Evaluator, State, whitening
from robcal.robot.kernel import PoseInputs

Array = NDArray[np.float64]

NO_SCATTER = -700.0
BELOW, ABOVE, GRID_POINTS = 8.0, 10.0, 8
"""Range of the logarithm of the ratio around equal shares, and looks in it before the minimum is refined."""


@dataclass(frozen=True)
class NoiseEstimate:
    """Variance components.

    Attributes
    ----------
    factor : by which the stated standard deviations are to be multiplied.
    joint_sigma : repeatability of a joint, rad (m for sliding joints); zero if there is no evidence.
    p_value : likelihood-ratio test of joint scatter against none.
    factor_alone : factor if the stated covariance alone has to explain everything.
    """

    factor: float
    joint_sigma: float
    p_value: float
    factor_alone: float


def estimate_noise(
    robot: IdentifiedRobot, poses: PoseInputs, observations: Sequence[Observations], level: float = 0.01
) -> NoiseEstimate:
    """Estimate factor and joint repeatability from the residuals of an identification.

    Parameters
    ----------
    robot, poses, observations : an identification and its data; poses that it left out are left out here.
    level : p-value above which joint scatter is taken as none.

    Weakness: structure that the model lacks looks like joint scatter; the diagnosis asks for it first.
    """
    rows = np.flatnonzero(robot.used)
    inside = poses.subset(rows)
    stack = Stack([o.subset(rows) for o in observations], len(rows))
    state = State(robot.kernel.theta0, robot.kernel.world_T_base, robot.kernel.flange_T_tool)
    evaluator = Evaluator(robot.kernel, inside, stack)
    at = evaluator(state)
    white = whitening(evaluator, state)
    kernel = robot.kernel.with_references(state.world_T_base, state.flange_T_tool)
    moved = white @ at.B @ kernel.joint_jacobian(state.theta, inside)
    r = np.einsum("nij,nj->ni", white, at.r)
    X = white @ at.B @ at.J[:, :, robot.columns]
    used = stack.used
    if stack.rows <= len(robot.names):
        return NoiseEstimate(1.0, 0.0, 1.0, 1.0)
    found = restricted_components([(moved[i][u], r[i][u], X[i][u]) for i, u in enumerate(used)])
    if found.p_value > level:
        return NoiseEstimate(float(np.sqrt(found.alone)), 0.0, found.p_value, float(np.sqrt(found.alone)))
    joint = float(np.sqrt(found.variance * found.ratio))
    return NoiseEstimate(float(np.sqrt(found.variance)), joint, found.p_value, float(np.sqrt(found.alone)))


@dataclass(frozen=True)
class Components:
    """Variance components of whitened rows.

    Attributes
    ----------
    variance : factor on the stated covariance. ratio : variance of the joints (rad^2 or m^2) in units of it.
    alone : the factor if there were no joint scatter. statistic : twice the logarithm of the likelihood ratio.
    """

    variance: float
    ratio: float
    alone: float
    statistic: float

    @property
    def p_value(self) -> float:
        """Of the test against none; at the edge of the parameter space it is half a chi-square with one degree."""
        return 0.5 * float(stats.chi2.sf(max(0.0, self.statistic), 1))


def restricted_components(blocks: Iterable[tuple[Array, Array, Array]]) -> Components:
    """Maximise the restricted likelihood over the ratio of the components; the common factor follows in closed form.

    Parameters
    ----------
    blocks : of each pose, whitened by the stated covariance: displacement (k, N) by unit of each joint, residual (k,),
        and Jacobian (k, p) of what was fitted (and of whatever else is to be projected out).
    """
    parts = []
    for A, r, X in blocks:
        values, vectors = np.linalg.eigh(A @ A.T)
        parts.append((np.clip(values, 0.0, None), vectors.T @ r, vectors.T @ X))
    values, r, J = (np.concatenate([part[k] for part in parts]) for k in range(3))
    size = np.linalg.norm(J, axis=0)
    U, s, _ = np.linalg.svd(J[:, size > 0] / size[size > 0], full_matrices=False)
    J = U[:, s > 1e-9 * s.max(initial=0.0)]
    freedom = len(r) - J.shape[1]

    def profile(log_ratio: float) -> tuple[float, float]:
        """Minus twice the log-likelihood, up to a constant, and the factor."""
        weight = 1.0 / (1.0 + np.exp(log_ratio) * values)
        normal = J.T @ (weight[:, None] * J)
        left = r - J @ np.linalg.solve(normal, J.T @ (weight * r))
        variance = max(float(np.sum(weight * left**2)) / freedom, 1e-300)
        log_det = float(np.linalg.slogdet(normal)[1])
        return freedom * np.log(variance) - float(np.sum(np.log(weight))) + log_det, variance

    none = profile(NO_SCATTER)
    middle = -np.log(max(float(np.mean(values)), 1e-300))
    # the likelihood may have a second hill: a coarse look first
    grid = np.linspace(middle - BELOW, middle + ABOVE, GRID_POINTS)
    k = int(np.argmin([profile(float(x))[0] for x in grid]))
    found = optimize.minimize_scalar(
        lambda x: profile(x)[0],
        bounds=(grid[max(0, k - 1)], grid[min(GRID_POINTS - 1, k + 1)]),
        method="bounded",
        options={"xatol": 1e-2},
    )
    return Components(profile(float(found.x))[1], float(np.exp(found.x)), none[1], none[0] - float(found.fun))
