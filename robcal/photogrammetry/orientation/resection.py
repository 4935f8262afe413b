"""Spatial resection: the pose of a known body from one image (or from several cameras at once), many images together.

Closed form for the start (IPPE for planes, SQPnP otherwise, three-point search where marks are misidentified), then
least squares with the marks' covariances. A plane seen by one camera has two poses of similar fit; both are returned.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from robcal.columns import Columns
from robcal.errors import DegenerateGeometry, InvalidInput
from robcal.estimation.batched import NormalEquations, minimise_each
from robcal.estimation.grouping import members, whitener
from robcal.estimation.summary import TerminationSettings
from robcal.photogrammetry.core.bodies import Body, IntArray, line_ratio
from robcal.photogrammetry.core.camera import Camera, project, project_each
from robcal.photogrammetry.core.eccentricity import effective_point
from robcal.photogrammetry.orientation.closed_form import LINE, start_poses, three_point_search
from robcal.transforms import Array, invert, retract, transform


@dataclass(frozen=True)
class PoseFit:
    """Least-squares poses of ``k`` images (or of ``k`` bodies seen by several cameras).

    ``reference_T_body`` (k, 4, 4), ``covariance`` (k, 6, 6) from the marks' covariances (right perturbation), NaN where
    singular; ``cost`` (k,) sum of squared whitened residuals; ``count`` (k,) marks; ``whitened`` (m, 2) residuals.
    """

    reference_T_body: Array
    covariance: Array
    cost: Array
    count: IntArray
    whitened: Array

    @property
    def redundancy(self) -> IntArray:
        """2 * marks - 6, per pose."""
        return 2 * self.count - 6


@dataclass(frozen=True)
class Resection:
    """Pose of a body before one camera.

    Attributes
    ----------
    camera_T_body : (4, 4), the better solution; ``covariance`` (6, 6) from the marks' covariances.
    alternative : (4, 4) the other solution of a plane, None if there is none near.
    ambiguous : the data do not tell the two solutions apart (chi-square difference below 14, odds of 1000 to 1).
    chi2, redundancy : of the better solution; ``chi2_alternative`` of the other (inf without).
    inliers : (m,) marks that fit.
    """

    camera_T_body: Array
    covariance: Array
    alternative: Array | None
    ambiguous: bool
    chi2: float
    redundancy: int
    chi2_alternative: float
    inliers: NDArray[np.bool_]


@dataclass(frozen=True)
class TargetMarks(Columns):
    """Marks (m,) of known targets.

    Attributes
    ----------
    points : (m, 3) m body coordinates of each mark's target. xy, covariance : (m, 2) px, (m, 2, 2) px^2.
    radius, normals : (m,) m, (m, 3) of circular targets, for the eccentricity of their images; None: not modelled.
    """

    points: Array
    xy: Array
    covariance: Array
    radius: Array | None = None
    normals: Array | None = None

    def seen_from(self, camera_T_body: Array) -> Array:
        """(m, 3) in the camera's frame, of frames (4, 4) or (m, 4, 4): what projects to the centres of the images."""
        p = transform(camera_T_body, self.points)
        if self.radius is None or self.normals is None:
            return p
        return effective_point(p, np.einsum("...ij,...j->...i", camera_T_body[..., :3, :3], self.normals), self.radius)


@dataclass(frozen=True)
class Rig:
    """The camera (m,) of each mark, the cameras, and their fixed exterior orientations reference_T_camera (c, 4, 4)."""

    camera: IntArray
    cameras: Sequence[Camera]
    reference_T_camera: Array

    @classmethod
    def single(cls, camera: Camera, marks: int) -> "Rig":
        """One camera, whose frame is the reference."""
        return cls(np.zeros(marks, dtype=np.int64), (camera,), np.eye(4)[None])


