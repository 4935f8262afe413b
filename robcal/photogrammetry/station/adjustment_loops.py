"""Compiled loops over the marks of :mod:`robcal.photogrammetry.station.adjustment`: derivatives, sums, redundancy."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from robcal.jit import compiled, inner

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]

_STATION, _GLOBAL, _POSE = 15, 18, 6  # unknowns of a mark: exterior and interior, with its point, its pose


class Blocks(NamedTuple):
    """Whitened residuals (m, 2) and derivatives (m, 2, k) by exterior, interior, point and pose."""

    residual: Array
    exterior: Array
    interior: Array
    point: Array
    pose: Array


class Places(NamedTuple):
    """Exterior orientation, camera, target and pose (m,) of each mark; e exterior orientations, c cameras."""

    exterior: IntArray
    camera: IntArray
    target: IntArray
    pose: IntArray
    exteriors: int
    cameras: int


class Sums(NamedTuple):
    """Normal equations, zero at first: ``matrix`` (g, g) lower triangle, ``right`` (g,), ``coupling`` (g, p, 6),
    ``pose_matrix`` (p, 6, 6), ``pose_right`` (p, 6)."""

    matrix: Array
    right: Array
    coupling: Array
    pose_matrix: Array
    pose_right: Array


@compiled
def differentiate(W, r, d_point, d_interior, R, p_camera, p_body, out):  # type: ignore[no-untyped-def]
    """Fills `out` (:class:`Blocks`) from the image's derivatives (m, 2, 3) by the point in the camera's frame.

    W : (m, 2, 2). r : (m, 2). d_interior : (m, 2, 9). R : (m, 3, 3) camera_R_body. p_camera, p_body : (m, 3).
    """
    for i in range(len(r)):
        x, y, z = p_camera[i, 0], p_camera[i, 1], p_camera[i, 2]
        u, v, w = p_body[i, 0], p_body[i, 1], p_body[i, 2]
        for k in range(2):
            first, second = W[i, k, 0], W[i, k, 1]
            out.residual[i, k] = first * r[i, 0] + second * r[i, 1]
            for j in range(9):
                out.interior[i, k, j] = first * d_interior[i, 0, j] + second * d_interior[i, 1, j]
            a = first * d_point[i, 0, 0] + second * d_point[i, 1, 0]
            b = first * d_point[i, 0, 1] + second * d_point[i, 1, 1]
            c = first * d_point[i, 0, 2] + second * d_point[i, 1, 2]
            out.exterior[i, k, 0], out.exterior[i, k, 1], out.exterior[i, k, 2] = -a, -b, -c
            out.exterior[i, k, 3] = b * z - c * y
            out.exterior[i, k, 4] = c * x - a * z
            out.exterior[i, k, 5] = a * y - b * x
            d = a * R[i, 0, 0] + b * R[i, 1, 0] + c * R[i, 2, 0]
            e = a * R[i, 0, 1] + b * R[i, 1, 1] + c * R[i, 2, 1]
            f = a * R[i, 0, 2] + b * R[i, 1, 2] + c * R[i, 2, 2]
            out.point[i, k, 0], out.point[i, k, 1], out.point[i, k, 2] = d, e, f
            out.pose[i, k, 0], out.pose[i, k, 1], out.pose[i, k, 2] = d, e, f
            out.pose[i, k, 3] = f * v - e * w
            out.pose[i, k, 4] = d * w - f * u
            out.pose[i, k, 5] = e * u - d * v


@inner
def _gather(blocks, places, i, at, rows):  # type: ignore[no-untyped-def]
    """Columns `at` (18,) of a mark's global unknowns, and its derivatives `rows` (2, 18) by them."""
    first, second = 6 * places.exterior[i], 6 * places.exteriors + 9 * places.camera[i]
    third = 6 * places.exteriors + 9 * places.cameras + 3 * places.target[i]
    for j in range(6):
        at[j] = first + j
        rows[0, j], rows[1, j] = blocks.exterior[i, 0, j], blocks.exterior[i, 1, j]
    for j in range(9):
        at[6 + j] = second + j
        rows[0, 6 + j], rows[1, 6 + j] = blocks.interior[i, 0, j], blocks.interior[i, 1, j]
    for j in range(3):
        at[_STATION + j] = third + j
        rows[0, _STATION + j], rows[1, _STATION + j] = blocks.point[i, 0, j], blocks.point[i, 1, j]


@compiled
def add_marks(blocks, places, weights, sums):  # type: ignore[no-untyped-def]
    """Adds all marks with their weights (m,) to the normal equations."""
    at, rows = np.empty(_GLOBAL, np.int64), np.empty((2, _GLOBAL))
    for i in range(len(weights)):
        weight, p = weights[i], places.pose[i]
        if weight == 0.0:
            continue
        _gather(blocks, places, i, at, rows)
        r0, r1 = weight * blocks.residual[i, 0], weight * blocks.residual[i, 1]
        for a in range(_GLOBAL):
            d0, d1 = weight * rows[0, a], weight * rows[1, a]
            row = at[a]
            for b in range(a + 1):
                sums.matrix[row, at[b]] += d0 * rows[0, b] + d1 * rows[1, b]
            sums.right[row] += r0 * rows[0, a] + r1 * rows[1, a]
            for j in range(_POSE):
                sums.coupling[row, p, j] += d0 * blocks.pose[i, 0, j] + d1 * blocks.pose[i, 1, j]
        for a in range(_POSE):
            d0, d1 = blocks.pose[i, 0, a], blocks.pose[i, 1, a]
            sums.pose_right[p, a] += r0 * d0 + r1 * d1
            for b in range(_POSE):
                sums.pose_matrix[p, a, b] += weight * (d0 * blocks.pose[i, 0, b] + d1 * blocks.pose[i, 1, b])


@compiled
def covariances(blocks, places, Q, Qgp, Qpp, out):  # type: ignore[no-untyped-def]
    """Covariance (m, 2, 2) of the adjusted, whitened marks into `out`, from Q (g, g), Qgp (p, g, 6), Qpp (p, 6, 6)."""
    at, rows, half, along = np.empty(_GLOBAL, np.int64), np.empty((2, _GLOBAL)), np.empty(_GLOBAL), np.empty(_POSE)
    for i in range(len(out)):
        p = places.pose[i]
        _gather(blocks, places, i, at, rows)
        for k in range(2):
            for b in range(_GLOBAL):
                total = 0.0
                for a in range(_GLOBAL):
                    total += rows[k, a] * Q[at[b], at[a]]
                half[b] = total
            for j in range(_POSE):
                along[j] = 0.0
                for a in range(_GLOBAL):
                    along[j] += 2.0 * rows[k, a] * Qgp[p, at[a], j]
                for a in range(_POSE):
                    along[j] += blocks.pose[i, k, a] * Qpp[p, a, j]
            for n in range(2):
                total = 0.0
                for b in range(_GLOBAL):
                    total += half[b] * rows[n, b]
                for j in range(_POSE):
                    total += along[j] * blocks.pose[i, n, j]
                out[i, k, n] = total
        mean = 0.5 * (out[i, 0, 1] + out[i, 1, 0])
        out[i, 0, 1] = out[i, 1, 0] = mean
