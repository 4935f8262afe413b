"""How much the data really scatter: a factor on the stated covariance and the repeatability of the joints.

The covariance of a pose is ``V_i = f^2 (C_i + lambda G_i)`` with C_i as stated and G_i what unit scatter of all joints
does to the measured rows. Both are estimated by restricted maximum likelihood (Patterson and Thompson 1971; Koch 1999,
Parameter Estimation, section 3.6), which allows for the parameters taken from the same data.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import optimize, stats

from robcal import transforms as tf
from robcal.calibration.identification import IdentifiedRobot
from robcal.calibration.observations import Observations, Stack
from robcal.calibration.problem import Evaluator, State, joint_scatter
from robcal.robot.kernel import PoseInputs

Array = NDArray[np.float64]

SMALLEST_JOINT_SIGMA, LARGEST_JOINT_SIGMA = 1e-7, 1e-2


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
    state = State(robot.full_theta, robot.kernel.world_T_base, robot.kernel.flange_T_tool)
    at = Evaluator(robot.kernel, inside, stack)(state)
    C = stack.covariance(at.T)
    G = tf.transport_covariance(at.B, joint_scatter(robot.kernel, state, inside, 1.0))
    X = at.B @ at.J[:, :, robot.columns]
    m, p = stack.rows, len(robot.names)
    if m <= p:
        return NoiseEstimate(1.0, 0.0, 1.0, 1.0)

    def profile(ratio: float) -> tuple[float, float]:
        """Minus twice the restricted log-likelihood (up to a constant) and f^2 for a ratio lambda."""
        L = np.linalg.cholesky(C + ratio * G)
        white = np.linalg.solve(L, np.concatenate([at.r[..., None], X], axis=2))
        r, A = white[..., 0].ravel(), white[..., 1:].reshape(-1, p)
        scale = np.linalg.norm(A, axis=0)
        scale[scale == 0] = 1.0
        Q, R = np.linalg.qr(A / scale)
        left = r - Q @ (Q.T @ r)
        f2 = float(left @ left) / (m - p)
        log_det = 2.0 * float(np.sum(np.log(np.diagonal(L, axis1=1, axis2=2))))
        log_det += 2.0 * float(np.sum(np.log(np.abs(np.diag(R)))) + np.sum(np.log(scale)))
        return (m - p) * np.log(max(f2, 1e-300)) + log_det, f2

    none, f2_none = profile(0.0)
    f_none = np.sqrt(f2_none)
    low, high = (2 * np.log(s / max(f_none, 1e-12)) for s in (SMALLEST_JOINT_SIGMA, LARGEST_JOINT_SIGMA))
    grid = np.linspace(low, high, 12)
    values = [profile(float(np.exp(g)))[0] for g in grid]
    k = int(np.argmin(values))
    bounds = (grid[max(0, k - 1)], grid[min(len(grid) - 1, k + 1)])
    best = optimize.minimize_scalar(lambda g: profile(float(np.exp(g)))[0], bounds=bounds, method="bounded",
                                    options={"xatol": 1e-3})
    ratio = float(np.exp(best.x))
    likelihood, f2 = profile(ratio)
    # at the edge of the parameter space the statistic is half a chi-square with one degree of freedom
    p_value = 0.5 * float(stats.chi2.sf(max(0.0, none - likelihood), 1))
    if p_value > level:
        return NoiseEstimate(float(f_none), 0.0, p_value, float(f_none))
    return NoiseEstimate(float(np.sqrt(f2)), float(np.sqrt(f2 * ratio)), p_value, float(f_none))
