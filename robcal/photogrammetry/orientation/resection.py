"""Spatial resection: the pose of a known body from one image (or from several cameras at once), many images together.

Closed form for the start (IPPE for planes, SQPnP otherwise, three-point search where marks are misidentified), then
least squares with the marks' covariances. A plane seen by one camera has two poses of similar fit; both are returned.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from robcal.errors import DegenerateGeometry, InvalidInput
from robcal.estimation.batched import NormalEquations, minimise_each
from robcal.estimation.grouping import members, whitener
from robcal.estimation.summary import TerminationSettings
from robcal.photogrammetry.core.bodies import Body, IntArray, line_ratio
from robcal.photogrammetry.core.camera import Camera, project, project_with_jacobians
from robcal.photogrammetry.core.eccentricity import effective_point
from robcal.photogrammetry.orientation.closed_form import LINE, start_poses, three_point_search
from robcal.transforms import Array, invert, retract, skew, transform


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


def refine_poses(
    reference_T_body: Array,
    pose: IntArray,
    camera: IntArray,
    cameras: Sequence[Camera],
    reference_T_camera: Array,
    points: Array,
    xy: Array,
    covariance: Array,
    *,
    radius: Array | None = None,
    normals: Array | None = None,
    iterations: int = 12,
) -> PoseFit:
    """Poses of a body by least squares, one 6 x 6 system per pose, all poses at once (Levenberg damping per pose).

    Parameters
    ----------
    reference_T_body : (k, 4, 4) start values.
    pose, camera : (m,) which pose and which camera each mark belongs to.
    cameras : the cameras; reference_T_camera (c, 4, 4) their fixed exterior orientations.
    points : (m, 3) m body coordinates of each mark's target; xy (m, 2) px, covariance (m, 2, 2) px^2.
    radius, normals : (m,), (m, 3) of circular targets, for the eccentricity of their images.
    """
    k = len(reference_T_body)
    W = whitener(covariance)
    camera_T_reference = invert(reference_T_camera)

    def camera_points(poses: Array, rows: IntArray, place: IntArray) -> tuple[Array, Array]:
        camera_T_body = (camera_T_reference[camera[rows]] @ poses[place]) if len(rows) else np.empty((0, 4, 4))
        p_camera = transform(camera_T_body, points[rows])
        if radius is not None and normals is not None:
            turned = np.einsum("mij,mj->mi", camera_T_body[:, :3, :3], normals[rows])
            p_camera = effective_point(p_camera, turned, radius[rows])
        return p_camera, camera_T_body[:, :3, :3]

    def equations(poses: Array, chosen: IntArray) -> NormalEquations:
        rows, place = members(pose, chosen, k)
        p_camera, R = camera_points(poses, rows, place)
        predicted, d_point = np.empty((len(rows), 2)), np.empty((len(rows), 2, 3))
        for c, cam in enumerate(cameras):
            own = camera[rows] == c
            predicted[own], d_point[own], _ = project_with_jacobians(cam, p_camera[own])
        r = np.einsum("mij,mj->mi", W[rows], xy[rows] - predicted)
        J = W[rows] @ d_point @ np.concatenate([R, -R @ skew(points[rows])], axis=-1)
        return NormalEquations.of_rows(place, r, J, len(chosen))

    settings = TerminationSettings(iterations, cost_tolerance=1e-8, negligible=1e-14)
    found = minimise_each(equations, _turned_little, reference_T_body, settings)
    p_camera, _ = camera_points(found.state, np.arange(len(pose)), pose)
    predicted = np.empty((len(pose), 2))
    for c, cam in enumerate(cameras):
        predicted[camera == c] = project(cam, p_camera[camera == c])
    count = np.bincount(pose, minlength=k).astype(np.int64)
    C = found.equations.inverse()
    C[count < 3] = np.nan
    return PoseFit(found.state, C, found.equations.cost, count, np.einsum("mij,mj->mi", W, xy - predicted))


def _turned_little(T: Array, step: Array) -> Array:
    """Frames (k, 4, 4) moved by steps (k, 6), shortened so that none turns by more than half a radian."""
    angle = np.linalg.norm(step[:, 3:], axis=1, keepdims=True)
    return retract(T, step * np.minimum(1.0, 0.5 / np.maximum(angle, 1e-300)))


def resect(
    camera: Camera,
    ids: Sequence[int] | IntArray,
    xy: Array,
    covariance: Array,
    body: Body,
    *,
    gate: float = 4.0,
    model_error_px: float = 0.0,
) -> Resection:
    """Pose of a body from the marks of one image; see :func:`resect_images`.

    Raises
    ------
    DegenerateGeometry : fewer than three marks of known targets, in one line, or no pose that three of them agree on.
    InvalidInput : a mark of a target that the body does not have.
    """
    image = np.zeros(len(xy), dtype=np.int64)
    result = resect_images(camera, image, ids, xy, covariance, body, gate=gate, model_error_px=model_error_px)[0]
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
    model_error_px: float = 0.0,
) -> list[Resection | DegenerateGeometry]:
    """Poses of a body from many images of one camera, misidentified marks left out.

    Parameters
    ----------
    image : (m,) number of each mark's image, 0 .. k-1.
    ids, xy, covariance : (m,), (m, 2) px, (m, 2, 2) px^2 of the marks; ids must belong to the body.
    gate : marks further off than this many standard deviations are outliers.
    model_error_px : what the camera's start values may be wrong by, added to the marks' covariance.

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
    keep = body.known[at]
    C = np.asarray(covariance, dtype=float) + model_error_px**2 * np.eye(2)
    data = _Marks(
        camera, body.points[at], np.asarray(xy, dtype=float), C, 0.5 * body.diameters[at], body.estimated_normals()[at]
    )
    rows_of = [np.flatnonzero(keep & (image == i)) for i in range(k)]
    failed: dict[int, DegenerateGeometry] = {}
    tasks: list[tuple[int, Array, IntArray]] = []
    for i, rows in enumerate(rows_of):
        try:
            starts = start_poses(camera, data.xy[rows], data.points[rows])
        except DegenerateGeometry as error:
            failed[i] = error
            continue
        tasks += [(i, T, rows) for T in starts]
    solutions = _refine_tasks(data, tasks, k)
    again: list[tuple[int, Array, IntArray]] = []
    inside = dict(enumerate(rows_of))
    for i, rows in enumerate(rows_of):
        m = len(rows)
        if i in failed or m <= 3:
            continue
        limit = 2 * m - 6 + gate * np.sqrt(2 * (2 * m - 6) + 1)
        if solutions[i] and solutions[i][0].cost <= max(limit, gate**2):
            continue
        found = _without_outliers(data, rows, gate)
        if found is not None:
            pose, inside[i] = found
            again.append((i, pose, inside[i]))
            if line_ratio(data.points[inside[i]]) > LINE:
                again += [(i, T, inside[i]) for T in start_poses(camera, data.xy[inside[i]], data.points[inside[i]])]
        # else: no consistent subset of four; the fit to all marks stands, with its large chi-square
    for i, better in enumerate(_refine_tasks(data, again, k)):
        if better:
            solutions[i] = better
    out: list[Resection | DegenerateGeometry] = []
    for i in range(k):
        if i in failed or not solutions[i]:
            reason = failed.get(i)
            text = "no pose agrees with the targets of the image: wrong ids, another body or a wrong camera file"
            out.append(reason if reason is not None else DegenerateGeometry(text))
            continue
        out.append(_choose(solutions[i], inside[i], len(xy)))
    return out


