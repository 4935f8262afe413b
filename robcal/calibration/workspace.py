"""How far a calibrated robot may be off over its whole workspace, and which further poses would tell most.

The error predicted at a place is the root of the trace of the position's covariance: of the parameters and of what
scatters the joints, not of what no model explains. Places are sampled evenly in joint space (Sobol 1967).
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.stats import qmc

from robcal.calibration.calibrated import CalibratedRobot
from robcal.calibration.joint_log import JointLog
from robcal.calibration.pose_choice import Design, choose_worst_case, covariance_of, predicted_errors
from robcal.robot.chain import chain_of
from robcal.robot.kernel import PoseInputs
from robcal.transforms import Array, invert

ALIKE = np.radians(40.0)
"""Largest turn (rad) of a proposed tool against some recorded one: what was seen there is likely to be seen here."""
MARGIN = 0.1
"""Share of the recorded volume's size by which a proposed tool may lie outside."""
CELLS = 30
_CANDIDATES = 500


@dataclass(frozen=True)
class WorkspaceMap:
    """Predicted errors by distance from the axis of the base and height above it, base coordinates.

    Attributes
    ----------
    payload : name, None for none. radius (n,), height (m,) : centres of the cells, m.
    worst : (m, n) largest predicted error of the sampled poses in a cell, m; NaN where none reaches.
    error : (s,) predicted error of every sampled pose, m; q : (s, N) their joint angles.
    """

    payload: str | None
    radius: Array
    height: Array
    worst: Array = field(repr=False)
    error: Array = field(repr=False)
    q: Array = field(repr=False)


@dataclass(frozen=True)
class Proposals:
    """Further poses that lower the largest predicted errors most.

    Attributes
    ----------
    q : (k, N) rad or m, best first; payload : to carry.
    before, after : largest predicted error over the workspace without and with the first of them, m; ``after`` (k,).
    """

    q: Array
    payload: str | None
    before: float
    after: Array


def joint_limits(robot: CalibratedRobot) -> tuple[Array, Array]:
    """Limits (N,) of the joints as stated; where unknown, what was recorded."""
    chain = chain_of(robot.model)
    q = np.zeros((1, chain.n_joints)) if robot.q is None or not len(robot.q) else robot.q
    lower = np.where(np.isfinite(chain.lower), chain.lower, q.min(axis=0))
    upper = np.where(np.isfinite(chain.upper), chain.upper, q.max(axis=0))
    return lower, np.maximum(upper, lower + 1e-6)


def sampled(robot: CalibratedRobot, power: int = 12) -> Array:
    """Joint angles (2**power, N), even over the joint space; the same ones each time."""
    lower, upper = joint_limits(robot)
    unit = qmc.Sobol(len(lower), seed=0).random_base2(power)
    return np.asarray(lower + unit * (upper - lower))


def inputs_at(robot: CalibratedRobot, q: Array, payload: str | None) -> PoseInputs:
    """Poses to predict that state joint angles and the load alone."""
    names = tuple(str(k) for k in range(len(q)))
    still = np.zeros(q.shape)
    return robot.inputs(JointLog(names, q, (payload,) * len(q), np.zeros(len(q), dtype=bool), still))


def cylindrical(robot: CalibratedRobot, world_T_tool: Array) -> tuple[Array, Array]:
    """Distance from the base's axis (n,) and height (n,) of tools (n, 4, 4) in the world, m."""
    base = np.eye(4) if robot.model.world_T_base is None else np.asarray(robot.model.world_T_base)
    place = (invert(base) @ world_T_tool)[:, :3, 3]
    return np.hypot(place[:, 0], place[:, 1]), place[:, 2]


