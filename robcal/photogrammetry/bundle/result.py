"""From a converged bundle adjustment to its result: variance components, covariances, reliability, correlations."""

from dataclasses import dataclass, replace

import numpy as np
from scipy import linalg

from robcal.estimation.reliability import mark_statistics, variance_factors
from robcal.estimation.schur import Factor
from robcal.estimation.summary import SolveSummary
from robcal.photogrammetry.bundle.covariance import cofactors, factorise
from robcal.photogrammetry.bundle.determinacy import strong_correlations
from robcal.photogrammetry.bundle.lengths import distances, length_results
from robcal.photogrammetry.bundle.normals import Linearised, State
from robcal.photogrammetry.bundle.snooping import Reliability, reliability
from robcal.photogrammetry.bundle.solver import Problem, minimise
from robcal.photogrammetry.core.network import CameraNetwork, IntArray, Lengths, RejectedMark, frozen
from robcal.transforms import Array

_BARS_REDUNDANCY = 5.0
"""Redundancy of the scale bars from which on their variance is estimated."""


@dataclass(frozen=True)
class NetworkContext:
    """What a result contains besides the estimated values: names, and what was left out before.

    Attributes
    ----------
    free, left_out : names of the estimated intrinsics; (name, reason) of those given up.
    image_names : (n,); ids : (t,) target ids; rejected : marks taken out.
    lengths, check_lengths : scale bars and check lengths.
    """

    free: tuple[str, ...]
    left_out: tuple[tuple[str, str], ...]
    image_names: tuple[str, ...]
    ids: IntArray
    rejected: tuple[RejectedMark, ...]
    lengths: Lengths
    check_lengths: Lengths
    notes: tuple[str, ...]


@dataclass(frozen=True)
class _Estimate:
    """A minimum with its cofactors and variance components.

    ``growth`` (g,) is what the last estimate of the components still adds to ``problem.group_sigma``; of a single
    component without scale bars it only scales the cofactors ``Q``, by ``scale``.
    """

    problem: Problem
    state: State
    summary: SolveSummary
    lin: Linearised
    factor: Factor
    Q: Array
    reliability: Reliability
    whitened: Array
    growth: Array
    scale: float
    bars_sigma0: float


def finish(
    problem: Problem,
    state: State,
    summary: SolveSummary,
    context: NetworkContext,
    *,
    variance_components: bool,
    iterate: bool = True,
) -> CameraNetwork:
    """Variance components until they stand still, then covariances, reliability and correlations.

    ``iterate``: minimise again with the estimated components.
    """
    end = _with_components(problem, state, summary, variance_components, iterate)
    problem, state, marks = end.problem, end.state, end.problem.order.marks
    k = problem.basis.shape[1]
    group_sigma0 = problem.group_sigma * end.growth
    Q = end.Q * end.scale
    Q_station, Q_mixed = (block * end.scale for block in end.factor.station_cofactors(end.Q))
    residuals, shares, w = _residual_columns(end, group_sigma0)
    whitened = end.whitened / end.growth[problem.group][:, None]
    stated = np.trace(marks.covariance, axis1=1, axis2=2) / 2.0
    sigma0 = float(np.sqrt(np.sum(end.lin.r**2) / max(float(end.reliability.share.sum()), 1e-9)))
    ids, basis = context.ids, problem.basis
    return CameraNetwork(
        camera=state.camera,
        intrinsics_covariance=frozen(basis @ Q[:k, :k] @ basis.T),
        free_intrinsics=context.free,
        left_out=context.left_out,
        image_names=context.image_names,
        camera_T_body=frozen(state.camera_T_body),
        pose_covariance=frozen(Q_station),
        ids=frozen(ids, np.int64),
        points=frozen(state.points),
        points_covariance=frozen(Q[k:, k:]),
        points_intrinsics_covariance=frozen(Q[k:, :k] @ basis.T),
        marks=marks,
        residuals=frozen(residuals),
        redundancy=frozen(shares),
        w=frozen(w),
        statistic=frozen(mark_statistics(whitened, end.reliability.residual_cofactor)),
        normals=frozen(problem.target_normals(state.points)),
        radii=frozen(problem.radii),
        sigma0=sigma0,
        sigma0_px=sigma0 * float(np.sqrt(np.mean(stated))),
        group_sigma0=frozen(group_sigma0),
        bars_sigma0=end.bars_sigma0,
        redundancy_total=_redundancy(end),
        rejected=context.rejected,
        correlations=strong_correlations(context.free, context.image_names, Q[:k, :k], Q_mixed[:k], Q_station),
        scale_bars=length_results(context.lengths, ids, state.points, Q[k:, k:], "scale_bar", end.bars_sigma0),
        check_lengths=length_results(context.check_lengths, ids, state.points, Q[k:, k:], "check"),
        datum=problem.datum.description,
        condition=_condition(end.factor),
        unknowns=6 * problem.order.images + len(end.factor.free),
        rank=6 * problem.order.images + numerical_rank(end.factor.equilibrated),
        summary=end.summary,
        notes=context.notes,
    )


