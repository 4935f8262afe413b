"""Bundle adjustment of a body at rest seen by one self-calibrated camera: robust start, data snooping, covariances.

:func:`adjust` takes marks with known identity and approximate values; :mod:`robcal.photogrammetry.survey` finds these.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from robcal.errors import InvalidInput
from robcal.estimation.summary import SolveSummary
from robcal.photogrammetry.bundle.covariance import cofactors, factorise
from robcal.photogrammetry.bundle.datum import DatumSpec, InnerOver
from robcal.photogrammetry.bundle.determinacy import intrinsics_basis
from robcal.photogrammetry.bundle.gross_errors import remove_gross_errors
from robcal.photogrammetry.bundle.held_intrinsics import FreeIntrinsics, hold_undetermined, raise_singular
from robcal.photogrammetry.bundle.lengths import bars_scale
from robcal.photogrammetry.bundle.normals import State
from robcal.photogrammetry.bundle.result import NetworkContext, finish
from robcal.photogrammetry.bundle.settings import AdjustSettings
from robcal.photogrammetry.bundle.solver import minimise
from robcal.photogrammetry.bundle.working_set import WorkingSet
from robcal.photogrammetry.core.camera import INTRINSIC_NAMES, Camera
from robcal.photogrammetry.core.network import CameraNetwork, ImageMarks, IntArray, Lengths
from robcal.transforms import Array


def adjust(  # noqa: PLR0913 - options by keyword
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
    n, t = len(camera_T_body0), len(points0)
    target_ids = np.arange(t) if ids is None else np.asarray(ids, dtype=np.int64)
    names = tuple(str(i) for i in range(n)) if image_names is None else tuple(image_names)
    _check(marks, n, t, target_ids, names, lengths, free_intrinsics)
    work = WorkingSet(
        marks,
        State(camera, np.array(camera_T_body0, dtype=float), np.array(points0, dtype=float)),
        np.arange(len(marks)),
        np.zeros(t) if diameters is None else np.nan_to_num(0.5 * np.asarray(diameters, dtype=float)),
        normals,
        np.ones(1 if marks.group is None else int(np.max(marks.group, initial=0)) + 1),
        names,
        target_ids,
    )
    work.drop_duplicates()
    shape_datum: DatumSpec = datum if isinstance(datum, (tuple, InnerOver)) else "free"
    free = _adjust_without_bars(work, FreeIntrinsics(tuple(free_intrinsics)), shape_datum, settings)
    basis = intrinsics_basis(free.names)
    notes = _bring_to_scale(work, basis, shape_datum, lengths, settings)
    at = work.compact(basis, datum, lengths)
    state, summary = minimise(
        at.problem, at.state, max_iterations=settings.max_iterations, tolerance=settings.tolerance
    )
    work.store(at, state, summary)
    context = NetworkContext(
        free.names,
        free.left_out,
        tuple(names[i] for i in at.images),
        target_ids[at.targets],
        tuple(work.rejected),
        lengths,
        check_lengths or Lengths.none(),
        tuple(note for note in (*notes, at.note) if note),
    )
    try:
        return finish(
            at.problem, state, _together(work.summaries), context, variance_components=settings.variance_components
        )
    except np.linalg.LinAlgError:
        raise_singular(at.problem, state, free.names, context.ids)


def _adjust_without_bars(
    work: WorkingSet, free: FreeIntrinsics, datum: DatumSpec, settings: AdjustSettings
) -> FreeIntrinsics:
    """Take out gross errors and hold what the images do not determine; returns what stays free."""
    start = work.state.camera
    while True:
        bad = remove_gross_errors(work, intrinsics_basis(free.names), free.names, datum, settings)
        if not bad:
            return free
        free, camera = hold_undetermined(
            bad, free, work.state.camera, start, undetermined=settings.undetermined, hold_focal=settings.hold_focal
        )
        work.state = replace(work.state, camera=camera)


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


def _bring_to_scale(
    work: WorkingSet, basis: Array, datum: DatumSpec, lengths: Lengths, settings: AdjustSettings
) -> tuple[str, ...]:
    """Scale the bar-free network to the bars, after testing that they agree with each other; notes on that.

    Raises
    ------
    InvalidInput : an end of a bar is not measured, or the bars contradict each other.
    """
    used = set(work.ids[work.subset()[1]].tolist())
    unseen = sorted({int(v) for v in lengths.ids.ravel()} - used)
    if unseen:
        raise InvalidInput(f"scale bar targets {unseen} are not measured in two images: photograph them or check ids")
    if len(lengths) == 0:
        return ()
    at = work.compact(basis, datum)
    Q = cofactors(at.problem, at.state, factorise(at.problem, at.state)[1])
    k = basis.shape[1]
    factor, note = bars_scale(
        lengths,
        work.ids[at.targets],
        at.state.points,
        Q[k:, k:],
        scale_free=at.problem.datum.kind == "inner",
        limit=settings.bars_contradiction,
    )
    poses = work.state.camera_T_body.copy()
    poses[:, :3, 3] *= factor
    work.state = State(work.state.camera, poses, work.state.points * factor)
    return (note,)


__all__ = ["AdjustSettings", "SolveSummary", "adjust"]
