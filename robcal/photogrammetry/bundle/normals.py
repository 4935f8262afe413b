"""Normal equations of a bundle adjustment: linearised marks and their sums.

Unknowns: k numbers of the interior orientation and 3t coordinates (together the reduced system, a = k + 3t), and six
numbers of every station, which only its own marks see and which are eliminated (Schur complement). Source: Brown
(1976), "The bundle adjustment - progress and prospects"; Triggs et al. (2000), "Bundle adjustment", section 6.
Stations are perturbed on the right: p_camera = R (Exp(omega) p + rho) + t.
"""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from robcal.estimation.schur import Normals
from robcal.photogrammetry.core.camera import Camera, project, project_with_jacobians
from robcal.photogrammetry.core.network import ImageMarks, IntArray
from robcal.transforms import Array, retract


@dataclass(frozen=True)
class State:
    """Values of all unknowns: interior orientation, camera_T_body (n, 4, 4) and points (t, 3)."""

    camera: Camera
    camera_T_body: Array
    points: Array

    def moved(self, basis: Array, reduced: Array, stations: Array) -> "State":
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
    r = marks.xy - shift - project(state.camera, p)
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
