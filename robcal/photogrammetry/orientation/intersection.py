"""Forward intersection: points from two or more cameras with known orientation, with full covariance.

The covariance has two parts that must not be mixed: the noise of the marks, independent from point to point, and the
uncertainty of the station (exterior and interior orientation), which moves all points together. The second is kept as
a derivative by the station's parameters, so that a user can propagate it through whatever comes next.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np
from numpy.typing import NDArray

from robcal.errors import InvalidInput
from robcal.estimation.batched import NormalEquations, minimise_each
from robcal.estimation.grouping import members, sum_by, whitener
from robcal.estimation.summary import TerminationSettings
from robcal.photogrammetry.core.bodies import IntArray
from robcal.photogrammetry.core.camera import Camera, normalise, project_each
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


@dataclass(frozen=True)
class Rays:
    """Marks of points in images of known orientation, m rays.

    Attributes
    ----------
    point : (m,) number of the point, 0 .. n-1; camera : (m,) number of the camera.
    xy, covariance : (m, 2) px, (m, 2, 2) px^2.
    world_T_camera : (e, 4, 4); ``exterior`` (m,) tells which of them a ray uses (default: its camera's).
    left_out : (m,) rays that take no part; None: all do whose camera's distortion can be inverted there.
    """

    point: IntArray
    camera: IntArray
    xy: Array
    covariance: Array
    cameras: Sequence[Camera]
    world_T_camera: Array
    exterior: IntArray | None = None
    left_out: NDArray[np.bool_] | None = None

    @cached_property
    def n(self) -> int:
        """Number of points."""
        return int(self.point.max(initial=-1)) + 1

    @cached_property
    def station(self) -> IntArray:
        """(m,) exterior orientation of each ray."""
        return self.camera if self.exterior is None else self.exterior

    @cached_property
    def T(self) -> Array:
        """(m, 4, 4) world_T_camera of each ray."""
        return self.world_T_camera[self.station]

    @cached_property
    def W(self) -> Array:
        """(m, 2, 2) whiteners of the marks."""
        return whitener(self.covariance)

    @cached_property
    def ideal(self) -> Array:
        """(m, 2) image points without distortion, NaN where it cannot be inverted."""
        ideal = np.empty_like(self.xy)
        for c, camera in enumerate(self.cameras):
            ideal[self.camera == c] = normalise(camera, self.xy[self.camera == c])
        return ideal

    @cached_property
    def used(self) -> NDArray[np.bool_]:
        """(m,) rays that take part."""
        finite = np.asarray(np.isfinite(self.ideal).all(axis=1))
        return finite if self.left_out is None else finite & ~self.left_out

    @cached_property
    def count(self) -> IntArray:
        """(n,) rays of each point that take part."""
        return np.bincount(self.point[self.used], minlength=self.n).astype(np.int64)

    def start(self) -> tuple[Array, NDArray[np.bool_]]:
        """Points (n, 3) nearest to the rays' lines (NaN where these do not meet), and which (n,) have one."""
        direction = np.einsum("mij,mj->mi", self.T[:, :3, :3], np.column_stack([self.ideal, np.ones(len(self.ideal))]))
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        across = np.eye(3) - direction[:, :, None] * direction[:, None, :]
        across = np.where(self.used[:, None, None], across, 0.0)
        A = sum_by(self.point, across, self.n)
        centre = np.where(self.used[:, None], self.T[:, :3, 3], 0.0)
        b = sum_by(self.point, np.einsum("mij,mj->mi", across, centre), self.n)
        regular: NDArray[np.bool_] = (self.count >= 2) & (np.linalg.eigvalsh(A)[:, 0] > 1e-9)
        p = np.full((self.n, 3), np.nan)
        p[regular] = np.linalg.solve(A[regular], b[regular][..., None])[..., 0]
        return p, regular

    def equations(self, x: Array, points: IntArray) -> NormalEquations:
        """Normal equations of the ``points`` (a,) at x (a, 3)."""
        rows, place = members(self.point, points, self.n)
        rows, place = rows[self.used[rows]], place[self.used[rows]]
        R, centre = self.T[rows, :3, :3], self.T[rows, :3, 3]
        p_camera = np.einsum("mji,mj->mi", R, x[place] - centre)
        predicted, d_point, _ = project_each(self.cameras, self.camera[rows], p_camera)
        r = np.einsum("mij,mj->mi", self.W[rows], self.xy[rows] - predicted)
        return NormalEquations.of_rows(place, r, self.W[rows] @ d_point @ np.swapaxes(R, -1, -2), len(points))

    def linearise(self, x: Array) -> tuple[Array, Array, Array, Array]:
        """Whitened residuals (m, 2) at points x (n, 3); derivatives by point, exterior and interior orientation."""
        p_camera = transform(invert(self.T), x[self.point])
        predicted, d_point, d_in = project_each(self.cameras, self.camera, p_camera)
        m = len(self.xy)
        d_ext = d_point @ np.concatenate([np.broadcast_to(-np.eye(3), (m, 3, 3)), skew(p_camera)], axis=-1)
        d_world = d_point @ np.swapaxes(self.T[:, :3, :3], -1, -2)
        ok = np.asarray(np.isfinite(d_world).all(axis=(1, 2)) & self.used)[:, None, None]
        r = np.where(ok[..., 0], np.einsum("mij,mj->mi", self.W, self.xy - predicted), 0.0)
        by_point, by_exterior, by_interior = (np.where(ok, self.W @ d, 0.0) for d in (d_world, d_ext, d_in))
        return r, by_point, by_exterior, by_interior

    def contradictions(self, p: Array, regular: NDArray[np.bool_], critical: float) -> NDArray[np.bool_]:
        """(m,) the worst ray of each point with three or more, if its redundancy-normalised residual is too large."""
        if self.count.max(initial=0) < 3:
            return np.zeros(len(self.point), dtype=bool)
        r, J, _, _ = self.linearise(p)
        Q = _inverse(sum_by(self.point, np.swapaxes(J, -1, -2) @ J, self.n), regular)
        V = np.eye(2) - J @ Q[self.point] @ np.swapaxes(J, -1, -2)
        T2 = np.einsum("mi,mij,mj->m", r, np.linalg.pinv(V, rcond=1e-9, hermitian=True), r)
        worst = np.zeros(self.n)
        np.maximum.at(worst, self.point, np.where(self.used, T2, 0.0))
        largest = (self.count[self.point] >= 3) & (worst[self.point] == T2)
        return np.asarray(self.used & largest & (critical**2 + 2 < T2))


def intersect(rays: Rays, critical: float = 4.0) -> Intersection:
    """Intersect the rays of each point; with three or more rays one that contradicts the others is left out.

    ``critical`` is the limit of the normalised contradiction of a ray, in standard deviations.

    Raises
    ------
    InvalidInput : no rays.
    """
    if len(rays.point) == 0:
        raise InvalidInput("no marks to intersect")
    p, regular = rays.start()
    at = np.flatnonzero(regular)
    settings = TerminationSettings(8, negligible=1e-10)
    while True:
        p[at] = minimise_each(partial(_equations, rays, at), np.add, p[at], settings).state
        drop = rays.contradictions(p, regular, critical)
        if not drop.any():
            break
        rays = replace(rays, left_out=drop if rays.left_out is None else rays.left_out | drop)
    point, n = rays.point, rays.n
    r, J, d_ext, d_in = rays.linearise(p)
    Q = _inverse(sum_by(point, np.swapaxes(J, -1, -2) @ J, n), regular)
    # implicit derivative: dp = -Q J' (J_station) d station
    pull = -Q[point] @ np.swapaxes(J, -1, -2)
    pull = np.where(np.isfinite(pull), pull, 0.0)
    c, e = len(rays.cameras), len(rays.world_T_camera)
    by_ext = sum_by(point * e + rays.station, pull @ d_ext, n * e).reshape(n, e, 3, 6)
    by_int = sum_by(point * c + rays.camera, pull @ d_in, n * c).reshape(n, c, 3, 9)
    chi2 = sum_by(point, np.sum(r**2, axis=1), n)
    Q[~regular] = np.nan
    return Intersection(p, Q, by_ext, by_int, rays.count, chi2, rays.used, r)


def _equations(rays: Rays, at: IntArray, x: Array, chosen: IntArray) -> NormalEquations:
    return rays.equations(x, at[chosen])


def _regular(N: Array) -> Array:
    trace = np.einsum("kii->k", N)[:, None, None]
    return N + (1e-14 * trace + 1e-300) * np.eye(3)


def _inverse(N: Array, regular: NDArray[np.bool_]) -> Array:
    Q = np.zeros_like(N)
    if regular.any():
        Q[regular] = np.linalg.inv(_regular(N[regular]))
    return Q
