"""Least-squares adjustment of a station: all cameras, all poses and the body together.

The body poses are eliminated from the normal equations (Schur complement), so the system to solve has only the unknowns
of cameras and body, however many poses there are.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from robcal.errors import NotIdentifiable
from robcal.estimation.grouping import whitener
from robcal.estimation.levenberg import Linearised, levenberg
from robcal.estimation.robust import huber_costs, huber_weights
from robcal.estimation.schur import Factor, Normals, SingularSystem, station_cofactors
from robcal.estimation.summary import SolveSummary, TerminationSettings
from robcal.photogrammetry.core.camera import INTRINSIC_NAMES, Camera, project_with_jacobians
from robcal.photogrammetry.core.eccentricity import effective_point
from robcal.photogrammetry.station.network import MarkTable, Prior, StationDesign, Unknowns
from robcal.transforms import Array, invert, retract

if TYPE_CHECKING:
    from robcal.photogrammetry.station.adjustment_loops import Blocks, Places

_POSE_DAMPING = 1e-13
"""Relative to the diagonal: a pose whose few marks leave a direction open stays in the adjustment."""


def interior_basis(interior: Array) -> Array:
    """(c, 9, 9) columns: derivative of the nine numbers by the adjusted unknowns.

    Unknown 0 changes the mean focal length at fixed fx : fy, unknown 1 the difference of fx and fy at fixed mean; the
    others are the numbers themselves. So a focal length can be adjusted without an affinity that the data do not carry.
    """
    c = len(interior)
    basis = np.broadcast_to(np.eye(9), (c, 9, 9)).copy()
    mean = 0.5 * (interior[:, 0] + interior[:, 1])
    basis[:, 0, 0] = interior[:, 0] / mean
    basis[:, 1, 0] = interior[:, 1] / mean
    basis[:, 0, 1] = 0.5
    basis[:, 1, 1] = -0.5
    return basis


def interior_prior(camera: Camera) -> Array:
    """(9,) standard deviations of the adjusted unknowns before any data: what lenses on the market do.

    Focal length 20 %, affinity 1 %, principal point 10 % of the longer side; radial terms that move the image corner by
    30 % of its distance each, decentring by 2 %. They only keep unknowns finite that the images say nothing about.
    """
    f = 0.5 * (camera.fx + camera.fy)
    side = max(camera.width, camera.height)
    corner = 0.5 * np.hypot(camera.width, camera.height) / f
    return np.array(
        [
            0.2 * f,
            0.01 * f,
            0.1 * side,
            0.1 * side,
            0.3 / corner**2,
            0.3 / corner**4,
            0.02 / corner,
            0.02 / corner,
            0.3 / corner**6,
        ]
    )


@dataclass(frozen=True)
class Linearisation:
    """Whitened residuals (m, 2) and derivatives of the image by exterior, interior unknowns, point and pose."""

    residual: Array
    by_exterior: Array
    by_interior: Array
    by_point: Array
    by_pose: Array
    whitening: Array


def linearise(marks: MarkTable, x: Unknowns, cameras: tuple[Camera, ...], noise: Array) -> Linearisation:
    """Residuals and Jacobian blocks of all marks; ``noise`` (c,) multiplies each camera's standard deviations.

    Marks whose target comes to lie behind its camera have NaN residuals.
    """
    W = whitener(marks.covariance) / noise[marks.camera][:, None, None]
    every = invert(x.world_T_exterior)[:, None] @ x.world_T_body  # an image has one frame, its marks are many
    camera_T_body = every[marks.exterior, marks.pose]
    R = camera_T_body[:, :3, :3]
    p_body = x.points[marks.target]
    p_camera = np.einsum("mij,mj->mi", R, p_body) + camera_T_body[:, :3, 3]
    seen = effective_point(p_camera, np.einsum("mij,mj->mi", R, marks.normals), marks.radius)
    from robcal.photogrammetry.station.adjustment_loops import Blocks, differentiate  # compiled

    m = len(marks)
    r, d_point, d_in = np.empty((m, 2)), np.empty((m, 2, 3)), np.empty((m, 2, 9))
    basis = interior_basis(x.interior)
    for c, camera in enumerate(cameras):
        rows = marks.camera == c
        value, d_point[rows], by_numbers = project_with_jacobians(camera.with_vector(x.interior[c]), seen[rows])
        d_in[rows] = (by_numbers.reshape(-1, 9) @ basis[c]).reshape(-1, 2, 9)
        r[rows] = marks.xy[rows] - value
    out = Blocks(*(np.empty(shape) for shape in ((m, 2), (m, 2, 6), (m, 2, 9), (m, 2, 3), (m, 2, 6))))
    differentiate(W, r, d_point, d_in, np.ascontiguousarray(R), p_camera, p_body, out)
    return Linearisation(*out, W)


@dataclass(frozen=True)
class Adjusted:
    """Solution of the adjustment: unknowns, linearised model, sum of squares of marks, how it ended."""

    unknowns: Unknowns
    design: StationDesign
    cost: float
    summary: SolveSummary


def interior_offset(x: Unknowns, prior: Prior) -> Array:
    """(c, 9) present minus prior interior orientation, in the adjusted unknowns."""
    difference = x.interior - prior.interior
    return np.asarray(np.linalg.solve(interior_basis(prior.interior), difference[..., None])[..., 0])


def global_columns(marks: MarkTable, e: int, c: int) -> NDArray[np.int64]:
    """(m, 18) global column numbers of each mark's exterior, interior and point unknowns."""
    return np.concatenate(
        [
            6 * marks.exterior[:, None] + np.arange(6),
            6 * e + 9 * marks.camera[:, None] + np.arange(9),
            6 * e + 9 * c + 3 * marks.target[:, None] + np.arange(3),
        ],
        axis=1,
    )


