"""Compiled loop over the marks of :func:`robcal.photogrammetry.orientation.resection.refine_poses`."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from robcal.jit import compiled

Array = NDArray[np.float64]


class Rows(NamedTuple):
    """Marks: the body's ``place`` (m,), whitening W (m, 2, 2), residual (m, 2) px, derivative (m, 2, 3) by the point in
    the camera's frame, camera_R_body (m, 3, 3) and the point on the body (m, 3)."""

    place: NDArray[np.int64]
    W: Array
    residual: Array
    by_point: Array
    R: Array
    point: Array


@compiled
def add_rows(rows, matrix, right, cost):  # type: ignore[no-untyped-def]
    """Adds all marks to the normal equations (k, 6, 6), (k, 6) and sums of squares (k,) of their bodies.

    A mark that is not finite takes no part, but makes the cost of its body infinite.
    """
    J, r = np.empty((2, 6)), np.empty(2)
    for i in range(len(rows.place)):
        k, finite = rows.place[i], True
        u, v, w = rows.point[i, 0], rows.point[i, 1], rows.point[i, 2]
        for n in range(2):
            first, second = rows.W[i, n, 0], rows.W[i, n, 1]
            r[n] = first * rows.residual[i, 0] + second * rows.residual[i, 1]
            for j in range(3):
                J[n, j] = 0.0
            for a in range(3):
                d = first * rows.by_point[i, 0, a] + second * rows.by_point[i, 1, a]
                for j in range(3):
                    J[n, j] += d * rows.R[i, a, j]
            J[n, 3] = J[n, 2] * v - J[n, 1] * w
            J[n, 4] = J[n, 0] * w - J[n, 2] * u
            J[n, 5] = J[n, 1] * u - J[n, 0] * v
            finite = finite and np.isfinite(r[n])
            for j in range(6):
                finite = finite and np.isfinite(J[n, j])
        if not finite:
            cost[k] = np.inf
            continue
        cost[k] += r[0] * r[0] + r[1] * r[1]
        for a in range(6):
            right[k, a] += J[0, a] * r[0] + J[1, a] * r[1]
            for b in range(6):
                matrix[k, a, b] += J[0, a] * J[0, b] + J[1, a] * J[1, b]
