"""Forward intersection: points from two or more cameras with known orientation, with full covariance.

The covariance has two parts that must not be mixed: the noise of the marks, independent from point to point, and the
uncertainty of the station (exterior and interior orientation), which moves all points together. The second is kept as
a derivative by the station's parameters, so that a user can propagate it through whatever comes next.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from robcal.errors import InvalidInput
from robcal.estimation.batched import NormalEquations, minimise_each
from robcal.estimation.grouping import members, sum_by, whitener
from robcal.estimation.summary import TerminationSettings
from robcal.photogrammetry.core.bodies import IntArray
from robcal.photogrammetry.core.camera import Camera, normalise, project_with_jacobians
from robcal.transforms import Array, invert, skew, transform


@dataclass(frozen=True)
class Intersection:
    """Intersected points.

    Attributes
    ----------
    p_world : (n, 3) m, NaN where the rays are parallel or fewer than two remain.
    covariance : (n, 3, 3) m^2 from the marks alone.
    by_exterior : (n, e, 3, 6) derivative by each exterior orientation (right perturbation).
    by_interior : (n, c, 3, 9) derivative by each camera's interior orientation.
    n_cameras : (n,) rays used.
    chi2 : (n,) sum of squared whitened residuals, redundancy 2 * n_cameras - 3.
    used : (m,) rays that stayed in the adjustment.
    whitened : (m, 2) whitened residuals.
    """

    p_world: Array
    covariance: Array
    by_exterior: Array
    by_interior: Array
    n_cameras: IntArray
    chi2: Array
    used: NDArray[np.bool_]
    whitened: Array


def intersect(
    point: IntArray,
    camera: IntArray,
    xy: Array,
    covariance: Array,
    cameras: Sequence[Camera],
    world_T_camera: Array,
    *,
    exterior: IntArray | None = None,
    critical: float = 4.0,
    iterations: int = 8,
) -> Intersection:
    """Intersect the rays of each point; with three or more rays one that contradicts the others is left out.

    Parameters
    ----------
    point : (m,) number of the point, 0 .. n-1; camera : (m,) number of the camera.
    xy, covariance : (m, 2) px, (m, 2, 2) px^2.
    world_T_camera : (e, 4, 4); ``exterior`` (m,) tells which of them a ray uses (default: its camera's).
    critical : limit of the normalised contradiction of a ray (in standard deviations).
    """
    if len(point) == 0:
        raise InvalidInput("no marks to intersect")
    station = camera if exterior is None else exterior
    n = int(point.max()) + 1
    W = whitener(covariance)
    ideal = np.empty_like(xy)
    for c, cam in enumerate(cameras):
        rows = camera == c
        ideal[rows] = normalise(cam, xy[rows])
    used = np.asarray(np.isfinite(ideal).all(axis=1))
    T = world_T_camera[station]
    direction = np.einsum("mij,mj->mi", T[:, :3, :3], np.column_stack([ideal, np.ones(len(ideal))]))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    across = np.eye(3) - direction[:, :, None] * direction[:, None, :]
    across = np.where(used[:, None, None], across, 0.0)
    A = sum_by(point, across, n)
    b = sum_by(point, np.einsum("mij,mj->mi", across, np.where(used[:, None], T[:, :3, 3], 0.0)), n)
    count = np.bincount(point[used], minlength=n).astype(np.int64)
    regular: NDArray[np.bool_] = (count >= 2) & (np.linalg.eigvalsh(A)[:, 0] > 1e-9)
    p = np.full((n, 3), np.nan)
    p[regular] = np.linalg.solve(A[regular], b[regular][..., None])[..., 0]

    def linearise(x: Array) -> tuple[Array, Array, Array, Array]:
        p_camera = transform(invert(T), x[point])
        r, d_point, d_in = np.empty((len(xy), 2)), np.empty((len(xy), 2, 3)), np.empty((len(xy), 2, 9))
        for c, cam in enumerate(cameras):
            rows = camera == c
            value, d_point[rows], d_in[rows] = project_with_jacobians(cam, p_camera[rows])
            r[rows] = xy[rows] - value
        d_ext = d_point @ np.concatenate([np.broadcast_to(-np.eye(3), (len(xy), 3, 3)), skew(p_camera)], axis=-1)
        d_world = d_point @ np.swapaxes(T[:, :3, :3], -1, -2)
        mask = used[:, None, None]
        ok = np.asarray(np.isfinite(d_world).all(axis=(1, 2)))[:, None, None] & mask
        return (
            np.where(ok[..., 0], np.einsum("mij,mj->mi", W, r), 0.0),
            np.where(ok, W @ d_world, 0.0),
            np.where(ok, W @ d_ext, 0.0),
            np.where(ok, W @ d_in, 0.0),
        )

    def equations(x: Array, chosen: IntArray) -> NormalEquations:
        rows, place = members(point, at[chosen], n)
        rows, place = rows[used[rows]], place[used[rows]]
        R, centre = T[rows, :3, :3], T[rows, :3, 3]
        p_camera = np.einsum("mji,mj->mi", R, x[place] - centre)
        predicted, d_point = np.empty((len(rows), 2)), np.empty((len(rows), 2, 3))
        for c, cam in enumerate(cameras):
            own = camera[rows] == c
            predicted[own], d_point[own], _ = project_with_jacobians(cam, p_camera[own])
        r = np.einsum("mij,mj->mi", W[rows], xy[rows] - predicted)
        return NormalEquations.of_rows(place, r, W[rows] @ d_point @ np.swapaxes(R, -1, -2), len(chosen))

    at = np.flatnonzero(regular)
    settings = TerminationSettings(iterations, negligible=1e-10)
    p[at] = minimise_each(equations, np.add, p[at], settings).state
    while count.max(initial=0) >= 3:
        # redundancy-normalised residual per ray; drop the worst one of each point that has three or more
        r, J, _, _ = linearise(p)
        Q = _inverse(sum_by(point, np.swapaxes(J, -1, -2) @ J, n), regular)
        V = np.eye(2) - J @ Q[point] @ np.swapaxes(J, -1, -2)
        T2 = np.einsum("mi,mij,mj->m", r, np.linalg.pinv(V, rcond=1e-9, hermitian=True), r)
        worst = np.zeros(n)
        np.maximum.at(worst, point, np.where(used, T2, 0.0))
        drop = used & (count[point] >= 3) & (worst[point] == T2) & (critical**2 + 2 < T2)
        if not drop.any():
            break
        used = used & ~drop
        count = np.bincount(point[used], minlength=n).astype(np.int64)
        p[at] = minimise_each(equations, np.add, p[at], settings).state
    r, J, d_ext, d_in = linearise(p)
    Q = _inverse(sum_by(point, np.swapaxes(J, -1, -2) @ J, n), regular)
    # implicit derivative: dp = -Q J' (J_station) d station
    pull = -Q[point] @ np.swapaxes(J, -1, -2)
    pull = np.where(np.isfinite(pull), pull, 0.0)
    c, e = len(cameras), len(world_T_camera)
    by_ext = sum_by(point * e + station, pull @ d_ext, n * e).reshape(n, e, 3, 6)
    by_int = sum_by(point * c + camera, pull @ d_in, n * c).reshape(n, c, 3, 9)
    chi2 = sum_by(point, np.sum(r**2, axis=1), n)
    Q[~regular] = np.nan
    return Intersection(p, Q, by_ext, by_int, count, chi2, used, r)


def _regular(N: Array) -> Array:
    trace = np.einsum("kii->k", N)[:, None, None]
    return N + (1e-14 * trace + 1e-300) * np.eye(3)


def _inverse(N: Array, regular: NDArray[np.bool_]) -> Array:
    Q = np.zeros_like(N)
    if regular.any():
        Q[regular] = np.linalg.inv(_regular(N[regular]))
    return Q
