"""From a converged bundle adjustment to its result: variance components, covariances, reliability, correlations."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy import linalg

from robcal.estimation.summary import SolveSummary
from robcal.photogrammetry.bundle.determinacy import strong_correlations
from robcal.photogrammetry.bundle.lengths import distances, length_results
from robcal.photogrammetry.bundle.normals import Factor, State, build_normals, linearise
from robcal.photogrammetry.bundle.snooping import reliability, test_statistics, variance_factors
from robcal.photogrammetry.bundle.solver import Problem, minimise
from robcal.photogrammetry.core.network import CameraNetwork, Lengths, RejectedMark, frozen
from robcal.transforms import Array

_BARS_REDUNDANCY = 5.0
"""Redundancy of the scale bars from which on their variance is estimated."""


def finish(
    problem: Problem,
    state: State,
    summary: SolveSummary,
    *,
    free: tuple[str, ...],
    left_out: tuple[tuple[str, str], ...],
    image_names: tuple[str, ...],
    ids: np.ndarray,
    rejected: tuple[RejectedMark, ...],
    lengths: Lengths,
    check_lengths: Lengths,
    notes: tuple[str, ...],
    variance_components: bool,
    iterate: bool = True,
) -> CameraNetwork:
    """Variance components until they stand still, then everything that a result has to say."""
    k = problem.basis.shape[1]
    groups = len(problem.group_sigma)
    bars_sigma0 = 1.0
    stated_sigma = problem.bars.sigma
    for _ in range(10):
        lin = linearise(state, problem.order, problem.basis, problem.shift(state))
        bars = problem.linearised_bars(state.points)
        normals = build_normals(lin, problem.weights, problem.order, bars)
        factor = Factor(normals, problem.constraints(state.points), problem.held(len(state.points)))
        Q = factor.cofactors(problem.null_space(state.points))
        rel = reliability(lin, problem.order, factor, Q, problem.weights)
        whitened = lin.r * np.sqrt(problem.weights)[:, None]
        grown = np.ones(groups)
        if variance_components:
            estimate = variance_factors(whitened, rel.share, problem.group, groups)
            grown = np.sqrt(np.where(np.isfinite(estimate) & (estimate > 0), estimate, 1.0))
        bars_grown = 1.0
        if variance_components and len(stated_sigma):
            _, J = distances(state.points, problem.bars.rows)
            used = np.einsum("ka,ab,kb->k", J, Q[k:, k:], J) / problem.bars.sigma**2
            redundancy = float(np.sum(1.0 - used))
            if redundancy > _BARS_REDUNDANCY:
                # a bar's certificate is never made better than it says
                bars_grown = max(float(np.sqrt(np.sum(bars.r**2) / redundancy)), 1.0 / bars_sigma0)
        alone = groups == 1 and len(stated_sigma) == 0
        if alone or (np.max(np.abs(grown - 1.0)) < 2e-3 and abs(bars_grown - 1.0) < 2e-2):
            break
        bars_sigma0 *= bars_grown
        problem = replace(
            problem,
            group_sigma=problem.group_sigma * grown,
            bars=replace(problem.bars, sigma=stated_sigma * bars_sigma0),
        )
        if iterate:
            state, summary = minimise(problem, state)
        grown = np.ones(groups)
    scaled = float(grown[0] ** 2) if groups == 1 else 1.0
    # one component and no bars: the estimate only scales all cofactors
    Q = Q * scaled if len(stated_sigma) == 0 else Q
    group_sigma0 = problem.group_sigma * grown
    whitened = whitened / grown[problem.group][:, None]
    Q_station, Q_mixed = factor.station_cofactors(Q / scaled if len(stated_sigma) == 0 else Q)
    if len(stated_sigma) == 0:
        Q_station, Q_mixed = Q_station * scaled, Q_mixed * scaled
    L = problem.order.factor
    C = rel.residual_cofactor
    residuals = np.einsum("mij,mj->mi", L, lin.r)
    in_pixels = L @ C @ np.swapaxes(L, 1, 2)
    shares = np.diagonal(L @ C @ np.linalg.inv(L), axis1=1, axis2=2)
    spread = np.sqrt(np.maximum(np.diagonal(in_pixels, axis1=1, axis2=2), 0.0))
    spread = spread * group_sigma0[problem.group][:, None]
    w = np.where(shares > 1e-4, residuals / np.maximum(spread, 1e-300), 0.0)
    total = round(float(np.sum(rel.share)))
    if len(stated_sigma):
        total = 2 * len(problem.order.marks) + len(stated_sigma) - k - 6 * problem.order.images
        total -= int(np.count_nonzero(~problem.held(len(state.points))[k:])) - problem.datum.defect
    stated = np.trace(problem.order.marks.covariance, axis1=1, axis2=2) / 2.0
    share = rel.share
    stated_squares = float(np.sum(lin.r**2))
    sigma0 = float(np.sqrt(stated_squares / max(float(share.sum()), 1e-9)))
    intrinsics = problem.basis @ Q[:k, :k] @ problem.basis.T
    return CameraNetwork(
        camera=state.camera,
        intrinsics_covariance=frozen(intrinsics),
        free_intrinsics=free,
        left_out=left_out,
        image_names=image_names,
        camera_T_body=frozen(state.camera_T_body),
        pose_covariance=frozen(Q_station),
        ids=frozen(ids, np.int64),
        points=frozen(state.points),
        points_covariance=frozen(Q[k:, k:]),
        points_intrinsics_covariance=frozen(Q[k:, :k] @ problem.basis.T),
        marks=problem.order.marks,
        residuals=frozen(residuals),
        redundancy=frozen(shares),
        w=frozen(w),
        statistic=frozen(test_statistics(whitened, rel)),
        normals=frozen(problem.target_normals(state.points)),
        radii=frozen(problem.radii),
        sigma0=sigma0,
        sigma0_px=sigma0 * float(np.sqrt(np.mean(stated))),
        group_sigma0=frozen(group_sigma0),
        bars_sigma0=bars_sigma0,
        redundancy_total=total,
        rejected=rejected,
        correlations=strong_correlations(free, image_names, Q[:k, :k], Q_mixed[:k], Q_station),
        scale_bars=length_results(lengths, ids, state.points, Q[k:, k:], "scale_bar", bars_sigma0),
        check_lengths=length_results(check_lengths, ids, state.points, Q[k:, k:], "check"),
        datum=problem.datum.description,
        condition=_condition(factor),
        unknowns=6 * problem.order.images + len(factor.free),
        rank=6 * problem.order.images + numerical_rank(factor.equilibrated),
        summary=summary,
        notes=notes,
    )


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
