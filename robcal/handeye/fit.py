"""A problem solved with its variance components, and what its images say of it."""

from dataclasses import dataclass, replace

import numpy as np

from robcal.handeye.data import BoolArray
from robcal.handeye.images import ImageTwists
from robcal.handeye.problem import Problem, Solved
from robcal.handeye.unknowns import State, Variances
from robcal.handeye.variance import estimate
from robcal.photogrammetry.core.bodies import IntArray
from robcal.photogrammetry.core.camera import project
from robcal.transforms import Array, transform

ROUNDS = 4
SETTLED = 1e-3
"""Relative change of the criterion's variance components below which no further round is needed."""


@dataclass(frozen=True)
class Fit:
    """``solved`` with the variance components of highest restricted likelihood, ``criterion`` there."""

    problem: Problem
    solved: Solved
    criterion: float

    def statistics(self, used: BoolArray) -> Array:
        """(n,) chi-square (6) of each image against all that were used; NaN without marks."""
        return ImageTwists.of(self.solved).statistics(self.solved, self.solved.covariance(), used)

    def pixels(self, twist: Array | None = None) -> Array:
        """(m, 2) px from where marks are predicted to where they are; without the robot's misses by default."""
        state, problem = self.solved.state, self.problem
        data = problem.data
        state = replace(state, twist=np.zeros_like(state.twist) if twist is None else twist)
        p_camera = self.points(state)
        views = problem.views(state, problem.flanges(state)[0])
        return data.xy - project(state.camera, p_camera) - problem.eccentricity(state.camera, views, p_camera)

    def points(self, state: State) -> Array:
        """(m, 3) targets of the marks in the camera."""
        problem = self.problem
        views = problem.views(state, problem.flanges(state)[0])
        return transform(views[problem.data.image], problem.drawn(state))

    def image_px(self) -> Array:
        """(n,) root mean square distance of the marks of each image from where robot and calibration put them."""
        return mean_by_image(np.sum(self.pixels() ** 2, axis=1), self.problem.data.image, self.problem.data.n)

    def millimetres(self) -> Array:
        """(m,) squared distances, m^2, across the line of sight at the board, of marks from where they are put."""
        state = replace(self.solved.state, twist=np.zeros_like(self.solved.state.twist))
        depth = self.points(state)[:, 2] / np.sqrt(state.camera.fx * state.camera.fy)
        return np.sum(self.pixels() ** 2, axis=1) * depth**2


def mean_by_image(square: Array, image: IntArray, n: int) -> Array:
    """Roots (n,) of the means of squares (m,) over images; NaN for one without marks."""
    count = np.bincount(image, minlength=n)
    with np.errstate(invalid="ignore"):
        return np.sqrt(np.bincount(image, weights=square, minlength=n) / np.where(count > 0, count, np.nan))


def fitted(problem: Problem, start: State, variances: Variances) -> Fit:
    """Solve and estimate the variance components in turn until both stand."""
    solved = problem.solve(start, variances)
    criterion = np.inf
    for attempt in range(ROUNDS):
        found, criterion = estimate(solved.system, solved.variances, wide=attempt == 0)
        settled = _near(found, solved.variances)
        solved = problem.solve(solved.state, found)
        if settled:
            break
    return Fit(problem, solved, criterion)


def _near(a: Variances, b: Variances) -> bool:
    first = np.array([a.pixel, a.place, a.turn, a.robot_place, a.robot_turn])
    second = np.array([b.pixel, b.place, b.turn, b.robot_place, b.robot_turn])
    return bool(np.all(np.abs(first - second) <= SETTLED * np.abs(second) + 1e-9))
