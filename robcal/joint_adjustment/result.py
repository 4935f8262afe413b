"""Result of a joint adjustment: the robot and the station with their part of the one covariance."""

from dataclasses import dataclass, field, replace

import numpy as np

from robcal.calibration.calibrated import CalibratedRobot
from robcal.estimation.summary import SolveSummary
from robcal.joint_adjustment.cofactors import Cofactors, cofactors
from robcal.joint_adjustment.problem import JointAt, JointProblem, JointState, Limits
from robcal.photogrammetry.station.adjustment import interior_basis
from robcal.photogrammetry.station.network import RejectedMark, StationOrientation
from robcal.transforms import Array


@dataclass(frozen=True)
class JointAdjustment:
    """Station, body and robot adjusted together.

    Attributes
    ----------
    robot : with the covariance that cameras and body have a part in; its joints scatter as estimated.
    orientation : the station with its cameras, covariance, body and noise as adjusted now. The linearised model inside
        is still that of the station by itself.
    relative : (p, p) covariance of its parameters with cameras and body as they were found.
    covariance : (g + p, g + p) of everything: exterior and interior orientations as in the covariance of
        ``orientation``, coordinates of the body, parameters of the robot.
    joint_sigma : (N,) scatter of the joints, rad or m: what they do not repeat and what the model lacks.
    loose : rows of the joint log of poses found not to stand where the robot's joints say.
    rejected : marks left out beside those that the station left out.
    marks : number of marks used; poses : of poses that hang on the robot.
    sigma0 : root of the sum of squares over the redundancy; the variance components make it one.
    """

    robot: CalibratedRobot
    orientation: StationOrientation = field(repr=False)
    relative: Array = field(repr=False)
    covariance: Array = field(repr=False)
    joint_sigma: Array
    loose: tuple[int, ...]
    rejected: tuple[RejectedMark, ...]
    marks: int
    poses: int
    sigma0: float
    summary: SolveSummary
    seconds: float


@dataclass(frozen=True)
class Solution:
    """Where an adjustment ended."""

    problem: JointProblem
    here: JointAt
    limits: Limits | None
    summary: SolveSummary

    def cofactors(self) -> Cofactors:
        """Covariances and redundancies there."""
        return cofactors(self.problem, self.here, self.limits)


def result_of(
    solution: Solution,
    robot: CalibratedRobot,
    orientation: StationOrientation,
    rejected: list[RejectedMark],
    loose: list[int],
    seconds: float,
) -> JointAdjustment:
    """The result from the last solution; ``robot`` and ``orientation`` are those that it started from."""
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
    covariance = _by_numbers(problem, state, found.shared)
    return JointAdjustment(
        robot=adjusted,
        orientation=_oriented(problem, state, covariance, orientation, rejected),
        relative=found.robot_alone,
        covariance=covariance,
        joint_sigma=problem.joint_sigma,
        loose=tuple(sorted(loose)),
        rejected=tuple(rejected),
        marks=len(problem.marks),
        poses=int(problem.tied.sum()),
        sigma0=float(np.sqrt(square / redundancy)) if redundancy > 0 else float("nan"),
        summary=solution.summary,
        seconds=seconds,
    )


def _by_numbers(problem: JointProblem, state: JointState, shared: Array) -> Array:
    """(g + p, g + p) covariance of all unknowns of station and robot, zero for those held; interiors as numbers."""
    g, p = len(problem.active), len(problem.columns)
    e = problem.counts[0]
    by_unknown = np.eye(g + p)
    for i, basis in enumerate(interior_basis(state.station.interior)):
        at = slice(6 * e + 9 * i, 6 * e + 9 * i + 9)
        by_unknown[at, at] = basis
    on = np.concatenate([np.flatnonzero(problem.active), np.arange(g, g + p)])
    J = by_unknown[:, on]
    return np.asarray(J @ shared @ J.T)


def _oriented(
    problem: JointProblem,
    state: JointState,
    covariance: Array,
    orientation: StationOrientation,
    rejected: list[RejectedMark],
) -> StationOrientation:
    """The station as adjusted with the robot; ``covariance`` of its numbers, then of the robot's."""
    g, x = len(problem.active), state.station
    e, c = problem.counts
    size = 6 * e + 9 * c
    seen = np.isin(np.arange(len(x.points)), problem.marks.target)
    both = np.repeat(seen, 3)
    before = orientation.body.covariance
    C = covariance[size:g, size:g]
    if before is not None:
        C = np.where(np.outer(~both, ~both), before, C)
    body = replace(orientation.body, points=np.where(seen[:, None], x.points, orientation.body.points), covariance=C)
    return replace(
        orientation,
        cameras=tuple(camera.with_vector(x.interior[i]) for i, camera in enumerate(problem.cameras)),
        world_T_exterior=x.world_T_exterior,
        covariance=covariance[:size, :size],
        body=body,
        noise=dict(zip(orientation.names, map(float, problem.noise), strict=True)),
        rejected=(*orientation.rejected, *rejected),
    )
