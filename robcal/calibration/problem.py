"""The least-squares problem of a robot: whitened residuals and Jacobian of chosen parameters at a state.

The state carries the references of base and tool, into which their deviations are folded after every step: so large
turns of base and tool need no care, and their six parameters always speak of small perturbations on the right.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from robcal import transforms as tf
from robcal.calibration.observations import Stack
from robcal.robot.kernel import Kernel, PoseInputs
from robcal.robot.model import GEOMETRIC_KINDS

Array = NDArray[np.float64]


@dataclass(frozen=True)
class State:
    """Parameters and references at which a robot is linearised."""

    theta: Array
    world_T_base: Array
    flange_T_tool: Array


class Problem:
    """Residuals of all observations at all poses.

    Parameters
    ----------
    kernel, poses, stack : model, inputs (n), observations arranged by pose.
    columns : indices of the free parameters.
    whitener : (n, D, D) lower-triangular inverse Cholesky factors of the poses' covariances.
    weights : (n,) further weights of the poses (0 leaves a pose out).
    prior : mean zero standard deviations by parameter index (information rows), or None.
    """

    def __init__(
        self, kernel: Kernel, poses: PoseInputs, stack: Stack, columns: ArrayLike, whitener: Array,
        weights: Array | None = None, prior: Mapping[int, float] | None = None,
    ) -> None:
        self.kernel, self.poses, self.stack = kernel, poses, stack
        self.columns = np.asarray(columns, dtype=np.intp)
        self.plain_whitener = whitener
        self.whitener = whitener if weights is None else whitener * np.sqrt(weights)[:, None, None]
        self.prior = {k: s for k, s in (prior or {}).items() if k in set(self.columns.tolist())}
        self._prior_at = [int(np.flatnonzero(self.columns == k)[0]) for k in self.prior]
        self._base = [kernel.index[f"base.{k}"] for k in GEOMETRIC_KINDS]
        self._tool = [kernel.index[f"tool.{k}"] for k in GEOMETRIC_KINDS]
        self._all_used = bool(stack.used.all())

    def frames(self, state: State) -> Array:
        """Tool frames (n, 4, 4) at a state."""
        return self._at(state).frames(state.theta, self.poses)

    def residuals(self, state: State) -> Array:
        """Whitened residuals (rows,)."""
        r = self.stack.evaluate(self.frames(state)).r
        return self._with_prior(self._flat(np.einsum("nij,nj->ni", self.whitener, r)), state)

    def linearise(self, state: State) -> tuple[Array, Array]:
        """Whitened residuals (rows,) and Jacobian (rows, p)."""
        r, A = self.blocks(state)
        J = A if self._all_used else A[self.stack.used]
        J = J.reshape(-1, len(self.columns))
        if self.prior:
            rows = np.zeros((len(self.prior), J.shape[1]))
            rows[np.arange(len(rows)), self._prior_at] = 1.0 / np.array(list(self.prior.values()))
            J = np.concatenate([J, rows])
        return self._with_prior(self._flat(r), state), J

    def blocks(self, state: State) -> tuple[Array, Array]:
        """Whitened residuals (n, D) and Jacobian (n, D, p) by pose, zero where padded; priors left out."""
        T, J = self._at(state).frames_and_jacobian(state.theta, self.poses, self.columns)
        stacked = self.stack.evaluate(T)
        return np.einsum("nij,nj->ni", self.whitener, stacked.r), (self.whitener @ stacked.B) @ J

    def retract(self, state: State, step: Array) -> State:
        """Add a step to the free parameters and fold base and tool into their references."""
        theta = state.theta.copy()
        theta[self.columns] += step
        W, F = state.world_T_base, state.flange_T_tool
        if np.any(theta[self._base]):
            W = W @ tf.frame_from_xyzrpy(theta[self._base])
        if np.any(theta[self._tool]):
            F = F @ tf.frame_from_xyzrpy(theta[self._tool])
        theta[self._base], theta[self._tool] = 0.0, 0.0
        return State(theta, W, F)

    def unweighted(self) -> Problem:
        """The same problem with all poses at full weight, those left out included."""
        other = self.with_columns(self.columns)
        other.whitener = self.plain_whitener
        return other

    def with_columns(self, columns: ArrayLike) -> Problem:
        """The same problem with other free parameters."""
        other = object.__new__(Problem)
        other.__dict__.update(self.__dict__)
        other.columns = np.asarray(columns, dtype=np.intp)
        other.prior = {k: s for k, s in self.prior.items() if k in set(other.columns.tolist())}
        other._prior_at = [int(np.flatnonzero(other.columns == k)[0]) for k in other.prior]
        return other

    def _at(self, state: State) -> Kernel:
        return self.kernel.with_references(state.world_T_base, state.flange_T_tool)

    def _flat(self, r: Array) -> Array:
        return r.ravel() if self._all_used else r[self.stack.used]

    def _with_prior(self, r: Array, state: State) -> Array:
        if not self.prior:
            return r
        return np.concatenate([r, [-state.theta[k] / s for k, s in self.prior.items()]])


def whitening(stack: Stack, T: Array, joint_covariance: Array | None = None) -> Array:
    """Whiteners (n, D, D): inverse Cholesky factors of each pose's covariance.

    Parameters
    ----------
    T : (n, 4, 4) tool frames at which covariances and derivatives are taken.
    joint_covariance : (n, 6, 6) covariance of the tool's twist that all rows of a pose have in common (repeatability
        of the joints), added as ``B S B'``.
    """
    C = stack.covariance(T)
    if joint_covariance is not None:
        C = C + tf.transport_covariance(stack.evaluate(T).B, joint_covariance)
    L = np.linalg.cholesky(C)
    return np.linalg.solve(L, np.broadcast_to(np.eye(L.shape[-1]), L.shape))


def joint_scatter(kernel: Kernel, state: State, poses: PoseInputs, joint_sigma: ArrayLike) -> Array:
    """Covariance (n, 6, 6) of the tool's twist from joints that stop with standard deviations ``joint_sigma`` (N,)."""
    Jq = kernel.with_references(state.world_T_base, state.flange_T_tool).joint_jacobian(state.theta, poses)
    scaled = Jq * np.broadcast_to(np.asarray(joint_sigma, dtype=float), Jq.shape[-1:])
    return scaled @ np.swapaxes(scaled, 1, 2)
