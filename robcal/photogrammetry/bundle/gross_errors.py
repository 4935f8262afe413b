"""Gross errors among the marks of a bundle adjustment: a robust adjustment first, then data snooping.

Sources: Huber (1964), Ann. Math. Statist. 35:73-101, for the weights of the start; Baarda (1968), "A testing procedure
for use in geodetic networks", for the test.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from robcal.errors import DegenerateGeometry
from robcal.estimation.reliability import critical_value, mark_statistics, variance_factors, worst_marks
from robcal.estimation.robust import median_scale
from robcal.photogrammetry.bundle.covariance import cofactors, factorise
from robcal.photogrammetry.bundle.datum import DatumSpec
from robcal.photogrammetry.bundle.held_intrinsics import raise_singular, undetermined_intrinsics
from robcal.photogrammetry.bundle.normals import linearise
from robcal.photogrammetry.bundle.settings import AdjustSettings
from robcal.photogrammetry.bundle.snooping import reliability
from robcal.photogrammetry.bundle.solver import Problem, minimise
from robcal.photogrammetry.bundle.working_set import Compact, WorkingSet
from robcal.transforms import Array

_GROSS = 12.0
"""Residuals this many robust standard deviations long are taken out before the exact test."""


def remove_gross_errors(
    work: WorkingSet, basis: Array, free: Sequence[str], datum: DatumSpec, settings: AdjustSettings
) -> tuple[str, ...]:
    """Adjust without scale bars, first robustly, and take out gross errors until none is left.

    Returns the free intrinsics that the marks left over do not determine, worst first.

    Raises
    ------
    DegenerateGeometry : too few images or targets, or images that do not fit together.
    NotIdentifiable : the marks do not determine the unknowns.
    """
    if settings.robust:
        while _robust_round(work, _minimised(work, basis, free, datum, settings, robust=True), settings):
            pass
    while True:
        at = _minimised(work, basis, free, datum, settings, robust=False)
        again, Q = _snooping_round(work, at, free, settings)
        if not again:
            return undetermined_intrinsics(at.problem, at.state, free, Q)


def _minimised(
    work: WorkingSet, basis: Array, free: Sequence[str], datum: DatumSpec, settings: AdjustSettings, *, robust: bool
) -> Compact:
    """The problem of what is in use at its minimum."""
    work.prune()
    work.check_size(free)
    at = work.compact(basis, datum)
    state, summary = minimise(
        at.problem,
        at.state,
        robust=settings.huber if robust else None,
        max_iterations=settings.max_iterations,
        tolerance=1e-4 if robust else settings.tolerance,
    )
    if summary.iterations and not np.isfinite(summary.cost):
        raise DegenerateGeometry(
            "the start values put targets behind the camera: the images do not fit together, check ids and images"
        )
    work.store(at, state, summary)
    return replace(at, state=state)


def _robust_round(work: WorkingSet, at: Compact, settings: AdjustSettings) -> bool:
    """Take out the largest residuals after a robust adjustment; false if there are none."""
    problem = at.problem
    r = linearise(at.state, problem.order, problem.basis, problem.shift(at.state)).r
    if settings.variance_components:
        # robust until the gross errors are gone, then by redundancies
        groups = [problem.group == g for g in range(len(work.group_sigma))]
        scale = np.array([median_scale(r[mine]) if mine.any() else 1.0 for mine in groups])
        work.group_sigma = np.maximum(scale, 1e-9)
    length = np.linalg.norm(r, axis=1) / work.group_sigma[problem.group]
    return settings.snooping and _take_out(work, problem, r, length**2, _GROSS**2, "gross error")


def _snooping_round(work: WorkingSet, at: Compact, free: Sequence[str], settings: AdjustSettings) -> tuple[bool, Array]:
    """Take out the most significant residuals: whether to adjust again, and the scaled cofactors of the unknowns."""
    problem, state = at.problem, at.state
    try:
        lin, factor = factorise(problem, state)
        Q = cofactors(problem, state, factor)
    except np.linalg.LinAlgError:
        raise_singular(problem, state, free, work.ids[at.targets])
    rel = reliability(lin, problem.order, factor, Q, problem.weights)
    whitened = lin.r * np.sqrt(problem.weights)[:, None]
    growth = np.ones(len(work.group_sigma))
    if settings.variance_components:
        factors = variance_factors(whitened, rel.share, problem.group, len(work.group_sigma))
        growth = np.sqrt(np.where(np.isfinite(factors) & (factors > 0), factors, 1.0))
        work.group_sigma = work.group_sigma * growth
    statistic = mark_statistics(whitened / growth[problem.group][:, None], rel.residual_cofactor)
    critical = critical_value(len(work.kept), settings.snooping_level)
    # several components shift weights among each other; one alone only scales
    shifted = len(growth) > 1 and np.max(np.abs(growth / growth[0] - 1.0)) > 0.01
    again = settings.snooping and _take_out(work, problem, lin.r, statistic, critical, "data snooping")
    return bool(again or shifted), Q * float(np.max(growth)) ** 2


def _take_out(work: WorkingSet, problem: Problem, r: Array, statistic: Array, critical: float, reason: str) -> bool:
    """Reject the worst marks; false if there are none."""
    order = problem.order
    worst = worst_marks(statistic, critical, order.marks.image, order.marks.target)
    if len(worst) == 0:
        return False
    rows = work.kept[order.order[worst]]
    for row, index in zip(rows.tolist(), worst.tolist(), strict=True):
        work.reject(row, reason, order.factor[index] @ r[index], statistic[index])
    work.kept = np.setdiff1d(work.kept, rows)
    return True