def prior_terms(x: Unknowns, prior: Prior) -> tuple[Array, Array, float]:
    """Normal matrix, right side and cost of the weighted observations of unknowns."""
    e, c, t = len(x.world_T_exterior), len(x.interior), len(x.points)
    g = 6 * e + 9 * c + 3 * t
    N, b = np.zeros((g, g)), np.zeros(g)
    at = slice(6 * e, 6 * e + 9 * c)
    weight = 1.0 / prior.interior_sigma.ravel() ** 2
    offset = interior_offset(x, prior).ravel()
    N[at, at] = np.diag(weight)
    b[at] = -weight * offset
    cost = float(np.sum(weight * offset**2))
    if prior.points_weight is not None:
        residual = (prior.points - x.points).ravel()
        pull = prior.points_weight @ residual
        N[6 * e + 9 * c :, 6 * e + 9 * c :] = prior.points_weight
        b[6 * e + 9 * c :] = pull
        cost += float(residual @ pull)
    return N, b, cost


def without_nan(lin: Linearisation) -> Linearisation:
    """Marks behind their camera, whose weight is zero, with zeros."""
    if np.isfinite(lin.residual).all():
        return lin
    return Linearisation(*(np.where(np.isfinite(a), a, 0.0) for a in vars(lin).values()))


def station_normals(lin: Linearisation, marks: MarkTable, x: Unknowns, prior: Prior, weights: Array) -> Normals:
    """Normal equations of all global unknowns and the poses: weighted marks, weighted observations of unknowns."""
    e, c, p = len(x.world_T_exterior), len(x.interior), len(x.world_T_body)
    g = 6 * e + 9 * c + 3 * len(x.points)
    from robcal.photogrammetry.station.adjustment_loops import Sums, add_marks  # compiled

    sums = Sums(np.zeros((g, g)), np.zeros(g), np.zeros((g, p, 6)), np.zeros((p, 6, 6)), np.zeros((p, 6)))
    add_marks(mark_blocks(lin), mark_places(marks, e, c), weights, sums)
    N, b, _ = prior_terms(x, prior)
    N += np.tril(sums.matrix) + np.tril(sums.matrix, -1).T
    V = sums.pose_matrix * (1.0 + _POSE_DAMPING * np.eye(6))
    return Normals(N, sums.coupling.transpose(1, 0, 2), V, b + sums.right, sums.pose_right)


