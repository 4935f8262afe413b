"""The least-squares problem of a robot: whitened residuals and Jacobian of chosen parameters at a state.

The state carries the references of base and tool, into which their deviations are folded after every step: so large
turns of base and tool need no care, and their six parameters always speak of small perturbations on the right.
"""

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


@dataclass(frozen=True)
class Evaluation:
    """Everything the kernel and the operators say at a state: raw, for all parameters.

    Attributes
    ----------
    T : (n, 4, 4); J : (n, 6, all parameters); moments : (n, m); r, B : stacked residuals (n, D) and (n, D, 6).
    """

    T: Array
    J: Array
    moments: Array
    r: Array
    B: Array


class Evaluator:
    """Kernel and observations at one set of poses, remembering the last states: most are asked for several times."""

    def __init__(self, kernel: Kernel, poses: PoseInputs, stack: Stack) -> None:
        self.kernel, self.poses, self.stack = kernel, poses, stack
        self.index: Mapping[str, int] = kernel.index
        self.theta0 = kernel.theta0
        self._base = [kernel.index[f"base.{k}"] for k in GEOMETRIC_KINDS]
        self._tool = [kernel.index[f"tool.{k}"] for k in GEOMETRIC_KINDS]
        self._memory: list[tuple[State, Evaluation]] = []

    def __call__(self, state: State) -> Evaluation:
        """The evaluation at a state."""
        for known, evaluation in self._memory:
            if known is state:
                return evaluation
        at = self.kernel.with_references(state.world_T_base, state.flange_T_tool)
        T, J, moments = at.evaluate(state.theta, self.poses)
        stacked = self.stack.evaluate(T)
        evaluation = Evaluation(T, J, moments, stacked.r, stacked.B)
        self._memory = [(state, evaluation), *self._memory[:2]]
        return evaluation

    def fold(self, theta: Array, state: State) -> State:
        """A state with moved parameters, deviations of base and tool folded into the references."""
        return folded(self.kernel, theta, state)

    def deviations(self, state: State) -> Array:
        """How far each parameter (all) is from where priors expect it."""
        return state.theta

    def joint_scatter(self, state: State, joint_sigma: ArrayLike) -> Array:
        """Covariance (n, 6, 6) of the tool's twist from joints that stop with standard deviations ``joint_sigma``."""
        return joint_scatter(self.kernel, state, self.poses, joint_sigma)


def folded(kernel: Kernel, theta: Array, state: State) -> State:
    """A state with parameters ``theta`` (all), whose deviations of base and tool are folded into the references."""
    theta = theta.copy()
    references = {"base": state.world_T_base, "tool": state.flange_T_tool}
    for end, frame in references.items():
        columns = [kernel.index[f"{end}.{k}"] for k in GEOMETRIC_KINDS]
        if np.any(theta[columns]):
            references[end] = frame @ tf.frame_from_xyzrpy(theta[columns])
            theta[columns] = 0.0
    return State(theta, references["base"], references["tool"])


class CellEvaluator(Evaluator):
    """Evaluator for base and tool alone: the chain between them is evaluated once, which many start values share.

    Weakness: where gravity is given in the world, loads stay as they are with the base along the world's axes.
    """

    def __init__(self, evaluator: Evaluator) -> None:
        super().__init__(evaluator.kernel, evaluator.poses, evaluator.stack)
        kernel = evaluator.kernel
        self.theta = kernel.theta0.copy()
        self.base = [kernel.index[f"base.{k}"] for k in GEOMETRIC_KINDS]
        self.tool = [kernel.index[f"tool.{k}"] for k in GEOMETRIC_KINDS]
        self.theta[[*self.base, *self.tool]] = 0.0
        chain = kernel.with_references(np.eye(4), np.eye(4))
        self.base_T_flange = chain.frames(self.theta, evaluator.poses)
        self._moments = np.zeros((len(evaluator.poses), 0))

    def __call__(self, state: State) -> Evaluation:
        """The evaluation at a state; the Jacobian is zero but for base and tool, the moments are left out."""
        for known, evaluation in self._memory:
            if known is state:
                return evaluation
        base_T_tool = self.base_T_flange @ state.flange_T_tool
        T = state.world_T_base @ base_T_tool
        J = np.zeros((len(T), 6, len(self.kernel.names)))
        J[:, :, self.base] = tf.adjoint(tf.invert(base_T_tool))
        J[:, :, self.tool] = np.eye(6)
        stacked = self.stack.evaluate(T)
        evaluation = Evaluation(T, J, self._moments, stacked.r, stacked.B)
        self._memory = [(state, evaluation), *self._memory[:2]]
        return evaluation


