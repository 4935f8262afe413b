"""Bundle adjustment of a body at rest seen by one self-calibrated camera: robust start, data snooping, covariances.

:func:`adjust` takes marks with known identity and approximate values; :mod:`robcal.photogrammetry.survey` finds these.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Literal, NoReturn

import numpy as np
from numpy.typing import ArrayLike

from robcal.errors import DegenerateGeometry, InvalidInput, NotIdentifiable
from robcal.estimation.summary import SolveSummary
from robcal.photogrammetry.bundle.datum import DatumSpec, InnerOver, resolve_datum
from robcal.photogrammetry.bundle.determinacy import intrinsics_basis, singular_unknowns, undetermined
from robcal.photogrammetry.bundle.lengths import bars_scale, rows_of
from robcal.photogrammetry.bundle.normals import Factor, MarkOrder, State, build_normals, linearise
from robcal.photogrammetry.bundle.result import finish
from robcal.photogrammetry.bundle.snooping import (
    critical_value,
    reliability,
    test_statistics,
    variance_factors,
    worst_marks,
)
from robcal.photogrammetry.bundle.solver import Bars, Problem, minimise, robust_scale
from robcal.photogrammetry.core.camera import INTRINSIC_NAMES, Camera
from robcal.photogrammetry.core.network import CameraNetwork, ImageMarks, IntArray, Lengths, RejectedMark
from robcal.transforms import Array

_GROSS = 12.0
"""Residuals this many robust standard deviations long are taken out before the exact test."""


@dataclass(frozen=True)
class AdjustSettings:
    """How to adjust.

    Attributes
    ----------
    robust : start with Huber weights, limit ``huber`` (standard deviations of a residual vector).
    snooping : take out marks whose residual is significant on the family-wise level ``snooping_level``; it is small
        because the tails of real marks are heavier than normal ones, and what lies in them does no harm.
    variance_components : estimate how far the marks (per group) and, from five redundant ones on, the scale bars
        scatter more or less than stated; otherwise the stated covariances are believed.
    undetermined : 'leave_out' holds intrinsics that the data do not determine at their start values and says so,
        'raise' makes it an error. Focal lengths are never left out silently: held only if ``hold_focal``.
    bars_contradiction : scale bars that disagree by more than this many sigmas are an error.
    max_iterations, tolerance : of Gauss-Newton; tolerance on the promised relative decrease of the cost.
    """

    robust: bool = True
    huber: float = 2.5
    snooping: bool = True
    snooping_level: float = 1e-5
    variance_components: bool = True
    undetermined: Literal["leave_out", "raise"] = "leave_out"
    hold_focal: bool = False
    bars_contradiction: float = 6.0
    max_iterations: int = 60
    tolerance: float = 1e-9


@dataclass
class _Work:
    """Where an adjustment stands: rows of marks still in use and values of all images and targets."""

    marks: ImageMarks
    state: State
    kept: IntArray
    radii: Array
    normals: Array | None
    group_sigma: Array
    names: tuple[str, ...]
    ids: IntArray
    summaries: list[SolveSummary] = field(default_factory=list)
    rejected: list[RejectedMark] = field(default_factory=list)

    def subset(self) -> tuple[IntArray, IntArray]:
        """Images and targets in use."""
        return np.unique(self.marks.image[self.kept]), np.unique(self.marks.target[self.kept])

    def build(self, basis: Array, ids: IntArray, spec: DatumSpec, lengths: Lengths) -> tuple:
        """(problem, state, images, targets, note) of what is in use."""
        images, targets = self.subset()
        marks = self.marks.select(self.kept)
        compact = replace(
            marks, image=np.searchsorted(images, marks.image), target=np.searchsorted(targets, marks.target)
        )
        order = MarkOrder(compact, len(images), len(targets))
        state = State(self.state.camera, self.state.camera_T_body[images], self.state.points[targets])
        datum, note = resolve_datum(spec, ids[targets], state.points, lengths)
        rows = rows_of(lengths, ids[targets])
        group = np.zeros(len(marks), np.int64) if order.marks.group is None else order.marks.group
        problem = Problem(
            order,
            basis,
            datum,
            Bars(rows, lengths.length, lengths.sigma),
            self.radii[targets],
            None if self.normals is None else self.normals[targets],
            group,
            self.group_sigma,
        )
        return problem, state, images, targets, note

    def store(self, state: State, images: IntArray, targets: IntArray) -> None:
        """Put the values of a compact state back."""
        poses, points = self.state.camera_T_body.copy(), self.state.points.copy()
        poses[images], points[targets] = state.camera_T_body, state.points
        self.state = State(state.camera, poses, points)

    def prune(self) -> None:
        """Drop what cannot be used: images with fewer than four marks, targets seen in one image only."""
        while True:
            image, target = self.marks.image[self.kept], self.marks.target[self.kept]
            few_marks = np.bincount(image, minlength=1)[image] < 4
            few_rays = np.bincount(target, minlength=1)[target] < 2
            if not np.any(few_marks | few_rays):
                return
            for flag, reason in ((few_marks, "image with fewer than four marks"), (few_rays, "seen in one image only")):
                for row in self.kept[flag & ~(few_marks if flag is few_rays else np.zeros_like(flag))]:
                    self.reject(row, reason)
            self.kept = self.kept[~(few_marks | few_rays)]

    def reject(self, row: int, reason: str, residual: ArrayLike = (np.nan, np.nan), statistic: float = np.nan) -> None:
        """Note a mark as taken out (``kept`` is updated by the caller)."""
        xy, r = self.marks.xy[row], np.asarray(residual)
        self.rejected.append(
            RejectedMark(
                self.names[int(self.marks.image[row])],
                int(self.ids[self.marks.target[row]]),
                (float(xy[0]), float(xy[1])),
                (float(r[0]), float(r[1])),
                float(statistic),
                reason,
            )
        )


def adjust(
    marks: ImageMarks,
    camera: Camera,
    camera_T_body0: Array,
    points0: Array,
    *,
    ids: ArrayLike | None = None,
    image_names: Sequence[str] | None = None,
    lengths: Lengths | None = None,
    check_lengths: Lengths | None = None,
    datum: DatumSpec = "free",
    diameters: ArrayLike | None = None,
    normals: Array | None = None,
    free_intrinsics: Sequence[str] = INTRINSIC_NAMES,
    settings: AdjustSettings | None = None,
) -> CameraNetwork:
    """Adjust a network from approximate values.

    Parameters
    ----------
    marks : identified image marks; ``target`` indexes ``points0``, ``image`` indexes ``camera_T_body0``.
    camera_T_body0 : (n, 4, 4) approximate stations; points0 : (t, 3) m approximate coordinates.
    ids : (t,) target ids, default 0 .. t-1. image_names : (n,), default the indices.
    lengths : scale bars, weighted observations. check_lengths : compared only.
    datum : 'free', 'bars', InnerOver(ids), or the ids of targets held at ``points0``.
    diameters : (t,) m of the dots, NaN or 0 where unknown: then no eccentricity is modelled for them.
    normals : (t, 3) of the dots; None: from the shape of the body.
    free_intrinsics : names of the numbers to estimate; ``f`` stands for fx and fy changed alike.

    Returns
    -------
    CameraNetwork with only the images and targets that could be used.

    Raises
    ------
    InvalidInput : contradictory input, contradictory scale bars.
    DegenerateGeometry : too few images or targets, a datum in one line.
    NotIdentifiable : the interior orientation (or a point) is not determined by these images.
    """
    settings = settings or AdjustSettings()
    lengths = lengths or Lengths.none()
    check_lengths = check_lengths or Lengths.none()
    n, t = len(camera_T_body0), len(points0)
    target_ids = np.arange(t) if ids is None else np.asarray(ids, dtype=np.int64)
    names = tuple(str(i) for i in range(n)) if image_names is None else tuple(image_names)
    _check(marks, n, t, target_ids, names, lengths, free_intrinsics)
    radii = np.zeros(t) if diameters is None else np.nan_to_num(0.5 * np.asarray(diameters, dtype=float))
    groups = 1 if marks.group is None else int(np.max(marks.group, initial=0)) + 1
    state = State(camera, np.array(camera_T_body0, dtype=float), np.array(points0, dtype=float))
    work = _Work(marks, state, np.arange(len(marks)), radii, normals, np.ones(groups), names, target_ids)
    _drop_duplicates(work)
    left_out: list[tuple[str, str]] = []
    free = list(free_intrinsics)
    shape_datum: DatumSpec = datum if isinstance(datum, (tuple, InnerOver)) else "free"
    while True:
        basis = intrinsics_basis(free)
        bad = _clean(work, basis, free, target_ids, shape_datum, settings)
        if not bad:
            break
        _leave_out(bad, free, left_out, work, camera, settings)
    notes: list[str] = []
    used = set(target_ids[work.subset()[1]].tolist())
    unseen = sorted({int(v) for v in lengths.ids.ravel() if int(v) not in used})
    if unseen:
        raise InvalidInput(f"scale bar targets {unseen} are not measured in two images: photograph them or check ids")
    if len(lengths):
        _bring_to_scale(work, basis, target_ids, shape_datum, lengths, settings, notes)
    problem, state, images, targets, note = work.build(basis, target_ids, datum, lengths)
    if note:
        notes.append(note)
    state, summary = minimise(problem, state, max_iterations=settings.max_iterations, tolerance=settings.tolerance)
    work.store(state, images, targets)
    try:
        return finish(
            problem,
            state,
            _together([*work.summaries, summary]),
            free=tuple(free),
            left_out=tuple(left_out),
            image_names=tuple(names[i] for i in images),
            ids=target_ids[targets],
            rejected=tuple(work.rejected),
            lengths=lengths,
            check_lengths=check_lengths,
            notes=tuple(notes),
            variance_components=settings.variance_components,
        )
    except np.linalg.LinAlgError:
        _raise_singular(problem, state, free, target_ids[targets])


def _together(runs: Sequence[SolveSummary]) -> SolveSummary:
    """One summary of consecutive minimisations; whether it converged is up to the last one."""
    last = runs[-1]
    return SolveSummary(
        last.converged,
        sum(run.iterations for run in runs),
        last.termination,
        last.cost_start,
        last.cost,
        last.history,
        sum(run.halvings for run in runs),
        sum(run.seconds for run in runs),
    )


def _check(
    marks: ImageMarks,
    n: int,
    t: int,
    ids: IntArray,
    names: Sequence[str],
    lengths: Lengths,
    free_intrinsics: Sequence[str],
) -> None:
    if len(ids) != t or len(names) != n:
        raise InvalidInput(f"{t} points but {len(ids)} ids, or {n} stations but {len(names)} image names")
    if len(np.unique(ids)) != t:
        values, counts = np.unique(ids, return_counts=True)
        raise InvalidInput(f"target id {values[counts > 1][0]} is listed twice: ids must be unique")
    if len(marks) and (marks.image.max() >= n or marks.target.max() >= t or min(marks.image.min(), 0) < 0):
        raise InvalidInput("marks refer to images or targets that do not exist")
    if len(lengths) and not np.all(lengths.sigma > 0):
        raise InvalidInput("every scale bar needs a sigma above zero")
    unknown = [name for name in free_intrinsics if name not in (*INTRINSIC_NAMES, "f")]
    if unknown:
        raise InvalidInput(f"unknown interior orientation {unknown}: choose from {', '.join(INTRINSIC_NAMES)} or f")


def _drop_duplicates(work: _Work) -> None:
    """A target marked twice in one image: at least one mark is wrong and nothing tells which, so both go."""
    key = work.marks.image * (int(work.marks.target.max(initial=0)) + 1) + work.marks.target
    _, inverse, counts = np.unique(key, return_inverse=True, return_counts=True)
    double = counts[inverse] > 1
    for row in np.flatnonzero(double):
        work.reject(int(row), "target marked more than once in this image")
    work.kept = work.kept[~double]


def _clean(
    work: _Work, basis: Array, free: Sequence[str], ids: IntArray, datum: DatumSpec, settings: AdjustSettings
) -> tuple[str, ...]:
    """Adjust without scale bars, first robustly, and take out gross errors until none is left.

    Returns the free intrinsics that the marks left over do not determine, worst first.
    """
    robust = settings.huber if settings.robust else None
    none = Lengths.none()
    while True:
        work.prune()
        _check_size(work, free)
        problem, state, images, targets, _ = work.build(basis, ids, datum, none)
        tolerance = 1e-4 if robust is not None else settings.tolerance
        state, summary = minimise(
            problem, state, robust=robust, max_iterations=settings.max_iterations, tolerance=tolerance
        )
        work.summaries.append(summary)
        if summary.iterations and not np.isfinite(summary.cost):
            raise DegenerateGeometry(
                "the start values put targets behind the camera: the images do not fit together, check ids and images"
            )
        work.store(state, images, targets)
        lin = linearise(state, problem.order, basis, problem.shift(state))
        if settings.variance_components:
            # robust until the gross errors are gone, then by redundancies
            scale = np.array(
                [
                    robust_scale(lin.r[problem.group == g]) if np.any(problem.group == g) else 1.0
                    for g in range(len(work.group_sigma))
                ]
            )
            scale = np.maximum(scale, 1e-9)
            if robust is not None:
                work.group_sigma = scale
                problem = replace(problem, group_sigma=scale)
        if robust is not None:
            length = np.linalg.norm(lin.r, axis=1) / problem.group_sigma[problem.group]
            if settings.snooping and _take_out(work, problem, lin.r, length**2, _GROSS**2, "gross error"):
                continue
            robust = None
            continue
        try:
            factor, Q = _cofactors(problem, state)
        except np.linalg.LinAlgError:
            _raise_singular(problem, state, free, ids[targets])
        weights = problem.weights
        rel = reliability(lin, problem.order, factor, Q, weights)
        whitened = lin.r * np.sqrt(weights)[:, None]
        if settings.variance_components:
            factors = variance_factors(whitened, rel.share, problem.group, len(work.group_sigma))
            grown = np.sqrt(np.where(np.isfinite(factors) & (factors > 0), factors, 1.0))
            work.group_sigma = work.group_sigma * grown
            statistic = test_statistics(whitened / grown[problem.group][:, None], rel)
        else:
            grown = np.ones(1)
            statistic = test_statistics(whitened, rel)
        critical = critical_value(len(work.kept), settings.snooping_level)
        if settings.snooping and _take_out(work, problem, lin.r, statistic, critical, "data snooping"):
            continue
        # several components shift weights among each other; one alone only scales
        if len(grown) > 1 and np.max(np.abs(grown / grown[0] - 1.0)) > 0.01:
            continue
        return _undetermined(problem, state, free, Q * float(np.max(grown)) ** 2)


def _take_out(work: _Work, problem: Problem, r: Array, statistic: Array, critical: float, reason: str) -> bool:
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


def _check_size(work: _Work, free: Sequence[str]) -> None:
    images, targets = work.subset()
    if len(images) < 2 or len(targets) < 4:
        raise DegenerateGeometry(
            f"only {len(images)} images and {len(targets)} targets can be used together: a network needs at least two "
            "images that share four targets, better ten images with ten targets each"
        )
    unknowns = 6 * len(images) + 3 * len(targets) + len(free) - 7
    if 2 * len(work.kept) < unknowns:
        raise NotIdentifiable(
            f"{2 * len(work.kept)} image coordinates cannot determine {unknowns} unknowns: take more images",
            tuple(free),
        )


def _cofactors(problem: Problem, state: State) -> tuple[Factor, Array]:
    lin = linearise(state, problem.order, problem.basis, problem.shift(state))
    normals = build_normals(lin, problem.weights, problem.order, problem.linearised_bars(state.points))
    points = state.points
    factor = Factor(normals, problem.constraints(points), problem.held(len(points)))
    return factor, factor.cofactors(problem.null_space(points))


def _raise_singular(problem: Problem, state: State, free: Sequence[str], ids: IntArray) -> NoReturn:
    lin = linearise(state, problem.order, problem.basis, problem.shift(state))
    normals = build_normals(lin, problem.weights, problem.order, problem.linearised_bars(state.points))
    points = state.points
    damped = Factor(normals, problem.constraints(points), problem.held(len(points)), 1e-9)
    S = damped.equilibrated + damped.constraints @ damped.constraints.T
    names = singular_unknowns(S, free, ids.tolist())
    raise NotIdentifiable(
        f"the images do not determine {', '.join(names)}: take images from more directions, tilted up to 45 degrees "
        "and rolled by 90 degrees, or give a camera calibration",
        names,
    )


def _undetermined(problem: Problem, state: State, free: Sequence[str], Q: Array) -> tuple[str, ...]:
    """Free intrinsics that the marks do not determine, worst first."""
    if not free:
        return ()
    sigma = np.sqrt(np.maximum(np.diag(Q)[: len(free)], 0.0))
    marks, c = problem.order.marks, state.camera
    ideal = (marks.xy - [c.cx, c.cy]) / [c.fx, c.fy]
    return undetermined(free, sigma, c, float(np.max(np.linalg.norm(ideal, axis=1))))


def _leave_out(
    bad: Sequence[str],
    free: list[str],
    left_out: list[tuple[str, str]],
    work: _Work,
    start: Camera,
    settings: AdjustSettings,
) -> None:
    """Hold the first undetermined group at its start value, or say that it cannot be done."""
    remedy = (
        "take images tilted by 30 to 45 degrees in different directions and rolled by 90 degrees, "
        "or give a camera calibration"
    )
    if settings.undetermined == "raise":
        raise NotIdentifiable(f"the images do not determine {', '.join(bad)}: {remedy}", bad)
    first = bad[0]
    pairs: dict[str, tuple[str, ...]] = {name: pair for pair in (("p1", "p2"), ("cx", "cy")) for name in pair}
    group = pairs.get(first, (first,))
    values = work.state.camera.vector
    if {"fx", "fy"} <= set(free) and first in ("fx", "fy"):
        # perhaps only their ratio is open (a plane seen without roll): then one number for both
        values[1] = values[0] * start.fy / start.fx
        work.state = replace(work.state, camera=work.state.camera.with_vector(values))
        free[:] = ["f", *(name for name in free if name not in ("fx", "fy"))]
        left_out.append(("fy", "its ratio to fx is not determined by these images, held at its start value"))
        return
    if first in ("fx", "fy", "f"):
        if not settings.hold_focal:
            raise NotIdentifiable(
                f"the images do not determine the focal length ({', '.join(bad)}) against the distance: {remedy}", bad
            )
        group = ("fx", "fy", "f")
    for name in group:
        if name in free:
            free.remove(name)
            left_out.append((name, "not determined by these images, held at its start value"))
        if name in INTRINSIC_NAMES:
            values[INTRINSIC_NAMES.index(name)] = start.vector[INTRINSIC_NAMES.index(name)]
    work.state = replace(work.state, camera=work.state.camera.with_vector(values))


def _bring_to_scale(
    work: _Work,
    basis: Array,
    ids: IntArray,
    datum: DatumSpec,
    lengths: Lengths,
    settings: AdjustSettings,
    notes: list[str],
) -> None:
    """Scale the bar-free network to the bars, after testing that they agree with each other."""
    problem, state, _, targets, _ = work.build(basis, ids, datum, Lengths.none())
    _, Q = _cofactors(problem, state)
    k = basis.shape[1]
    factor, note = bars_scale(
        lengths,
        ids[targets],
        state.points,
        Q[k:, k:],
        scale_free=problem.datum.kind == "inner",
        limit=settings.bars_contradiction,
    )
    if note:
        notes.append(note)
    poses = work.state.camera_T_body.copy()
    poses[:, :3, 3] *= factor
    work.state = State(work.state.camera, poses, work.state.points * factor)


__all__ = ["AdjustSettings", "SolveSummary", "adjust"]