def _with_components(
    problem: Problem, state: State, summary: SolveSummary, variance_components: bool, iterate: bool
) -> _Estimate:
    """Estimate variance components of marks and scale bars, minimise with them, until they stand still."""
    groups, stated_sigma = len(problem.group_sigma), problem.bars.sigma
    bars_sigma0 = 1.0
    # one component and no bars: the estimate only scales all cofactors
    alone = groups == 1 and len(stated_sigma) == 0
    for _ in range(10):
        lin, factor = factorise(problem, state)
        Q = cofactors(problem, state, factor)
        rel = reliability(lin, problem.order, factor, Q, problem.weights)
        whitened = lin.r * np.sqrt(problem.weights)[:, None]
        growth, bars_growth = np.ones(groups), 1.0
        if variance_components:
            estimate = variance_factors(whitened, rel.share, problem.group, groups)
            growth = np.sqrt(np.where(np.isfinite(estimate) & (estimate > 0), estimate, 1.0))
            bars_growth = _bars_growth(problem, state, Q, bars_sigma0)
        if alone or (np.max(np.abs(growth - 1.0)) < 2e-3 and abs(bars_growth - 1.0) < 2e-2):
            break
        bars_sigma0 *= bars_growth
        problem = replace(
            problem,
            group_sigma=problem.group_sigma * growth,
            bars=replace(problem.bars, sigma=stated_sigma * bars_sigma0),
        )
        if iterate:
            state, summary = minimise(problem, state)
        growth = np.ones(groups)
    scale = float(growth[0] ** 2) if alone else 1.0
    return _Estimate(problem, state, summary, lin, factor, Q, rel, whitened, growth, scale, bars_sigma0)


def _bars_growth(problem: Problem, state: State, Q: Array, bars_sigma0: float) -> float:
    """Factor by which scale bars scatter more than their present sigmas; 1 where they have too little redundancy."""
    if len(problem.bars.sigma) == 0:
        return 1.0
    k = problem.basis.shape[1]
    _, J = distances(state.points, problem.bars.rows)
    used = np.einsum("ka,ab,kb->k", J, Q[k:, k:], J) / problem.bars.sigma**2
    redundancy = float(np.sum(1.0 - used))
    if redundancy <= _BARS_REDUNDANCY:
        return 1.0
    # a bar's certificate is never made better than stated
    squares = float(np.sum(problem.linearised_bars(state.points).r ** 2))
    return max(float(np.sqrt(squares / redundancy)), 1.0 / bars_sigma0)


def _residual_columns(end: _Estimate, group_sigma0: Array) -> tuple[Array, Array, Array]:
    """Residuals in px, redundancy numbers and standardised residuals, each (m, 2)."""
    L, C = end.problem.order.factor, end.reliability.residual_cofactor
    residuals = np.einsum("mij,mj->mi", L, end.lin.r)
    shares = np.diagonal(L @ C @ np.linalg.inv(L), axis1=1, axis2=2)
    variance = np.diagonal(L @ C @ np.swapaxes(L, 1, 2), axis1=1, axis2=2)
    sigma = np.sqrt(np.maximum(variance, 0.0)) * group_sigma0[end.problem.group][:, None]
    return residuals, shares, np.where(shares > 1e-4, residuals / np.maximum(sigma, 1e-300), 0.0)


def _redundancy(end: _Estimate) -> int:
    """Observations minus unknowns plus datum defect."""
    problem = end.problem
    if len(problem.bars.sigma) == 0:
        return round(float(np.sum(end.reliability.share)))
    k = problem.basis.shape[1]
    coordinates = int(np.count_nonzero(~problem.held(len(end.state.points))[k:]))
    unknowns = k + 6 * problem.order.images + coordinates - problem.datum.defect
    return 2 * len(problem.order.marks) + len(problem.bars.sigma) - unknowns


def numerical_rank(equilibrated: Array) -> int:
    """Rank of the reduced normal equations (a, a) with unit scale: eigenvalues above their rounding errors.

    Without its datum a free network lacks 6, or 7 where no length gives the scale.
    """
    values = np.linalg.eigvalsh(equilibrated)
    return int(np.count_nonzero(values > 10.0 * len(values) * np.finfo(float).eps * values[-1]))


def _condition(factor: Factor) -> float:
    """Estimated condition number of the equilibrated reduced system."""
    norm = np.linalg.norm(factor.equilibrated, 1)
    reciprocal, _ = linalg.lapack.dpocon(factor.cholesky[0], norm, uplo="L")
    return float(1.0 / max(reciprocal, 1e-300))
