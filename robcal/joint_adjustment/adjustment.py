"""The joint adjustment: robust at first, then least squares without what contradicts it, with its variance components.

Sources: variance components by sums of squares over redundancies: Foerstner (1979); tests: Baarda (1968).
"""

import time
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from scipy import special, stats

from robcal.calibration.calibrated import CalibratedRobot
from robcal.calibration.joint_log import JointLog
from robcal.calibration.measurements import Rows
from robcal.calibration.outliers import suspicious
from robcal.estimation.levenberg import levenberg
from robcal.estimation.summary import SolveSummary, TerminationSettings
from robcal.joint_adjustment.assembly import assemble
from robcal.joint_adjustment.cofactors import Cofactors, cofactors
from robcal.joint_adjustment.problem import JointAt, JointProblem, JointState, Limits
from robcal.photogrammetry.station.adjustment import interior_basis
from robcal.photogrammetry.station.cleaning import mark_statistic
from robcal.photogrammetry.station.network import RejectedMark, StationMarks, StationOrientation
from robcal.transforms import Array

ROBUST = Limits(2.0, 3.5)
CRITICAL = 4.0
"""Normalised residual from which on a mark is a gross error."""
ROBUST_FACTOR = 2.0
"""The limit on squared residuals is this many times wider where gross errors still pull at the solution."""
ROUNDS, STEPS = 20, 30
NEGLIGIBLE = 1e-3
"""Half the sum of squares (of whitened residuals) that is no reason for another step."""
LEAST_SIGMA = 1e-9
"""Scatter of a joint (rad, m) that counts as none."""
SETTLED = 0.02
"""Relative change of all variance components below which they stay."""
_MEDIAN_2, _MEDIAN_6 = float(special.chdtri(2, 0.5)), float(special.chdtri(6, 0.5))


@dataclass(frozen=True)
class JointAdjustment:
    """Station, body and robot adjusted together.

    Attributes
    ----------
    robot : with the covariance that cameras and body have a part in; its joints scatter as estimated.
    orientation : the station with its cameras, covariance, body and noise as adjusted now. The linearised model inside
        is still that of the station by itself.
    joint_sigma : (N,) scatter of the joints, rad or m: what they do not repeat and what the model lacks.
    loose : rows of the joint log of poses found not to stand where the robot's joints say.
    rejected : marks left out beside those that the station left out.
    marks : number of marks used; poses : of poses that hang on the robot.
    sigma0 : root of the sum of squares over the redundancy; the variance components make it one.
    """

    robot: CalibratedRobot
    orientation: StationOrientation = field(repr=False)
    joint_sigma: Array
    loose: tuple[int, ...]
    rejected: tuple[RejectedMark, ...]
    marks: int
    poses: int
    sigma0: float
    summary: SolveSummary
    seconds: float


@dataclass(frozen=True)
class _Solution:
    problem: JointProblem
    here: JointAt
    limits: Limits | None
    summary: SolveSummary

    def cofactors(self) -> Cofactors:
        return cofactors(self.problem, self.here, self.limits)


def adjust_jointly(
    orientation: StationOrientation,
    marks: Mapping[str, StationMarks],
    robot: CalibratedRobot,
    log: JointLog,
    tied: Rows,
) -> JointAdjustment:
    """Adjust marks, cameras, body coordinates, base, tool and the robot's parameters together.

    The staged results are the start, and their choices hold: which parameters of robot and lenses are free, which marks
    are gross errors. Which poses were left out is looked at anew.

    Parameters
    ----------
    orientation : of the station by itself. marks : camera -> all identified marks, by row of the joint log.
    robot : identified from that station's frames; its fitted parameters are adjusted.
    tied : rows of the joint log that the robot is identified from; marks of all other poses orient the cameras only.

    Raises
    ------
    InvalidInput : no mark of a pose to identify from is left.
    """
    clock = time.perf_counter()
    problem, start, rows = assemble(orientation, marks, robot, log, tied)
    solution = _settled(_solve(problem, problem.at(start, ROBUST), ROBUST), robust=True)
    solution, rejected, loose = _tested(solution, orientation, rows)
    return _result(solution, robot, orientation, rejected, loose, time.perf_counter() - clock)


def _solve(problem: JointProblem, start: JointAt, limits: Limits | None, steps: int = STEPS) -> _Solution:
    settings = TerminationSettings(steps, 12, 0.0, NEGLIGIBLE)
    here, summary = levenberg(lambda at: problem.local(at, limits), start, settings)
    return _Solution(problem, here, limits, summary)