class Problem:
    """Residuals of all observations at all poses.

    Parameters
    ----------
    evaluator : kernel, poses (n) and observations.
    columns : indices of the free parameters.
    whitener : (n, D, D) inverse Cholesky factors of the poses' covariances.
    weights : (n,) further weights of the poses (0 leaves a pose out).
    prior : standard deviations around zero by parameter index (information rows), or None.
    """

    def __init__(
        self,
        evaluator: Evaluator,
        columns: ArrayLike,
        whitener: Array,
        weights: Array | None = None,
        prior: Mapping[int, float] | None = None,
    ) -> None:
        self.evaluator = evaluator
        self.kernel, self.poses, self.stack = evaluator.kernel, evaluator.poses, evaluator.stack
        self.columns = np.asarray(columns, dtype=np.intp)
        self.plain_whitener = whitener
        self.whitener = whitener if weights is None else whitener * np.sqrt(weights)[:, None, None]
        at = {int(k): row for row, k in enumerate(self.columns)}
        self.prior = {k: s for k, s in (prior or {}).items() if k in at}
        self._prior_at = [at[k] for k in self.prior]
        self._all_used = bool(self.stack.used.all())

    def residuals(self, state: State) -> Array:
        """Whitened residuals (rows,)."""
        r = np.einsum("nij,nj->ni", self.whitener, self.evaluator(state).r)
        return self._with_prior(self._flat(r), state)

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
        at = self.evaluator(state)
        r = np.einsum("nij,nj->ni", self.whitener, at.r)
        # the kernel stores parameters before twists: taking columns there copies whole rows
        J = np.take(np.swapaxes(at.J, 1, 2), self.columns, axis=1)
        return r, (self.whitener @ at.B) @ np.swapaxes(J, 1, 2)

    def retract(self, state: State, step: Array) -> State:
        """Add a step to the free parameters and fold base and tool into their references."""
        theta = state.theta.copy()
        theta[self.columns] += step
        return self.evaluator.fold(theta, state)

    def unweighted(self) -> "Problem":
        """The same problem with all poses at full weight, those left out included."""
        return Problem(self.evaluator, self.columns, self.plain_whitener, None, self.prior)

    def _flat(self, r: Array) -> Array:
        return r.ravel() if self._all_used else r[self.stack.used]

    def _with_prior(self, r: Array, state: State) -> Array:
        if not self.prior:
            return r
        off = self.evaluator.deviations(state)
        return np.concatenate([r, [-off[k] / s for k, s in self.prior.items()]])


def whitening(evaluator: Evaluator, state: State, joint_sigma: ArrayLike | None = None) -> Array:
    """Whiteners (n, D, D): inverse Cholesky factors of each pose's covariance at a state.

    Parameters
    ----------
    joint_sigma : repeatability of the joints (one number or (N,), rad or m): scatter that all rows of a pose have in
        common, added as ``B S B'``.
    """
    at = evaluator(state)
    C = evaluator.stack.covariance(at.T)
    if joint_sigma is not None:
        C = C + tf.transport_covariance(at.B, evaluator.joint_scatter(state, joint_sigma))
    L = np.linalg.cholesky(C)
    return np.asarray(np.linalg.solve(L, np.broadcast_to(np.eye(L.shape[-1]), L.shape)))


def joint_scatter(kernel: Kernel, state: State, poses: PoseInputs, joint_sigma: ArrayLike) -> Array:
    """Covariance (n, 6, 6) of the tool's twist from joints that stop with standard deviations ``joint_sigma`` (N,)."""
    Jq = kernel.with_references(state.world_T_base, state.flange_T_tool).joint_jacobian(state.theta, poses)
    scaled = Jq * np.broadcast_to(np.asarray(joint_sigma, dtype=float), Jq.shape[-1:])
    return scaled @ np.swapaxes(scaled, 1, 2)
