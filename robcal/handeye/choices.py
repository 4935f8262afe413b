"""What else the images carry: a small move of board or camera, the shape of the board, the robot's geometry."""

from dataclasses import replace

import numpy as np

from robcal.handeye.data import BoolArray
from robcal.handeye.fit import Fit, fitted
from robcal.handeye.images import ImageTwists, find_step
from robcal.handeye.moves import LEAST_GAIN, Jump, moved_frames
from robcal.handeye.shape import SHAPE_NAMES, shape_columns
from robcal.handeye.unknowns import Variances
from robcal.photogrammetry.core.bodies import IntArray
from robcal.transforms import Array

SHAPE_LIMITS = {1: 16.0, 3: 22.0}
"""Chi-square from which on one deviation of the board counts, or three together: less than one exact board in 10 000.
A scale that is taken up by mistake costs more than many small ones that are not."""
ROBOT_GAIN = 12.0
"""Twice the log likelihood that two further variance components, those of the robot's geometry, must gain."""
MOVE_SIGMAS = 6.0
"""A move counts where its shift or its turn has so many standard deviations."""


def awake(variances: Variances) -> Variances:
    """Components that are zero start small, not nowhere."""
    return replace(variances, place=max(variances.place, 1e-5), turn=max(variances.turn, 1e-5))


def jumped(jump: Jump, X: Array, Z: Array, n: int) -> tuple[Array, Array, IntArray, IntArray]:
    after: IntArray = (np.arange(n) >= jump.image).astype(np.int64)
    none: IntArray = np.zeros(n, dtype=np.int64)
    if jump.kind == "board":
        return X, moved_frames(Z[0], jump), none, after
    return moved_frames(X[0], jump), Z, after, none


def with_step(fit: Fit, used: BoolArray) -> Fit | None:
    """With a small move of board or camera, if one explains most of what the images miss by."""
    layout, state = fit.problem.layout, fit.solved.state
    if len(state.X) > 1 or len(state.Z) > 1:
        return None
    step = find_step(fit.solved, ImageTwists.of(fit.solved), layout, used)
    if step is None or step.gain < LEAST_GAIN:
        return None
    jump = Jump(step.kind, step.image, False, step.change, step.gain)
    X, Z, of_X, of_Z = jumped(jump, state.X, state.Z, len(used))
    problem = replace(fit.problem, layout=replace(layout, of_X=of_X, of_Z=of_Z))
    moved = fitted(problem, replace(state, X=X, Z=Z), awake(fit.solved.variances))
    part = problem.layout.parts(moved.solved.state)[1 if step.kind == "board" else 0]
    C = moved.solved.covariance()[part, part]
    J = np.concatenate([-np.eye(6), np.eye(6)], axis=1)
    sure = step.change @ np.linalg.solve(J @ C @ J.T, step.change) > MOVE_SIGMAS**2
    return moved if sure else None


def with_shape(fit: Fit, tries: int = 3) -> Fit:
    """With the deviations of the board that the images show beyond doubt, and its scale where that is uncertain."""
    problem = fit.problem
    names = shape_columns(problem.data.body)
    free = np.array([SHAPE_NAMES.index(name) for name in names], dtype=np.int64)
    if not len(free) or tries == 0:
        return fit
    wanted = replace(problem, layout=replace(problem.layout, shape=free))
    value, C = wanted.estimated_shape(fit.solved)
    uncertain = problem.data.scale_sigma is not None
    groups = [np.flatnonzero(free == 0), np.flatnonzero(free > 0)]
    clear = [len(g) and value[g] @ np.linalg.solve(C[np.ix_(g, g)], value[g]) > SHAPE_LIMITS[len(g)] for g in groups]
    kept = [g for g, sure in zip(groups, clear, strict=True) if sure or (uncertain and 0 in free[g])]
    if not kept:
        return fit
    chosen = free[np.concatenate(kept)]
    if np.array_equal(chosen, problem.layout.shape):
        return fit
    problem = replace(problem, layout=replace(problem.layout, shape=chosen))
    # a large bend may hide a scale at first
    return with_shape(fitted(problem, fit.solved.state, awake(fit.solved.variances)), tries - 1)


def without_shape(fit: Fit) -> Fit:
    state = replace(fit.solved.state, shape=np.zeros(len(SHAPE_NAMES)))
    layout = replace(fit.problem.layout, shape=np.zeros(0, dtype=np.int64))
    if not len(fit.problem.layout.shape):
        return fit
    return fitted(replace(fit.problem, layout=layout), state, awake(fit.solved.variances))


def with_robot(fit: Fit, used: BoolArray) -> Fit | None:
    """With the robot's geometry, if its variance components raise the likelihood enough; None if they do not."""
    problem, state = fit.problem, fit.solved.state
    assert problem.data.robot is not None
    if 6 * int(used.sum()) < 12 + len(problem.data.robot.names) // 2:
        return None
    start = replace(state, robot=np.zeros(len(problem.data.robot.names)))
    variances = replace(awake(fit.solved.variances), robot_place=3e-4, robot_turn=1e-3)
    adjusted = fitted(replace(problem, layout=replace(problem.layout, robot=True)), start, variances)
    return adjusted if fit.criterion - adjusted.criterion > ROBOT_GAIN else None