def refine_poses(
    reference_T_body: Array, pose: IntArray, marks: TargetMarks, view: Camera | Rig, iterations: int = 12
) -> PoseFit:
    """Poses of a body by least squares, one 6 x 6 system per pose, all poses at once (Levenberg damping per pose).

    Parameters
    ----------
    reference_T_body : (k, 4, 4) start values. pose : (m,) which of them each mark belongs to.
    view : the camera of all marks (its frame is the reference), or which one of several each mark is of.
    """
    from robcal.photogrammetry.orientation.pose_loop import Rows, add_rows  # compiled: imported where it runs

    k = len(reference_T_body)
    rig = Rig.single(view, len(pose)) if isinstance(view, Camera) else view
    W = whitener(marks.covariance)
    camera_T_reference = invert(rig.reference_T_camera)

    def equations(poses: Array, chosen: IntArray) -> NormalEquations:
        rows, place = members(pose, chosen, k)
        mine = marks.select(rows)
        camera_T_body = camera_T_reference[rig.camera[rows]] @ poses[place]
        R = camera_T_body[:, :3, :3]
        predicted, d_point, _ = project_each(rig.cameras, rig.camera[rows], mine.seen_from(camera_T_body))
        n = len(chosen)
        sums = NormalEquations(np.zeros((n, 6, 6)), np.zeros((n, 6)), np.zeros(n))
        marked = Rows(place, W[rows], mine.xy - predicted, d_point, np.ascontiguousarray(R), mine.points)
        add_rows(marked, sums.matrix, sums.right, sums.cost)
        return sums

    settings = TerminationSettings(iterations, cost_tolerance=1e-8, negligible=1e-14)
    found = minimise_each(equations, _turned_little, reference_T_body, settings)
    seen = marks.seen_from(camera_T_reference[rig.camera] @ found.state[pose])
    residual = marks.xy - project_each(rig.cameras, rig.camera, seen)[0]
    count = np.bincount(pose, minlength=k).astype(np.int64)
    C = found.equations.inverse()
    C[count < 3] = np.nan
    return PoseFit(found.state, C, found.equations.cost, count, np.einsum("mij,mj->mi", W, residual))


def _turned_little(T: Array, step: Array) -> Array:
    """Frames (k, 4, 4) moved by steps (k, 6), shortened so that none turns by more than half a radian."""
    angle = np.linalg.norm(step[:, 3:], axis=1, keepdims=True)
    return retract(T, step * np.minimum(1.0, 0.5 / np.maximum(angle, 1e-300)))


def resect(
    camera: Camera, ids: Sequence[int] | IntArray, xy: Array, covariance: Array, body: Body, *, gate: float = 4.0
) -> Resection:
    """Pose of a body from the marks of one image; see :func:`resect_images`.

    Raises
    ------
    DegenerateGeometry : fewer than three marks of known targets, in one line, or no pose that three of them agree on.
    InvalidInput : a mark of a target that the body does not have.
    """
    result = resect_images(camera, np.zeros(len(xy), dtype=np.int64), ids, xy, covariance, body, gate=gate)[0]
    if isinstance(result, DegenerateGeometry):
        raise result
    return result


def resect_images(
    camera: Camera,
    image: IntArray,
    ids: Sequence[int] | IntArray,
    xy: Array,
    covariance: Array,
    body: Body,
    *,
    gate: float = 4.0,
) -> list[Resection | DegenerateGeometry]:
    """Poses of a body from many images of one camera, misidentified marks left out.

    Parameters
    ----------
    image : (m,) number of each mark's image, 0 .. k-1.
    ids, xy, covariance : (m,), (m, 2) px, (m, 2, 2) px^2 of the marks; ids must belong to the body. Where the camera
        is only a start value, the covariance includes what that may cause.
    gate : marks further off than this many standard deviations are outliers.

    Returns
    -------
    One entry per image: the resection, or the error that says why there is none.

    Raises
    ------
    InvalidInput : a mark of a target that the body does not have.
    """
    at = body.index(ids)
    if np.any(at < 0):
        raise InvalidInput(f"body {body.name} has no target {np.asarray(ids)[at < 0][0]}")
    k = int(image.max()) + 1 if len(image) else 0
    marks = TargetMarks(
        body.points[at],
        np.asarray(xy, dtype=float),
        np.asarray(covariance, dtype=float),
        0.5 * body.diameters[at],
        body.estimated_normals()[at],
    )
    rows_of = [np.flatnonzero(body.known[at] & (image == i)) for i in range(k)]
    failed: dict[int, DegenerateGeometry] = {}
    tasks: list[_Task] = []
    for i, rows in enumerate(rows_of):
        try:
            tasks += [(i, T, rows) for T in start_poses(camera, marks.xy[rows], marks.points[rows])]
        except DegenerateGeometry as error:
            failed[i] = error
    solutions = _refine_tasks(camera, marks, tasks, k)
    suspect = {i: rows for i, rows in enumerate(rows_of) if i not in failed and not _fits(solutions[i], rows, gate)}
    again = _tasks_without_outliers(camera, marks, suspect, gate)
    inside = dict(enumerate(rows_of)) | {i: rows for i, _, rows in again}
    for i, better in enumerate(_refine_tasks(camera, marks, again, k)):
        if better:
            solutions[i] = better
    nothing = "no pose agrees with the targets of the image: wrong ids, another body or a wrong camera file"
    return [
        _choose(solutions[i], inside[i], len(xy)) if solutions[i] else failed.get(i, DegenerateGeometry(nothing))
        for i in range(k)
    ]


