"""Factorised normal equations and cofactors of a bundle adjustment at given values of its unknowns."""

from robcal.estimation.schur import Factor
from robcal.photogrammetry.bundle.normals import Linearised, State, build_normals, linearise
from robcal.photogrammetry.bundle.solver import Problem
from robcal.transforms import Array


def factorise(problem: Problem, state: State, damping: float = 0.0) -> tuple[Linearised, Factor]:
    """Linearised marks and factorised normal equations of marks and scale bars, in the problem's datum.

    Raises
    ------
    numpy.linalg.LinAlgError : the marks do not determine the unknowns.
    """
    lin = linearise(state, problem.order, problem.basis, problem.shift(state))
    normals = build_normals(lin, problem.weights, problem.order, problem.linearised_bars(state.points))
    return lin, Factor(normals, problem.constraints(state.points), problem.held(len(state.points)), damping)


def cofactors(problem: Problem, state: State, factor: Factor) -> Array:
    """(k + 3t, k + 3t) cofactors of interior orientation and coordinates."""
    return factor.cofactors(problem.null_space(state.points))