def mark_blocks(lin: "Linearisation | StationDesign") -> "Blocks":
    """Residuals and derivatives as the compiled loops take them."""
    from robcal.photogrammetry.station.adjustment_loops import Blocks

    return Blocks(lin.residual, lin.by_exterior, lin.by_interior, lin.by_point, lin.by_pose)


def mark_places(marks: MarkTable, e: int, c: int) -> "Places":
    """Rows of the unknowns of each mark as the compiled loops take them."""
    from robcal.photogrammetry.station.adjustment_loops import Places

    return Places(marks.exterior, marks.camera, marks.target, marks.pose, e, c)


def _factor(normals: Normals, active: NDArray[np.bool_], names: Sequence[str], damping: float = 0.0) -> Factor:
    """Raises NotIdentifiable, which names the unknowns, where the system is singular."""
    try:
        return Factor(normals, held=~active, damping=damping)
    except SingularSystem as singular:
        weak = np.abs(singular.weakest)
        tied = [names[i] for i in np.argsort(weak)[::-1][:4] if weak[i] > 0.2]
        raise NotIdentifiable(
            "the images do not determine " + ", ".join(tied) + ": add poses that are tilted and at other "
            "distances, or give camera files and keep intrinsics fixed",
            tied,
        ) from None


def unknown_names(cameras: tuple[str, ...], exterior: list[str], ids: NDArray[np.int64]) -> list[str]:
    """Names of the global unknowns in their order."""
    six = ("x", "y", "z", "rx", "ry", "rz")
    interior = ("f", "affinity", *INTRINSIC_NAMES[2:])
    names = [f"{name}.{k}" for name in exterior for k in six]
    names += [f"{name}.{k}" for name in cameras for k in interior]
    return names + [f"target {i}.{k}" for i in ids for k in "xyz"]


def moved_unknowns(x: Unknowns, global_step: Array, pose_step: Array, basis: Array) -> Unknowns:
    """The unknowns after steps of the global ones (6e + 9c + 3t,) and of the poses (p, 6)."""
    e, c = len(x.world_T_exterior), len(x.interior)
    exterior = global_step[: 6 * e].reshape(e, 6)
    interior = np.einsum("cij,cj->ci", basis, global_step[6 * e : 6 * e + 9 * c].reshape(c, 9))
    return Unknowns(
        x.interior + interior,
        retract(x.world_T_exterior, exterior),
        retract(x.world_T_body, pose_step),
        x.points + global_step[6 * e + 9 * c :].reshape(-1, 3),
    )


def mark_weights(residual: Array, limit: float | None) -> Array:
    """(m,) weights of whitened residuals (m, 2): Huber's on their lengths, or one."""
    return np.ones(len(residual)) if limit is None else huber_weights(np.linalg.norm(residual, axis=1), limit)


def mark_cost(residual: Array, limit: float | None) -> float:
    """Sum of squares of whitened residuals (m, 2), or of Huber's costs; infinite for a mark behind its camera."""
    length = np.linalg.norm(residual, axis=1)
    if not np.isfinite(length).all():
        return np.inf
    return float(np.sum(length**2 if limit is None else huber_costs(length, limit)))


@dataclass(frozen=True)
class _At:
    """Unknowns with the marks linearised there; ``half_cost`` with the priors."""

    unknowns: Unknowns
    lin: Linearisation
    half_cost: float