def _settled(solution: _Solution, *, robust: bool, rounds: int = 10) -> _Solution:
    """Solved again with the variance components that its residuals show, until these stay."""
    limits = solution.limits
    for _ in range(rounds):
        noise, scatter = _variance_factors(solution, solution.cofactors(), robust=robust)
        problem, state = _rescaled(solution.problem, solution.here.state, noise, scatter)
        start = problem.at(state, limits, solution.here)
        if max(np.abs(np.log(noise)).max(), abs(np.log(scatter))) < SETTLED:
            return _solve(problem, start, limits)
        solution = _solve(problem, start, limits, steps=1)
    return _solve(solution.problem, solution.here, limits)


def _variance_factors(solution: _Solution, found: Cofactors, *, robust: bool) -> tuple[Array, float]:
    """Factors on the standard deviations of each camera's marks (c,) and of the joints' scatter."""
    problem, here = solution.problem, solution.here
    square = np.sum(here.lin.residual**2, axis=1)
    share = np.einsum("mii->m", found.marks)
    noise = np.ones(len(problem.cameras))
    for c in range(len(noise)):
        rows = problem.marks.camera == c
        if rows.any():
            noise[c] = _factor(square[rows], share[rows], 2, _MEDIAN_2, robust)
    joints = min(6, problem.kernel.model.n_joints)
    u = here.state.scatter[problem.tied]
    own = joints - np.trace(found.scatter[problem.tied][:, :joints, :joints], axis1=1, axis2=2)
    scatter = _factor(np.sum(u**2, axis=1), own, joints, _MEDIAN_6, robust)
    return noise, float(np.clip(scatter, 0.02, 50.0))


def _factor(square: Array, share: Array, count: int, median: float, robust: bool) -> float:
    """Root of squares over redundancies; from the median of the squares where there may be gross errors."""
    total = float(share.sum())
    if robust:
        part = max(total / (count * len(share)), 0.05)
        return float(np.sqrt(max(np.median(square), 1e-12) / (median * part)))
    return float(np.sqrt((1.0 + square.sum()) / (1.0 + total)))  # one degree of freedom for what was before


def _rescaled(
    problem: JointProblem, state: JointState, noise: Array, scatter: float
) -> tuple[JointProblem, JointState]:
    """With other variance components; frames stay where they are."""
    largest = float(problem.joint_sigma.max())
    scatter = max(scatter, LEAST_SIGMA / largest)
    problem = replace(
        problem, noise=problem.noise * noise, joint_sigma=problem.joint_sigma * scatter, root=problem.root * scatter
    )
    u = np.where(problem.tied[:, None], state.scatter / scatter, state.scatter)
    return problem, replace(state, scatter=u)


def _tested(
    solution: _Solution, orientation: StationOrientation, rows: Rows
) -> tuple[_Solution, list[RejectedMark], list[int]]:
    """Least squares without marks that contradict all others, and with poses free that do."""
    rejected: list[RejectedMark] = []
    loose: list[int] = []
    limit = float(stats.chi2.isf(2 * stats.norm.sf(CRITICAL), 2))
    for _ in range(ROUNDS):
        found = solution.cofactors()
        problem, state, limits = solution.problem, solution.here.state, solution.limits
        out = _worst_marks(solution, found, limit if limits is None else ROBUST_FACTOR * limit)
        moved = None if out.any() else _worst_pose(solution, found)  # single marks may make a pose look as if moved
        if out.any():
            table = problem.marks.select(out)
            ids = orientation.body.ids[table.target]
            why = "contradicts all other marks and the robot"
            columns = zip(table.camera, rows[table.pose], ids, strict=True)
            rejected += [RejectedMark(orientation.names[c], int(p), int(t), why) for c, p, t in columns]
            problem = problem.without_marks(out)
        elif moved is not None:
            loose.append(int(rows[moved]))
            problem, state = _freed(problem, state, moved)
        elif limits is None:
            break
        else:
            limits = None
        start = problem.at(state, limits, solution.here)
        solution = _settled(_solve(problem, start, limits), robust=limits is not None, rounds=3)
    return _settled(solution, robust=False), rejected, loose


