"""Measuring poses for an identification: as many as asked for, or as few as the wanted accuracy of the tool needs.

Candidates that can be measured (:mod:`robcal.calibration.pose_candidates`) are chosen equidistant in joint space
or by their information on the parameters (:mod:`robcal.calibration.pose_choice`), put into an
order with short travel, and given approach directions that are balanced over the joints, so that backlash and
hysteresis can be distinguished from geometry.
"""

from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from robcal.calibration.identifiability import choose_candidates, plausible_limits
from robcal.calibration.pose_candidates import Candidates, Cell, find_candidates
from robcal.calibration.pose_choice import (
    Design,
    balanced_approaches,
    choose_d_optimal,
    choose_worst_case,
    covariance_of,
    exchange,
    joint_ranges,
    path_length,
    predicted_errors,
    short_order,
    spread,
)
from robcal.calibration.visibility import frame_information
from robcal.errors import InvalidInput
from robcal.robot.chain import chain_of
from robcal.robot.kernel import Kernel, PoseInputs
from robcal.robot.model import RobotModel, parameter_names
from robcal.robot.statics import moment_names
from robcal.transforms import Array

_LOOSE = 1.0
"""m and rad; prior of base and tool, of which nothing need be known."""


@dataclass(frozen=True)
class PoseRequest:
    """What is wanted.

    Attributes
    ----------
    model : nominal robot (with its payloads).
    cell : cameras, body, obstacles, cell frames.
    method : 'd_optimal', 'worst_case' (least predicted error of the tool where it is largest) or 'equidistant'.
    count : number of poses to identify with; with ``accuracy`` the most that may be used.
    accuracy : m; predicted error of the tool (root sum of the variances of its three coordinates, worst place of the
        workspace) at which no further pose is needed; None uses all ``count``.
    verify : number of further poses, spread evenly, with which to verify.
    parameters : choice of parameters as for an identification.
    payload : name of the load carried, None for none.
    sigma_px : px; accuracy of an image point (with cameras). sigma : (m, rad) accuracy of a measured frame in addition:
        repeatability of the robot, or all there is without cameras.
    test_points : (k, 3) m, points in body coordinates whose accuracy counts.
    candidates : so many candidates to choose from; margin : share of the joint ranges to keep off the limits.
    seed : of all random choices; the same request gives the same poses.
    start : (N,) configuration from which the robot sets out.
    """

    model: RobotModel
    cell: Cell
    method: Literal["d_optimal", "worst_case", "equidistant"] = "d_optimal"
    count: int = 80
    accuracy: float | None = None
    verify: int = 0
    parameters: str | tuple[str, ...] = "standard"
    payload: str | None = None
    sigma_px: float = 0.05
    sigma: tuple[float, float] = (5e-5, 1e-4)
    test_points: tuple[tuple[float, float, float], ...] = ((0.0, 0.0, 0.0), (0.2, 0.2, 0.4))
    candidates: int = 800
    margin: float = 0.02
    seed: int = 0
    start: Array | None = None


@dataclass(frozen=True)
class PosePlan:
    """Poses in the order of driving.

    Attributes
    ----------
    q : (n, N) rad or m; verify (n,) true for poses to verify with.
    approach : (n, N) direction in which each joint comes to rest; via (n, N) configuration to drive through before.
    seen : (n, cameras) number of targets each camera sees.
    world_T_body : (n, 4, 4) where the nominal robot holds the body.
    predicted : m; predicted error of the tool over the workspace: mean, and worst.
    reached : the wanted accuracy is reached (true where none was asked for).
    travel : sum of the moves as shares of the joint ranges.
    tried, rejected : configurations examined and why they were refused.
    """

    q: Array
    verify: NDArray[np.bool_]
    approach: NDArray[np.int_]
    via: Array
    seen: NDArray[np.int_]
    world_T_body: Array
    predicted: tuple[float, float]
    reached: bool
    travel: float
    tried: int
    rejected: dict[str, int] = field(repr=False)


def generate_poses(request: PoseRequest) -> PosePlan:
    """Poses for an identification (and its verification).

    Raises
    ------
    InvalidInput : numbers out of range, an unknown payload or parameter, or a cell in which nothing can be measured.
    """
    _check(request)
    _names(request)
    rng = np.random.default_rng(request.seed)
    model = request.model
    chain = chain_of(model)
    candidates = find_candidates(model, request.cell, request.candidates, rng, margin=request.margin)
    wanted = request.count + request.verify
    if len(candidates.q) < wanted:
        raise InvalidInput(
            f"only {len(candidates.q)} measurable configurations were found among {candidates.tried}, {wanted} poses "
            f"are wanted (refused: {candidates.rejected}); add cameras, relax the visibility rules or ask for fewer"
        )
    design = design_of(request, candidates)
    ranges = joint_ranges(chain, candidates.q)
    chosen, reached = _choose(request, design, candidates.q, ranges)
    rest = np.setdiff1d(np.arange(len(candidates.q)), chosen)
    checking = rest[spread(candidates.q[rest], ranges, request.verify)] if request.verify else np.empty(0, int)
    rows = np.concatenate([np.array(chosen, dtype=int), checking])
    q = candidates.q[rows]
    order = short_order(q, ranges, request.start)
    rows, q = rows[order], q[order]
    approaches = balanced_approaches(chain, q, rng)
    covariance = covariance_of(design, chosen)
    errors = predicted_errors(design, covariance)
    return PosePlan(
        q=q,
        verify=np.isin(rows, checking),
        approach=approaches.direction,
        via=approaches.via,
        seen=np.sum(candidates.seen[rows], axis=2),
        world_T_body=candidates.world_T_body[rows],
        predicted=(float(np.mean(errors)), float(np.max(errors))),
        reached=reached,
        travel=path_length(q, ranges),
        tried=candidates.tried,
        rejected=candidates.rejected,
    )


