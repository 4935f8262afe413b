"""Normal equations of a bundle adjustment: linearised marks, elimination of the stations, solution and cofactors.

Unknowns: k numbers of the interior orientation and 3t coordinates (together the reduced system, a = k + 3t), and six
numbers of every station, which only its own marks see and which are eliminated (Schur complement). Source: Brown
(1976), "The bundle adjustment - progress and prospects"; Triggs et al. (2000), "Bundle adjustment", section 6.
Stations are perturbed on the right: p_camera = R (Exp(omega) p + rho) + t.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from robcal.photogrammetry.core.camera import Camera, project_with_jacobians
from robcal.photogrammetry.core.network import ImageMarks, IntArray
from robcal.transforms import Array, retract


@dataclass(frozen=True)
class State:
    """Values of all unknowns: interior orientation, camera_T_body (n, 4, 4) and points (t, 3)."""

    camera: Camera
    camera_T_body: Array
    points: Array

    def moved(self, basis: Array, reduced: Array, stations: Array) -> State:
        """The state after a step: reduced (a,) = free intrinsics (columns of basis) then points; stations (n, 6)."""
        k = basis.shape[1]
        return State(
            self.camera.with_vector(self.camera.vector + basis @ reduced[:k]),
            retract(self.camera_T_body, stations),
            self.points + reduced[k:].reshape(-1, 3),
        )


class MarkOrder:
    """Marks sorted by image, and how to sum over images and targets."""

    def __init__(self, marks: ImageMarks, images: int, targets: int) -> None:
        order = np.lexsort((marks.target, marks.image))
        self.marks = marks.select(order)
        self.order = order
        self.images, self.targets = images, targets
        self.image_slices = _slices(self.marks.image, images)
        self.by_target = np.argsort(self.marks.target, kind="stable")
        self.target_slices = _slices(self.marks.target[self.by_target], targets)
        # covariance = L L'; whitening multiplies by L^-1
        self.factor = np.linalg.cholesky(self.marks.covariance)
        self.whitener = np.linalg.inv(self.factor)


def _slices(sorted_index: IntArray, count: int) -> list[slice]:
    edges = np.searchsorted(sorted_index, np.arange(count + 1))
    return [slice(a, b) for a, b in pairwise(edges.tolist())]


def whitened_residuals(state: State, order: MarkOrder, shift: Array) -> Array:
    """Residuals (m, 2) measured minus projected, multiplied by L^-1; ``shift`` (m, 2) px is the eccentricity."""
    marks = order.marks
    R, t = state.camera_T_body[:, :3, :3], state.camera_T_body[:, :3, 3]
    p = np.einsum("mij,mj->mi", R[marks.image], state.points[marks.target]) + t[marks.image]
    c = state.camera
    z = np.where(p[:, 2] > 0, p[:, 2], np.nan)
    x, y = p[:, 0] / z, p[:, 1] / z
    r2 = x * x + y * y
    radial = 1.0 + r2 * (c.k1 + r2 * (c.k2 + r2 * c.k3))
    u = c.fx * (x * radial + 2.0 * c.p1 * x * y + c.p2 * (r2 + 2.0 * x * x)) + c.cx
    v = c.fy * (y * radial + c.p1 * (r2 + 2.0 * y * y) + 2.0 * c.p2 * x * y) + c.cy
    r = marks.xy - shift - np.stack([u, v], axis=1)
    return np.einsum("mij,mj->mi", order.whitener, r)


@dataclass(frozen=True)
class Linearised:
    """Whitened residuals (m, 2) and derivatives of the whitened projection, sorted by image.

    ``J`` (m, 2, k + 9): free intrinsics, the mark's point, the mark's station.
    """

    r: Array
    J: Array
    k: int


def linearise(state: State, order: MarkOrder, basis: Array, shift: Array) -> Linearised:
    """Linearised marks; ``basis`` (9, k) spans the free changes of the interior orientation.

    The dependence of the eccentricity on the unknowns is neglected (a dot's image size squared).
    """
    marks, k = order.marks, basis.shape[1]
    R = state.camera_T_body[marks.image, :3, :3]
    X = state.points[marks.target]
    p = np.einsum("mij,mj->mi", R, X) + state.camera_T_body[marks.image, :3, 3]
    xy, d_point, d_in = project_with_jacobians(state.camera, p)
    J = np.empty((len(marks), 2, k + 9))
    J[:, :, :k] = (d_in.reshape(-1, 9) @ basis).reshape(len(marks), 2, k)
    J[:, :, k : k + 3] = d_point @ R
    # whitened by the lower triangle L^-1; element by element, as products of small matrices are slow in numpy
    w, by_camera_and_point = order.whitener, J[:, :, : k + 3]
    by_camera_and_point[:, 1] *= w[:, 1, 1, None]
    by_camera_and_point[:, 1] += w[:, 1, 0, None] * by_camera_and_point[:, 0]
    by_camera_and_point[:, 0] *= w[:, 0, 0, None]
    J[:, :, k + 3 : k + 6] = J[:, :, k : k + 3]
    # -j [X] = X x j
    for a, b, c in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        J[:, :, k + 6 + a] = X[:, None, b] * J[:, :, k + c] - X[:, None, c] * J[:, :, k + b]
    r = np.einsum("mij,mj->mi", order.whitener, marks.xy - shift - xy)
    return Linearised(r, J, k)


@dataclass(frozen=True)
class LinearisedLengths:
    """Scale bars: whitened residuals (b,), directions (b, 3) to the first point over sigma, rows (b, 2) of points."""

    r: Array
    direction: Array
    rows: IntArray


def linearise_lengths(points: Array, rows: IntArray, length: Array, sigma: Array) -> LinearisedLengths:
    """Scale bars as weighted observations of the distance between two points."""
    difference = points[rows[:, 0]] - points[rows[:, 1]]
    distance = np.linalg.norm(difference, axis=1)
    return LinearisedLengths((length - distance) / sigma, difference / distance[:, None] / sigma[:, None], rows)


@dataclass(frozen=True)
class Normals:
    """Normal equations with the stations still in place.

    ``A`` (a, a) of intrinsics and coordinates, ``G`` (n, a, 6) mixed, ``V`` (n, 6, 6) of the stations; right-hand
    sides ``b`` (a,) and ``s`` (n, 6).
    """

    A: Array
    G: Array
    V: Array
    b: Array
    s: Array


def build_normals(lin: Linearised, weights: Array | None, order: MarkOrder, lengths: LinearisedLengths) -> Normals:
    """Sum the normal equations; ``weights`` (m,) multiply squared residuals (robust weights, variance components)."""
    k, n, t = lin.k, order.images, order.targets
    a = k + 3 * t
    J, r = lin.J, lin.r
    if weights is not None:
        root = np.sqrt(weights)
        J, r = J * root[:, None, None], r * root[:, None]
    A = np.zeros((a, a))
    G = np.zeros((n, a, 6))
    V = np.zeros((n, 6, 6))
    b = np.zeros(a)
    s = np.zeros((n, 6))
    for j, rows in enumerate(order.image_slices):
        block = J[rows].reshape(-1, k + 9)
        product = block.T @ block
        A[:k, :k] += product[:k, :k]
        G[j, :k] = product[:k, k + 3 :]
        V[j] = product[k + 3 :, k + 3 :]
        right = block.T @ r[rows].reshape(-1)
        b[:k] += right[:k]
        s[j] = right[k + 3 :]
    by_target = J[order.by_target]
    r_by_target = r[order.by_target]
    for i, rows in enumerate(order.target_slices):
        block = by_target[rows].reshape(-1, k + 9)[:, : k + 3]
        product = block[:, k:].T @ block
        at = slice(k + 3 * i, k + 3 * i + 3)
        A[at, :k] = product[:, :k]
        A[:k, at] = product[:, :k].T
        A[at, at] = product[:, k:]
        b[at] = block[:, k:].T @ r_by_target[rows].reshape(-1)
    mixed = np.einsum("mia,mib->mab", J[:, :, k : k + 3], J[:, :, k + 3 :])
    marks = order.marks
    mixed_points = np.zeros((n, t, 3, 6))
    mixed_points[marks.image, marks.target] = mixed  # one mark per image and target, see bundle.usable_marks
    G[:, k:] = mixed_points.reshape(n, 3 * t, 6)
    add_lengths(A, b, lengths, k)
    return Normals(A, G, V, b, s)


def add_lengths(A: Array, b: Array, lengths: LinearisedLengths, k: int) -> None:
    """Add scale bars to the reduced part of the normal equations, in place."""
    for r, d, (i, j) in zip(lengths.r, lengths.direction, lengths.rows, strict=True):
        block = np.outer(d, d)
        at_i, at_j = slice(k + 3 * i, k + 3 * i + 3), slice(k + 3 * j, k + 3 * j + 3)
        A[at_i, at_i] += block
        A[at_j, at_j] += block
        A[at_i, at_j] -= block
        A[at_j, at_i] -= block
        b[at_i] += r * d
        b[at_j] -= r * d


class Factor:
    """Cholesky factors of the normal equations with the stations eliminated.

    Parameters
    ----------
    damping : Levenberg factor on the diagonal (0: plain Gauss-Newton).
    constraints : (3t, d) orthonormal inner constraints on the coordinates, d may be 0.
    held : (a,) true for unknowns of the reduced system that are held fixed.

    Raises
    ------
    numpy.linalg.LinAlgError : the system is singular.
    """

    def __init__(self, normals: Normals, constraints: Array, held: NDArray[np.bool_], damping: float = 0.0) -> None:
        A, G, V = normals.A, normals.G, normals.V
        n, a = len(V), len(A)
        self.k = a - len(constraints)
        diagonal = np.diagonal(V, axis1=1, axis2=2)
        if damping > 0:
            V = V + damping * np.eye(6) * diagonal[:, :, None]
        # equilibrate: positions in m and angles in rad differ by orders of magnitude for far or near cameras
        scale = 1.0 / np.sqrt(np.maximum(diagonal, 1e-300))
        L = np.linalg.cholesky(V * scale[:, :, None] * scale[:, None, :])
        self.station_root = np.linalg.inv(L) * scale[:, None, :]  # V^-1 = root' root
        self.Y = np.ascontiguousarray(
            np.matmul(G, np.swapaxes(self.station_root, 1, 2)).transpose(1, 0, 2).reshape(a, 6 * n)
        )
        S = A - self.Y @ self.Y.T
        if damping > 0:
            S[np.diag_indices(a)] += damping * np.diag(A)
        free = np.flatnonzero(~held)
        S = S[np.ix_(free, free)]
        self.scale = 1.0 / np.sqrt(np.maximum(np.diag(A)[free], 1e-300))
        S *= self.scale[:, None] * self.scale[None, :]
        self.equilibrated = S
        B = np.zeros((a, constraints.shape[1]))
        B[self.k :] = constraints
        self.constraints = B[free] * self.scale[:, None]
        if constraints.shape[1]:
            self.constraints /= np.max(np.abs(self.constraints))
            S = S + self.constraints @ self.constraints.T
        self.free, self.a = free, a
        self.cholesky = linalg.cho_factor(S, lower=True, overwrite_a=False, check_finite=False)

    def solve(self, b: Array, s: Array) -> tuple[Array, Array]:
        """Steps of the reduced unknowns (a, ...) and the stations (n, 6, ...) for right-hand sides of these shapes."""
        n = len(s)
        rest = b.shape[1:]
        z = np.einsum("nij,nj...->ni...", self.station_root, s)
        reduced = b - np.tensordot(self.Y, z.reshape((6 * n, *rest)), axes=1)
        x = np.zeros((self.a, *rest))
        scale = self.scale.reshape((-1,) + (1,) * len(rest))
        x[self.free] = scale * linalg.cho_solve(self.cholesky, scale * reduced[self.free], check_finite=False)
        back = z - np.tensordot(self.Y.T, x, axes=1).reshape((n, 6, *rest))
        return x, np.einsum("nji,nj...->ni...", self.station_root, back)

    def cofactors(self, null_space: Array) -> Array:
        """Cofactor matrix (a, a) of intrinsics and coordinates in the datum of the constraints.

        With null space N and constraints B: ``Q = (S + B B')^-1 - N (N' B B' N)^-1 N'``.
        """
        inverse, info = linalg.lapack.dpotri(self.cholesky[0], lower=1)
        if info != 0:
            raise np.linalg.LinAlgError("singular normal equations")
        inverse = np.tril(inverse) + np.tril(inverse, -1).T
        if self.constraints.shape[1]:
            N = np.zeros((self.a, null_space.shape[1]))
            N[self.k :] = null_space
            N = N[self.free] / self.scale[:, None]
            BN = self.constraints.T @ N
            inverse -= N @ np.linalg.solve(BN.T @ BN, N.T)
        inverse *= self.scale[:, None] * self.scale[None, :]
        Q = np.zeros((self.a, self.a))
        Q[np.ix_(self.free, self.free)] = inverse
        return Q

    def station_cofactors(self, Q: Array) -> tuple[Array, Array]:
        """Cofactors of the stations (n, 6, 6) and mixed ones (a, n, 6) of reduced unknowns and stations."""
        n = len(self.station_root)
        Z = np.matmul(np.swapaxes(self.station_root, 1, 2), self.Y.reshape(self.a, n, 6).transpose(1, 2, 0))
        flat = np.ascontiguousarray(Z.reshape(6 * n, self.a))
        mixed = -(Q @ flat.T).reshape(self.a, n, 6)
        own = np.matmul(np.swapaxes(self.station_root, 1, 2), self.station_root)
        return own - np.matmul(Z, mixed.transpose(1, 0, 2)), mixed