def _worst_pose(solution: _Solution, found: Cofactors) -> int | None:
    """The pose that stands out most from how the joints scatter; None if none does."""
    problem = solution.problem
    u = solution.here.state.scatter
    redundancy = np.eye(6) - found.scatter
    freedom = np.sum(np.linalg.eigvalsh(redundancy) > 1e-3, axis=1) * problem.tied
    square = mark_statistic(u, redundancy) / np.maximum(freedom, 1)
    some = suspicious(square, freedom, problem.tied.astype(float))
    return max(some, key=lambda i: float(square[i])) if some else None


def _worst_marks(solution: _Solution, found: Cofactors, limit: float) -> np.ndarray:
    """(m,) the worst mark of each image, where it is beyond the limit."""
    marks = solution.problem.marks
    T2 = mark_statistic(solution.here.lin.residual, found.marks)
    image = marks.camera * (int(marks.pose.max()) + 1) + marks.pose
    worst = np.zeros(int(image.max()) + 1)
    np.maximum.at(worst, image, T2)
    return (limit < T2) & (worst[image] == T2)


def _freed(problem: JointProblem, state: JointState, pose: int) -> tuple[JointProblem, JointState]:
    """With a pose that no longer hangs on the robot: free about where it was found."""
    tied, reference, scatter = problem.tied.copy(), problem.reference.copy(), state.scatter.copy()
    tied[pose], reference[pose], scatter[pose] = False, state.station.world_T_body[pose], 0.0
    return replace(problem, tied=tied, reference=reference), replace(state, scatter=scatter)


def _result(
    solution: _Solution,
    robot: CalibratedRobot,
    orientation: StationOrientation,
    rejected: list[RejectedMark],
    loose: list[int],
    seconds: float,
) -> JointAdjustment:
    problem, here = solution.problem, solution.here
    found = solution.cofactors()
    state, p = here.state, len(problem.columns)
    values = {n: float(v) for n, v in zip(problem.kernel.names, state.robot.theta, strict=True)}
    model = replace(
        robot.model.with_parameters(values),
        world_T_base=state.robot.world_T_base,
        flange_T_tool=state.robot.flange_T_tool,
    )
    redundancy = float(np.einsum("mii->", found.marks)) + float(
        np.sum(6 - np.einsum("nii->n", found.scatter)[problem.tied])
    )
    square = float(np.sum(here.lin.residual**2)) + float(np.sum(state.scatter[problem.tied] ** 2))
    adjusted = replace(
        robot,
        model=model,
        covariance=found.shared[-p:, -p:],
        covariance_scale=1.0,
        joint_sigma=problem.joint_sigma.tolist(),
    )
    return JointAdjustment(
        robot=adjusted,
        orientation=_oriented(problem, state, found, orientation, rejected),
        joint_sigma=problem.joint_sigma,
        loose=tuple(sorted(loose)),
        rejected=tuple(rejected),
        marks=len(problem.marks),
        poses=int(problem.tied.sum()),
        sigma0=float(np.sqrt(square / redundancy)) if redundancy > 0 else float("nan"),
        summary=solution.summary,
        seconds=seconds,
    )


def _oriented(
    problem: JointProblem,
    state: JointState,
    found: Cofactors,
    orientation: StationOrientation,
    rejected: list[RejectedMark],
) -> StationOrientation:
    """The station as adjusted with the robot."""
    on, g, x = np.flatnonzero(problem.active), len(problem.active), state.station
    whole = np.zeros((g, g))
    whole[np.ix_(on, on)] = found.shared[: len(on), : len(on)]
    e, c = problem.counts
    size = 6 * e + 9 * c
    to_numbers = np.eye(size)
    for i, basis in enumerate(interior_basis(x.interior)):
        at = slice(6 * e + 9 * i, 6 * e + 9 * i + 9)
        to_numbers[at, at] = basis
    seen = np.isin(np.arange(len(x.points)), problem.marks.target)
    both = np.repeat(seen, 3)
    before = orientation.body.covariance
    C = whole[size:, size:]
    if before is not None:
        C = np.where(np.outer(~both, ~both), before, C)
    body = replace(orientation.body, points=np.where(seen[:, None], x.points, orientation.body.points), covariance=C)
    return replace(
        orientation,
        cameras=tuple(camera.with_vector(x.interior[i]) for i, camera in enumerate(problem.cameras)),
        world_T_exterior=x.world_T_exterior,
        covariance=to_numbers @ whole[:size, :size] @ to_numbers.T,
        body=body,
        noise=dict(zip(orientation.names, map(float, problem.noise), strict=True)),
        rejected=(*orientation.rejected, *rejected),
    )