def design_of(request: PoseRequest, candidates: Candidates) -> Design:
    """Information of each candidate on the parameters, and where accuracy is wanted."""
    model, cell = request.model, request.cell
    nominal = RobotModel(
        model.name,
        model.frames,
        model.gravity,
        model.gravity_frame,
        {},
        (),
        model.payloads,
        cell.world_T_base,
        cell.flange_T_body,
    )
    kernel = Kernel(nominal)
    poses = kernel.poses(candidates.q, request.payload)
    names = _names(request)
    columns = [kernel.index[name] for name in names]
    _, J = kernel.frames_and_jacobian(kernel.theta0, poses, columns)
    variables = kernel.variables(kernel.theta0, poses)
    moments = np.column_stack([variables[name] for name in moment_names(nominal)])
    priors = plausible_limits(nominal, moments, names)
    priors = np.where(np.isfinite(priors), priors, _LOOSE)
    scaled = J * priors
    root = _information_root(request, candidates)
    test_points = np.asarray(request.test_points, dtype=float).reshape(-1, 3)
    checks = _check_rows(scaled, kernel, poses, test_points)
    return Design(root @ scaled, checks)


def _names(request: PoseRequest) -> tuple[str, ...]:
    """Parameters to identify.

    Raises
    ------
    InvalidInput : a name that the robot does not have.
    """
    names = choose_candidates(request.model, request.parameters).names
    known = set(parameter_names(request.model))
    for name in names:
        if name not in known:
            raise InvalidInput(f"robot '{request.model.name}' has no parameter '{name}'")
    terms = {full for term in request.model.terms for full in term.parameter_names}
    return tuple(name for name in names if name not in terms)


def _information_root(request: PoseRequest, candidates: Candidates) -> Array:
    """Square roots (n, 6, 6) of the information of each candidate's measured frame."""
    cell, n = request.cell, len(candidates.q)
    floor = np.diag([request.sigma[0] ** 2] * 3 + [request.sigma[1] ** 2] * 3)
    covariance = np.broadcast_to(floor, (n, 6, 6)).copy()
    if cell.viewpoints and cell.body is not None:
        information = frame_information(
            candidates.world_T_body, cell.body, cell.viewpoints, candidates.seen, request.sigma_px
        )
        # three targets in one line leave a turn open: the pseudo-inverse would call it exact, a weak prior does not
        covariance += np.linalg.inv(information + 1e-2 * np.eye(6))
    return np.swapaxes(np.linalg.cholesky(np.linalg.inv(covariance)), 1, 2)


def _check_rows(scaled: Array, kernel: Kernel, poses: PoseInputs, points: Array) -> Array:
    """Displacements (m, 3, p) of test points at up to 150 of the candidates: that is where the robot will work."""
    every = max(1, len(poses) // 150)
    rows = scaled[::every]
    # a twist (rho, omega) moves the point p of the tool by rho + omega x p, in tool coordinates
    moved = [rows[:, :3] + np.cross(rows[:, 3:], p[None, :, None], axis=1) for p in points]
    # base and tool are the cell's own measurement, but what they leave uncertain moves the tool all the same
    return np.concatenate(moved)


def _choose(request: PoseRequest, design: Design, q: Array, ranges: Array) -> tuple[list[int], bool]:
    """Chosen candidates, and whether the wanted accuracy is reached."""
    if request.method == "equidistant":
        order = [int(k) for k in spread(q, ranges, request.count, start=_central(q, ranges))]
        if request.accuracy is None:
            return order, True
        for number in range(1, len(order) + 1):
            if np.max(predicted_errors(design, covariance_of(design, order[:number]))) <= request.accuracy:
                return order[:number], True
        return order, False
    wanted = request.accuracy

    def going_on(_: int, error: float) -> bool:
        return wanted is None or error > wanted

    choose = choose_d_optimal if request.method == "d_optimal" else choose_worst_case
    chosen = choose(design, request.count, progress=going_on)
    if request.method == "d_optimal" and wanted is None:
        chosen = exchange(design, chosen)
    worst = float(np.max(predicted_errors(design, covariance_of(design, chosen))))
    return chosen, wanted is None or worst <= wanted


def _central(q: Array, ranges: Array) -> int:
    return int(np.argmin(np.linalg.norm((q - np.median(q, axis=0)) / ranges, axis=1)))


def _check(request: PoseRequest) -> None:
    if request.count < 1 or request.verify < 0 or request.candidates < 1:
        raise InvalidInput("the numbers of poses and candidates must be positive")
    if request.method not in ("d_optimal", "worst_case", "equidistant"):
        raise InvalidInput(f"method must be d_optimal, worst_case or equidistant, not '{request.method}'")
    if request.accuracy is not None and not (np.isfinite(request.accuracy) and request.accuracy > 0):
        raise InvalidInput("the wanted accuracy must be a positive length")
    if not (request.sigma_px > 0 and min(request.sigma) > 0):
        raise InvalidInput("the accuracies of image points and frames must be positive")
    if not 0.0 <= request.margin < 0.5:
        raise InvalidInput("the margin to the joint limits must be a share between 0 and 0.5 of the range")
    if request.payload is not None and request.payload not in request.model.payloads:
        known = ", ".join(request.model.payloads) or "none"
        raise InvalidInput(f"the robot has no payload '{request.payload}'; known: {known}")
    if request.start is not None and np.shape(request.start) != (request.model.n_joints,):
        raise InvalidInput(f"the start configuration needs {request.model.n_joints} joint values")