def workspace_map(robot: CalibratedRobot, payload: str | None, q: Array) -> WorkspaceMap:
    """The map for one load, from poses q (s, N)."""
    T, covariance = robot.predict(inputs_at(robot, q, payload))
    error = np.sqrt(np.trace(covariance[:, :3, :3], axis1=1, axis2=2))
    radius, height = cylindrical(robot, T)
    size = max(float(radius.max()), float(np.ptp(height))) / CELLS
    low = float(height.min())
    columns, rows = (radius / size).astype(int), ((height - low) / size).astype(int)
    worst = np.full((rows.max() + 1, columns.max() + 1), -np.inf)
    np.maximum.at(worst, (rows, columns), error)
    worst[~np.isfinite(worst)] = np.nan
    return WorkspaceMap(
        payload,
        (np.arange(worst.shape[1]) + 0.5) * size,
        low + (np.arange(worst.shape[0]) + 0.5) * size,
        worst,
        error,
        q,
    )


def helpful_poses(
    robot: CalibratedRobot, payload: str | None, measured: Array, q: Array, count: int = 6
) -> Proposals | None:
    """Poses to measure next, of candidates q (s, N) that lie and look like those recorded; None where none does.

    ``measured`` (6, 6) : covariance of a measured frame (right twist, m and rad). Weakness: neither collisions nor the
    sight of the cameras are known here.
    """
    near = _like_recorded(robot, q, payload)[:_CANDIDATES]
    if not len(near) or not len(robot.names):
        return None
    root = np.linalg.cholesky(robot.covariance + 1e-12 * np.diag(np.diag(robot.covariance)))
    information = np.linalg.cholesky(np.linalg.inv(measured)).T
    rows = information @ _jacobian(robot, near, payload) @ root
    checks = (_jacobian(robot, q, payload) @ root)[:, :3]
    design = Design(rows, checks)
    chosen = choose_worst_case(design, count)
    before = float(predicted_errors(design, covariance_of(design, [])).max())
    after = [float(predicted_errors(design, covariance_of(design, chosen[: k + 1])).max()) for k in range(len(chosen))]
    return Proposals(near[chosen], payload, before, np.array(after))


def _jacobian(robot: CalibratedRobot, q: Array, payload: str | None) -> Array:
    kernel = robot.kernel
    return np.asarray(kernel.frames_and_jacobian(kernel.theta0, inputs_at(robot, q, payload), robot.columns)[1])


def _like_recorded(robot: CalibratedRobot, q: Array, payload: str | None) -> Array:
    """Of poses (s, N), those whose tool is within the recorded volume and turned much like some recorded one."""
    if robot.tools is None or not len(robot.tools):
        return q[:0]
    kernel = robot.kernel
    T = kernel.frames_and_jacobian(kernel.theta0, inputs_at(robot, q, payload), robot.columns[:1])[0]
    places = robot.tools[:, :3, 3]
    margin = MARGIN * np.ptp(places, axis=0)
    inside = np.all((T[:, :3, 3] >= places.min(0) - margin) & (T[:, :3, 3] <= places.max(0) + margin), axis=1)
    T, q = T[inside], q[inside]
    trace = np.einsum("nij,mij->nm", T[:, :3, :3], robot.tools[:, :3, :3])
    turn: NDArray[np.float64] = np.arccos(np.clip((trace - 1) / 2, -1, 1))
    return q[turn.min(axis=1, initial=np.pi) < ALIKE]


def largest_gaps(q: Array, lower: Array, upper: Array) -> tuple[Array, Array, Array]:
    """Share of each joint's range that was driven, and start and end of the largest part of it without a pose (N,)."""
    edges = np.vstack([lower, np.sort(q, axis=0), upper])
    gaps = np.diff(edges, axis=0)
    at = np.argmax(gaps, axis=0)
    columns = np.arange(q.shape[1])
    return np.ptp(q, axis=0) / (upper - lower), edges[at, columns], edges[at + 1, columns]


def loads_of(payloads: Sequence[str | None]) -> tuple[str | None, ...]:
    """The loads that were carried, in the order met."""
    return tuple(dict.fromkeys(p or None for p in payloads))
