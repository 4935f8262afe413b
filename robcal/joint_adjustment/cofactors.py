"""What a solution of the joint adjustment says of its unknowns, of its marks and of its poses."""

from dataclasses import dataclass

import numpy as np

from robcal.estimation.schur import Factor
from robcal.joint_adjustment.problem import JointAt, JointProblem, Limits
from robcal.photogrammetry.station.adjustment import mark_redundancy
from robcal.transforms import Array


@dataclass(frozen=True)
class Cofactors:
    """Covariances of the unknowns at a solution, and redundancies.

    Attributes
    ----------
    shared : (a + p, a + p) of the active unknowns of the station, then the robot's parameters.
    scatter : (n, 6, 6) of the scatter of each pose.
    marks : (m, 2, 2) redundancy matrices of the whitened marks.
    poses : (n, 6, 6) covariance of the twist of each body, m and rad.
    robot_alone : (p, p) covariance of the robot's parameters with cameras and body as they were found: against frames
        that these very cameras measure.
    """

    shared: Array
    scatter: Array
    marks: Array
    poses: Array
    robot_alone: Array


def cofactors(problem: JointProblem, here: JointAt, limits: Limits | None) -> Cofactors:
    """Covariances at a solution, of weighted observations where there are ``limits``."""
    normals = problem.normals(here, limits)
    found = Factor(normals)
    Q = found.cofactors()
    own, mixed = found.station_cofactors(Q)  # (n, 6, 6), (a + p, n, 6)
    a = len(Q) - len(problem.columns)
    J, R = here.by_robot, np.where(problem.tied[:, None, None], problem.root, np.eye(6))
    by_scatter = np.swapaxes(R, 1, 2)
    with_robot = mixed[a:].transpose(1, 0, 2)  # (n, p, 6)
    cross = J @ with_robot @ by_scatter
    poses = J @ Q[a:, a:] @ np.swapaxes(J, 1, 2) + cross + np.swapaxes(cross, 1, 2) + R @ own @ by_scatter
    on = np.flatnonzero(problem.active)
    g = len(problem.active)
    whole = np.zeros((g, g))
    whole[np.ix_(on, on)] = Q[:a, :a]
    twists = np.zeros((len(J), g, 6))
    twists[:, on] = Q[:a, a:] @ np.swapaxes(J, 1, 2) + mixed[:a].transpose(1, 0, 2) @ by_scatter
    marks = mark_redundancy(here.lin, problem.marks, problem.counts, whole, twists, poses)
    alone = Factor(normals, held=np.arange(len(Q)) < a).cofactors()[a:, a:]
    return Cofactors(Q, own, marks, poses, alone)
