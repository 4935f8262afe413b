"""Minimisation of a bundle adjustment with optional Huber weights, and eccentricity.

The problem is what stays fixed during one minimisation; the state is what moves.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from robcal.estimation.levenberg import Linearised, levenberg
from robcal.estimation.robust import huber_costs, huber_weights, median_scale
from robcal.estimation.schur import Factor
from robcal.estimation.summary import SolveSummary, TerminationSettings
from robcal.photogrammetry.bundle.datum import Datum
from robcal.photogrammetry.bundle.normals import (
    LinearisedLengths,
    MarkOrder,
    State,
    build_normals,
    linearise,
    linearise_lengths,
    whitened_residuals,
)
from robcal.photogrammetry.core.camera import project
from robcal.photogrammetry.core.eccentricity import body_normals, centre_shift, rim_offset
from robcal.photogrammetry.core.network import IntArray
from robcal.transforms import Array


@dataclass(frozen=True)
class Bars:
    """Scale bars of a problem: rows (b, 2) of their end points, length and sigma (b,) in m (scaled)."""

    rows: IntArray
    length: Array
    sigma: Array

    @classmethod
    def none(cls) -> "Bars":
        """No scale bars."""
        return cls(np.zeros((0, 2), np.int64), np.zeros(0), np.zeros(0))


@dataclass(frozen=True)
class Problem:
    """Marks in order, free changes of the intrinsics (9, k), datum, bars, and the size of the targets.

    ``group`` (m,) and ``group_sigma`` (g,): variance components by which the stated covariances are multiplied.
    ``normals`` (t, 3) or None (from the body's shape); ``radii`` (t,) m, 0: eccentricity not modelled.
    """

    order: MarkOrder
    basis: Array
    datum: Datum
    bars: Bars
    radii: Array
    normals: Array | None
    group: IntArray
    group_sigma: Array

    @property
    def weights(self) -> Array:
        """Weights (m,) from the variance components."""
        return 1.0 / self.group_sigma[self.group] ** 2

    def held(self, points: int) -> NDArray[np.bool_]:
        """(a,) true for coordinates held by a fixed datum."""
        mask = np.zeros((points, 3), dtype=bool)
        if self.datum.kind == "fixed":
            mask[self.datum.rows] = True
        return np.concatenate([np.zeros(self.basis.shape[1], dtype=bool), mask.ravel()])

    def constraints(self, points: Array) -> Array:
        """(3t, d) inner constraints, d = 0 for a fixed datum."""
        if self.datum.kind == "fixed":
            return np.zeros((3 * len(points), 0))
        return self.datum.constraints(points)

    def null_space(self, points: Array) -> Array:
        """(3t, d) directions the datum has to fix."""
        if self.datum.kind == "fixed":
            return np.zeros((3 * len(points), 0))
        return self.datum.null_space(points)

    def target_normals(self, points: Array) -> Array:
        """Normals (t, 3), given or from the shape of the body."""
        if self.normals is None:
            return body_normals(points) if np.any(self.radii > 0) else np.full((len(points), 3), np.nan)
        return self.normals

    def shift(self, state: State) -> Array:
        """Eccentricity (m, 2) px of every mark at this state."""
        marks = self.order.marks
        if not np.any(self.radii > 0):
            return np.zeros((len(marks), 2))
        R, t = state.camera_T_body[marks.image, :3, :3], state.camera_T_body[marks.image, :3, 3]
        normals = self.target_normals(state.points)
        offset = rim_offset(state.points, self.radii, normals)
        p = np.einsum("mij,mj->mi", R, state.points[marks.target]) + t
        n = np.einsum("mij,mj->mi", R, normals[marks.target])
        if not offset.any():
            return centre_shift(state.camera, p, n, self.radii[marks.target])
        rim = p + np.einsum("mij,mj->mi", R, offset[marks.target])
        sunk = project(state.camera, rim) - project(state.camera, p)
        return sunk + centre_shift(state.camera, rim, n, self.radii[marks.target])

    def linearised_bars(self, points: Array) -> LinearisedLengths:
        """Scale bars at these points."""
        return linearise_lengths(points, self.bars.rows, self.bars.length, self.bars.sigma)


def _cost(r: Array, weights: Array, bars: LinearisedLengths, limit: float | None) -> float:
    length = np.linalg.norm(r, axis=1) * np.sqrt(weights)
    costs = length**2 if limit is None else huber_costs(length, limit)
    total = 0.5 * float(np.sum(costs) + np.sum(bars.r**2))
    return total if np.isfinite(total) else float("inf")


def minimise(
    problem: Problem, state: State, *, robust: float | None = None, max_iterations: int = 50, tolerance: float = 1e-9
) -> tuple[State, SolveSummary]:
    """Steps until one is predicted to save less than ``tolerance`` of the cost; damped where the cost would rise.

    Parameters
    ----------
    robust : Huber limit in standard deviations of a residual vector (the scale is re-estimated in every iteration from
        the median, so misstated sigmas do not matter), or None for least squares with the stated covariances.
    """
    order, held = problem.order, problem.held(len(state.points))

    def local(at: State) -> Linearised[State]:
        shift = problem.shift(at)
        lin = linearise(at, order, problem.basis, shift)
        weights = problem.weights
        if robust is not None:
            weights = weights / max(median_scale(lin.r * np.sqrt(weights)[:, None]), 1e-12) ** 2
        bars = problem.linearised_bars(at.points)
        step_weights = weights
        if robust is not None:
            step_weights = weights * huber_weights(np.linalg.norm(lin.r, axis=1) * np.sqrt(weights), robust)
        normals = build_normals(lin, step_weights, order, bars)
        constraints = problem.constraints(at.points)

        def propose(damping: float) -> tuple[State, float]:
            dx, ds = Factor(normals, constraints, held, damping).solve(normals.b, normals.s)
            return at.moved(problem.basis, dx, ds), 0.5 * float(dx @ normals.b + np.sum(ds * normals.s))

        def evaluate(trial: State) -> float:
            if trial.camera.fx <= 0 or trial.camera.fy <= 0:
                return np.nan
            return _cost(
                whitened_residuals(trial, order, shift), weights, problem.linearised_bars(trial.points), robust
            )

        def settled(trial: State) -> bool:
            return bool(np.max(np.abs(problem.shift(trial) - shift), initial=0.0) < 1e-5)

        return Linearised(_cost(lin.r, weights, bars, robust), propose, evaluate, settled)

    return levenberg(local, state, TerminationSettings(max_iterations, 13, tolerance))