def adjust_station(  # noqa: PLR0913 - options by keyword
    marks: MarkTable,
    start: Unknowns,
    cameras: tuple[Camera, ...],
    active: NDArray[np.bool_],
    prior: Prior,
    noise: Array,
    names: list[str],
    *,
    huber: float | None = None,
    max_iterations: int = 30,
) -> Adjusted:
    """Adjust the active global unknowns and all poses.

    Parameters
    ----------
    active : (6e + 9c + 3t,) which exterior, interior and point unknowns are free.
    noise : (c,) factor on each camera's standard deviations.
    huber : limit of the robust weights in standard deviations; None for plain least squares.

    Raises
    ------
    NotIdentifiable : the reduced normal matrix of the active unknowns is singular.
    """

    def at(x: Unknowns) -> _At:
        lin = linearise(marks, x, cameras, noise)
        return _At(x, lin, 0.5 * (mark_cost(lin.residual, huber) + prior_terms(x, prior)[2]))

    def system_at(here: _At) -> tuple[Linearisation, Array, Normals]:
        weights = mark_weights(here.lin.residual, huber)
        clean = without_nan(here.lin)
        return clean, weights, station_normals(clean, marks, here.unknowns, prior, weights)

    def local(here: _At) -> Linearised[_At]:
        _, _, system = system_at(here)
        basis = interior_basis(here.unknowns.interior)

        def propose(damping: float) -> tuple[_At, float]:
            step, pose_step = _factor(system, active, names, damping).solve(system.b, system.s)
            saved = 0.5 * float(step @ system.b + np.sum(pose_step * system.s))
            return at(moved_unknowns(here.unknowns, step, pose_step, basis)), saved

        return Linearised(here.half_cost, propose, lambda trial: trial.half_cost)

    tolerance = 0.5e-7  # of a mark's share of the sum of squares
    settings = TerminationSettings(max_iterations, 12, 2.0 * tolerance / max(1, len(marks)), tolerance)
    end, summary = levenberg(local, at(start), settings)
    clean, weights, system = system_at(end)
    factor = _factor(system, active, names)
    design = StationDesign(
        clean.residual,
        clean.by_exterior,
        clean.by_interior,
        clean.by_point,
        clean.by_pose,
        end.lin.whitening,
        weights,
        active,
        factor.cofactors(),
        factor.station_inverse,
        factor.station_response,
    )
    squares = float(np.sum(clean.residual**2))
    return Adjusted(end.unknowns, design, squares, summary)


def covariance_blocks(design: StationDesign, marks: MarkTable, e: int, c: int) -> tuple[Array, Array]:
    """Marginal covariances (p, 6, 6) of the poses and redundancy matrices (m, 2, 2) of the marks, ``I - A Q A'``.

    ``e`` and ``c`` are the numbers of exterior and interior orientations.
    """
    Q = design.reduced_inverse
    Qpp, Qgp = station_cofactors(design.pose_inverse, design.pose_response, Q)
    return Qpp, mark_redundancy(design, marks, (e, c), Q, np.ascontiguousarray(Qgp.transpose(1, 0, 2)), Qpp)


def mark_redundancy(
    lin: "Linearisation | StationDesign", marks: MarkTable, counts: tuple[int, int], Q: Array, Qpg: Array, Qpp: Array
) -> Array:
    """Redundancy matrices (m, 2, 2) of the whitened marks, ``I - A Q A'``.

    Parameters
    ----------
    counts : of exterior and interior orientations.
    Q, Qpg, Qpp : (g, g), (p, g, 6), (p, 6, 6) cofactors of the global unknowns, of these with the twist of each pose,
        and of the twists.
    """
    from robcal.photogrammetry.station.adjustment_loops import covariances  # compiled

    covariance = np.empty((len(marks), 2, 2))
    covariances(mark_blocks(lin), mark_places(marks, *counts), Q, Qpg, Qpp, covariance)
    return np.eye(2) - covariance
