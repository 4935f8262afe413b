"""Unknowns, linearisation and normal equations of one adjustment from marks to the robot.

A pose has no frame of its own: the body is where the robot takes it, but for how the joints scatter,
``world_T_body = M(theta, q) [Exp(w), r]`` with ``(r, w) = R u`` and ``u`` six standard-normal numbers. Without these,
what a robot does not repeat would be forced into cameras and body; with free poses in their place, the robot would say
nothing about the cameras. They and their rows are eliminated (Schur complement), so that the system to solve has only
what all poses share.

Sources: Triggs, McLauchlan, Hartley, Fitzgibbon (2000), "Bundle adjustment: a modern synthesis", section 6.1; random
unknowns as observations of zero: Henderson (1975).
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from robcal.calibration.problem import State, folded
from robcal.estimation.levenberg import Linearised
from robcal.estimation.robust import huber_costs, huber_weights
from robcal.estimation.schur import Factor, Normals
from robcal.photogrammetry.core.camera import Camera
from robcal.photogrammetry.station.adjustment import (
    Linearisation,
    interior_basis,
    linearise,
    mark_cost,
    mark_weights,
    moved_unknowns,
    prior_terms,
    station_normals,
    without_nan,
)
from robcal.photogrammetry.station.network import MarkTable, Prior, Unknowns
from robcal.robot.kernel import Kernel, PoseInputs
from robcal.transforms import Array, adjoint, invert, retract

LOOSE = 1e-6
"""Weight of the observation that the scatter of a pose is zero where the pose does not hang on the robot: a kilometre
or a thousand radians."""


@dataclass(frozen=True)
class JointState:
    """Values of all unknowns.

    ``station``: interior and exterior orientations and body coordinates (its poses follow from the rest); ``robot``:
    parameters, base and tool; ``scatter`` (n, 6): u of each pose.
    """

    station: Unknowns
    robot: State
    scatter: Array


@dataclass(frozen=True)
class Limits:
    """Lengths of residuals, in standard deviations, from which on they count less (Huber); None: least squares."""

    mark: float
    pose: float


@dataclass(frozen=True)
class JointAt:
    """A state with the marks linearised there.

    ``frames`` (n, 4, 4) and ``twists`` (n, 6, p): the robot's tool and its right twist by the parameters, of all poses;
    ``by_robot`` (n, 6, p): twist of each pose's body by the same; ``half_cost`` with all priors.
    """

    state: JointState
    frames: Array
    twists: Array
    lin: Linearisation
    by_robot: Array
    half_cost: float


@dataclass(frozen=True)
class JointProblem:
    """Marks and everything that they depend on.

    Attributes
    ----------
    marks : their ``pose`` counts the n poses. cameras : (c,), whose size is used. noise : (c,) factor on each one's
        stated standard deviations.
    active : (g,) which exterior (6 each), interior (9) and body (3) unknowns are free. prior : of the latter two.
    kernel : the robot. inputs : of the n poses. columns : (p,) parameters of the robot that are free.
    joint_sigma : (N,) scatter of the joints, rad or m. root : (n, 6, 6) twist of the body by u, m and rad.
    tied : (n,) poses that hang on the robot; reference : (n, 4, 4) frames about which the others are free.
    """

    marks: MarkTable
    cameras: tuple[Camera, ...]
    noise: Array
    active: NDArray[np.bool_]
    prior: Prior
    kernel: Kernel
    inputs: PoseInputs
    columns: NDArray[np.intp]
    joint_sigma: Array
    root: Array
    tied: NDArray[np.bool_]
    reference: Array

    @property
    def counts(self) -> tuple[int, int]:
        """Numbers of exterior and interior orientations."""
        c = len(self.cameras)
        return (len(self.active) - 9 * c - 3 * len(self.prior.points)) // 6, c

    def without_marks(self, rows: NDArray[np.bool_]) -> "JointProblem":
        """The problem without some of its marks."""
        return replace(self, marks=self.marks.select(~rows))

    def at(self, state: JointState, limits: Limits | None, known: JointAt | None = None) -> JointAt:
        """The marks linearised at a state, and half the sum of squares there.

        ``known`` : another linearisation, whose robot is not evaluated again if it is the same.
        """
        if known is not None and known.state.robot is state.robot:
            T, J = known.frames, known.twists
        else:
            kernel = self.kernel.with_references(state.robot.world_T_base, state.robot.flange_T_tool)
            T, J = kernel.frames_and_jacobian(state.robot.theta, self.inputs, self.columns)
        root = np.where(self.tied[:, None, None], self.root, np.eye(6))
        scattered = retract(np.eye(4), np.einsum("nij,nj->ni", root, state.scatter))
        by_robot = np.where(self.tied[:, None, None], adjoint(invert(scattered)) @ J, 0.0)
        world_T_body = np.where(self.tied[:, None, None], T, self.reference) @ scattered
        state = replace(state, station=replace(state.station, world_T_body=world_T_body))
        lin = linearise(self.marks, state.station, self.cameras, self.noise)
        marks = mark_cost(lin.residual, None if limits is None else limits.mark)
        cost = marks + prior_terms(state.station, self.prior)[2] + float(np.sum(self._scatter_costs(state, limits)))
        return JointAt(state, T, J, lin, by_robot, 0.5 * cost)

    def _scatter_costs(self, state: JointState, limits: Limits | None) -> Array:
        length = np.linalg.norm(state.scatter, axis=1)
        costs = length**2 if limits is None else huber_costs(length, limits.pose)
        return np.where(self.tied, costs, LOOSE * length**2)

    def scatter_weights(self, state: JointState, limits: Limits | None) -> Array:
        """(n,) weights of the observations that u is zero."""
        length = np.linalg.norm(state.scatter, axis=1)
        weights = np.ones(len(length)) if limits is None else huber_weights(length, limits.pose)
        return np.where(self.tied, weights, LOOSE)

    def normals(self, here: JointAt, limits: Limits | None) -> Normals:
        """Normal equations of the active unknowns of the station, the robot's parameters, and the scatter of poses.

        Those of marks with a free frame for each pose are formed first; the chain rule turns its twist into the
        robot's parameters and the scatter.
        """
        weights = mark_weights(here.lin.residual, None if limits is None else limits.mark)
        free = station_normals(without_nan(here.lin), self.marks, here.state.station, self.prior, weights)
        on, p = np.flatnonzero(self.active), len(self.columns)
        J, R = here.by_robot, np.where(self.tied[:, None, None], self.root, np.eye(6))
        C, V, s = free.G[:, on], free.V, free.s
        a = len(on)
        A = np.empty((a + p, a + p))
        A[:a, :a] = free.A[np.ix_(on, on)]
        A[:a, a:] = np.einsum("nai,nip->ap", C, J, optimize=True)
        A[a:, :a] = A[:a, a:].T
        VJ = V @ J
        A[a:, a:] = np.einsum("nip,niq->pq", J, VJ, optimize=True)
        G = np.concatenate([C, np.swapaxes(VJ, 1, 2)], axis=1) @ R
        weight = self.scatter_weights(here.state, limits)
        own = np.swapaxes(R, 1, 2) @ V @ R + weight[:, None, None] * np.eye(6)
        b = np.concatenate([free.b[on], np.einsum("nip,ni->p", J, s)])
        right = np.einsum("nij,ni->nj", R, s) - weight[:, None] * here.state.scatter
        return Normals(A, G, own, b, right)

    def moved(self, state: JointState, step: Array, scatter: Array) -> JointState:
        """The state after steps of the shared unknowns (a + p,) and of the scatter (n, 6)."""
        x = state.station
        on = np.flatnonzero(self.active)
        whole = np.zeros(len(self.active))
        whole[on] = step[: len(on)]
        station = moved_unknowns(x, whole, np.zeros((len(x.world_T_body), 6)), interior_basis(x.interior))
        theta = state.robot.theta.copy()
        theta[self.columns] += step[len(on) :]
        return JointState(station, folded(self.kernel, theta, state.robot), state.scatter + scatter)

    def local(self, here: JointAt, limits: Limits | None) -> Linearised[JointAt]:
        """The problem linearised at a state, as :func:`robcal.estimation.levenberg.levenberg` takes it."""
        normals = self.normals(here, limits)

        def propose(damping: float) -> tuple[JointAt, float]:
            step, scatter = Factor(normals, damping=damping).solve(normals.b, normals.s)
            saved = 0.5 * float(step @ normals.b + np.sum(scatter * normals.s))
            return self.at(self.moved(here.state, step, scatter), limits), saved

        return Linearised(here.half_cost, propose, lambda trial: trial.half_cost)


def scatter_root(kernel: Kernel, robot: State, inputs: PoseInputs, joint_sigma: Array) -> Array:
    """(n, 6, 6) roots of the covariance that joints which scatter by ``joint_sigma`` (N,) give to the tool's twist.

    Columns are those of the joints; of more than six, their triangular factor; of fewer, filled with zeros.
    """
    J = kernel.with_references(robot.world_T_base, robot.flange_T_tool).joint_jacobian(robot.theta, inputs)
    moved = J * joint_sigma
    joints = moved.shape[2]
    if joints > 6:
        return np.swapaxes(np.linalg.qr(np.swapaxes(moved, 1, 2), mode="r"), 1, 2)
    return np.concatenate([moved, np.zeros((len(moved), 6, 6 - joints))], axis=2)
