"""The joint adjustment: robust at first, then least squares without what contradicts it, with its variance components.

Sources: variance components by sums of squares over redundancies: Foerstner (1979); tests: Baarda (1968).
"""

import time
from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from scipy import special, stats

from robcal.calibration.calibrated import CalibratedRobot
from robcal.calibration.joint_log import JointLog
from robcal.calibration.measurements import Rows
from robcal.calibration.outliers import suspicious
from robcal.estimation.levenberg import levenberg
from robcal.estimation.summary import TerminationSettings
from robcal.joint_adjustment.assembly import assemble
from robcal.joint_adjustment.cofactors import Cofactors
from robcal.joint_adjustment.problem import JointAt, JointProblem, JointState, Limits
from robcal.joint_adjustment.result import JointAdjustment, Solution, result_of
from robcal.photogrammetry.station.cleaning import mark_statistic
from robcal.photogrammetry.station.network import RejectedMark, StationMarks, StationOrientation
from robcal.transforms import Array

ROBUST = Limits(2.0, 3.5)
CRITICAL = 4.0
"""Normalised residual from which on a mark is a gross error."""
ROBUST_FACTOR = 2.0
"""The limit on squared residuals is this many times wider where gross errors still pull at the solution."""
FEWEST_MARKS = 3
"""Marks of a pose from which on they can outvote the robot."""
ROUNDS, STEPS = 20, 30
NEGLIGIBLE = 1e-3
"""Half the sum of squares (of whitened residuals) that is no reason for another step."""
ROBUST_SIGMA = 1e-5
"""Scatter of a joint (rad, m) that is the least as long as poses may have moved: without any, one that moved would be
forced into its marks."""
LEAST_SIGMA = 1e-9
"""Scatter of a joint (rad, m) that counts as none."""
SETTLED = 0.02
"""Relative change of all variance components below which they stay."""
_MEDIAN_2, _MEDIAN_6 = float(special.chdtri(2, 0.5)), float(special.chdtri(6, 0.5))


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
    return result_of(solution, robot, orientation, rejected, loose, time.perf_counter() - clock)


def _solve(problem: JointProblem, start: JointAt, limits: Limits | None, steps: int = STEPS) -> Solution:
    settings = TerminationSettings(steps, 12, 0.0, NEGLIGIBLE)
    here, summary = levenberg(lambda at: problem.local(at, limits), start, settings)
    return Solution(problem, here, limits, summary)


def _settled(solution: Solution, *, robust: bool, rounds: int = 10) -> Solution:
    """Solved again with the variance components that its residuals show, until these stay."""
    limits = solution.limits
    for _ in range(rounds):
        noise, scatter = _variance_factors(solution, solution.cofactors(), robust=robust)
        problem, state = _rescaled(solution.problem, solution.here.state, noise, scatter, robust)
        start = problem.at(state, limits, solution.here)
        if max(np.abs(np.log(noise)).max(), abs(np.log(scatter))) < SETTLED:
            return _solve(problem, start, limits)
        solution = _solve(problem, start, limits, steps=1)
    return _solve(solution.problem, solution.here, limits)


def _variance_factors(solution: Solution, found: Cofactors, *, robust: bool) -> tuple[Array, float]:
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
    problem: JointProblem, state: JointState, noise: Array, scatter: float, robust: bool
) -> tuple[JointProblem, JointState]:
    """With other variance components; frames stay where they are."""
    largest = float(problem.joint_sigma.max())
    scatter = max(scatter, (ROBUST_SIGMA if robust else LEAST_SIGMA) / largest)
    problem = replace(
        problem, noise=problem.noise * noise, joint_sigma=problem.joint_sigma * scatter, root=problem.root * scatter
    )
    u = np.where(problem.tied[:, None], state.scatter / scatter, state.scatter)
    return problem, replace(state, scatter=u)


def _tested(
    solution: Solution, orientation: StationOrientation, rows: Rows
) -> tuple[Solution, list[RejectedMark], list[int]]:
    """Least squares without marks that contradict all others, and with poses free that do."""
    rejected: list[RejectedMark] = []
    loose: list[int] = []
    limit = float(stats.chi2.isf(2 * stats.norm.sf(CRITICAL), 2))
    for _ in range(ROUNDS):
        found = solution.cofactors()
        problem, state, limits = solution.problem, solution.here.state, solution.limits
        out, moved = _worst_marks(solution, found, limit if limits is None else ROBUST_FACTOR * limit)
        if moved is None and not out.any():  # single marks may make a pose look as if moved
            moved = _worst_pose(solution, found)
        if moved is None and out.any():
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


def _worst_pose(solution: Solution, found: Cofactors) -> int | None:
    """The pose that stands out most from how the joints scatter; None if none does."""
    problem = solution.problem
    u = solution.here.state.scatter
    redundancy = np.eye(6) - found.scatter
    freedom = np.sum(np.linalg.eigvalsh(redundancy) > 1e-3, axis=1) * problem.tied
    square = mark_statistic(u, redundancy) / np.maximum(freedom, 1)
    some = suspicious(square, freedom, problem.tied.astype(float))
    return max(some, key=lambda i: float(square[i])) if some else None


def _worst_marks(solution: Solution, found: Cofactors, limit: float) -> tuple[np.ndarray, int | None]:
    """(m,) the worst mark of each image, where it is beyond the limit; and the pose to which most such marks belong.

    Where more than half of a pose's marks are beyond it, they are right and the pose is not where the robot takes it.
    """
    marks = solution.problem.marks
    T2 = mark_statistic(solution.here.lin.residual, found.marks)
    image = marks.camera * (int(marks.pose.max()) + 1) + marks.pose
    worst = np.zeros(int(image.max()) + 1)
    np.maximum.at(worst, image, T2)
    count, bad = np.bincount(marks.pose), np.bincount(marks.pose, weights=limit < T2)
    moved = solution.problem.tied & (count >= FEWEST_MARKS) & (bad > 0.5 * count)
    return (limit < T2) & (worst[image] == T2), int(np.argmax(bad * moved)) if moved.any() else None


def _freed(problem: JointProblem, state: JointState, pose: int) -> tuple[JointProblem, JointState]:
    """With a pose that no longer hangs on the robot: free about where it was found."""
    tied, reference, scatter = problem.tied.copy(), problem.reference.copy(), state.scatter.copy()
    tied[pose], reference[pose], scatter[pose] = False, state.station.world_T_body[pose], 0.0
    return replace(problem, tied=tied, reference=reference), replace(state, scatter=scatter)