@dataclass(frozen=True)
class _Marks:
    camera: Camera
    points: Array
    xy: Array
    covariance: Array
    radius: Array
    normals: Array


@dataclass(frozen=True)
class _Solution:
    pose: Array
    covariance: Array
    cost: float


def _refine_tasks(data: _Marks, tasks: list[tuple[int, Array, IntArray]], k: int) -> list[list[_Solution]]:
    """Least-squares poses of (image, start pose, rows), sorted by cost, per image."""
    solutions: list[list[_Solution]] = [[] for _ in range(k)]
    if not tasks:
        return solutions
    rows = np.concatenate([task[2] for task in tasks])
    which = np.repeat(np.arange(len(tasks)), [len(task[2]) for task in tasks])
    fit = refine_poses(
        np.array([task[1] for task in tasks]),
        which,
        np.zeros(len(rows), dtype=np.int64),
        [data.camera],
        np.eye(4)[None],
        data.points[rows],
        data.xy[rows],
        data.covariance[rows],
        radius=data.radius[rows],
        normals=data.normals[rows],
        iterations=25,
    )
    for j, (i, _, _) in enumerate(tasks):
        if np.isfinite(fit.cost[j]):
            solutions[i].append(_Solution(fit.reference_T_body[j], fit.covariance[j], float(fit.cost[j])))
    return [sorted(found, key=lambda s: s.cost) for found in solutions]


def _without_outliers(data: _Marks, rows: IntArray, gate: float) -> tuple[Array, IntArray] | None:
    """Pose and rows of the marks that agree with it (at least four), by three-point search and re-selection."""
    sigma = float(np.sqrt(np.median(np.einsum("mii->m", data.covariance[rows])) / 2))
    pose, near = three_point_search(data.camera, data.xy[rows], data.points[rows], tolerance_px=3 * gate * sigma)
    if pose is None or near.sum() < 4:
        return None
    for _ in range(4):
        fit = _refine_tasks(data, [(0, pose, rows[near])], 1)[0]
        if not fit:
            return None
        pose = fit[0].pose
        again = np.linalg.norm(_whiten(data, pose, rows), axis=1) < gate + 1
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


def _whiten(data: _Marks, camera_T_body: Array, rows: IntArray) -> Array:
    normals = data.normals[rows] @ camera_T_body[:3, :3].T
    p = effective_point(transform(camera_T_body, data.points[rows]), normals, data.radius[rows])
    off = np.einsum("mij,mj->mi", whitener(data.covariance[rows]), data.xy[rows] - project(data.camera, p))
    return np.where(np.isfinite(off), off, np.inf)