_Task = tuple[int, Array, IntArray]
"""Number of the image, start pose camera_T_body, rows of the marks."""


@dataclass(frozen=True)
class _Solution:
    pose: Array
    covariance: Array
    cost: float


def _fits(solutions: list[_Solution], rows: IntArray, gate: float) -> bool:
    """Whether all marks of an image agree with its best pose (or are too few to tell)."""
    redundancy = 2 * len(rows) - 6
    if redundancy <= 0:
        return True
    limit = redundancy + gate * np.sqrt(2 * redundancy + 1)
    return bool(solutions) and solutions[0].cost <= max(limit, gate**2)


def _tasks_without_outliers(
    camera: Camera, marks: TargetMarks, images: Mapping[int, IntArray], gate: float
) -> list[_Task]:
    """New starts of the images; none for one without a consistent subset of four (its fit to all marks stands)."""
    tasks: list[_Task] = []
    for i, rows in images.items():
        found = _without_outliers(camera, marks, rows, gate)
        if found is None:
            continue
        pose, inside = found
        tasks.append((i, pose, inside))
        if line_ratio(marks.points[inside]) > LINE:
            tasks += [(i, T, inside) for T in start_poses(camera, marks.xy[inside], marks.points[inside])]
    return tasks


def _refine_tasks(camera: Camera, marks: TargetMarks, tasks: list[_Task], k: int) -> list[list[_Solution]]:
    """Least-squares poses, sorted by cost, per image."""
    solutions: list[list[_Solution]] = [[] for _ in range(k)]
    if not tasks:
        return solutions
    rows = np.concatenate([task[2] for task in tasks])
    which = np.repeat(np.arange(len(tasks)), [len(task[2]) for task in tasks])
    fit = refine_poses(np.array([task[1] for task in tasks]), which, marks.select(rows), camera, iterations=25)
    for j, (i, _, _) in enumerate(tasks):
        if np.isfinite(fit.cost[j]):
            solutions[i].append(_Solution(fit.reference_T_body[j], fit.covariance[j], float(fit.cost[j])))
    return [sorted(found, key=lambda s: s.cost) for found in solutions]


def _without_outliers(camera: Camera, marks: TargetMarks, rows: IntArray, gate: float) -> tuple[Array, IntArray] | None:
    """Pose and rows of the marks that agree with it (at least four), by three-point search and re-selection."""
    mine = marks.select(rows)
    sigma = float(np.sqrt(np.median(np.einsum("mii->m", mine.covariance)) / 2))
    pose, near = three_point_search(camera, mine.xy, mine.points, tolerance_px=3 * gate * sigma)
    if pose is None or near.sum() < 4:
        return None
    for _ in range(4):
        fit = _refine_tasks(camera, marks, [(0, pose, rows[near])], 1)[0]
        if not fit:
            return None
        pose = fit[0].pose
        off = np.einsum("mij,mj->mi", whitener(mine.covariance), mine.xy - project(camera, mine.seen_from(pose)))
        again = np.linalg.norm(np.where(np.isfinite(off), off, np.inf), axis=1) < gate + 1
        if again.sum() < 4 or np.array_equal(again, near):
            break
        near = again
    return pose, rows[near]


def _choose(solutions: list[_Solution], rows: IntArray, marks: int) -> Resection:
    best = solutions[0]
    other: Array | None = None
    cost_other = np.inf
    for candidate in solutions[1:]:
        if np.trace(best.pose[:3, :3].T @ candidate.pose[:3, :3]) < 3 - 1e-4:
            other, cost_other = candidate.pose, candidate.cost
            break
    mask = np.zeros(marks, dtype=bool)
    mask[rows] = True
    redundancy = 2 * len(rows) - 6
    variance = max(1.0, best.cost / redundancy) if redundancy > 0 else 1.0
    ambiguous = other is not None and cost_other - best.cost < 14 * variance
    return Resection(best.pose, best.covariance, other, ambiguous, best.cost, redundancy, cost_other, mask)
