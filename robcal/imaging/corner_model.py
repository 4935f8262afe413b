"""Image of a corner where two edges cross (chessboard), behind a blurring lens, with exact derivatives; in batches.

Without blur the sign f = sign(d1) sign(d2) of the signed distances to both edges. Blurred by a normal point spread of
standard deviation s it is the expectation of that product, with u = d1 / s, v = d2 / s and r = n1 n2 the cosine between
the edges' normals:

    f = S(u) S(v) + 4 int_0^r phi2(u, v; t) dt,   S(u) = 2 Phi(u) - 1,
    df/du = 2 phi(u) S((v - r u) / sqrt(1 - r^2)),   df/dr = 4 phi2(u, v; r)

(phi2 the bivariate normal density; the integral after Plackett 1954 in the form of Drezner and Wesolowsky 1990, by
Gauss-Legendre). s^2 = blur^2 + 1/12: the pixel's area acts on a straight edge like a blur of variance 1/12 px^2. Edges
may be slightly curved (lens distortion): d = n x - k (t x)^2 / 2 with a given curvature k, x from the corner.
"""

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

Array = NDArray[np.float64]

SHAPE_PARAMETERS = 5  # cx, cy, angle of n1, angle of n2, ln s
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(6)
_RIGHT = 1e-3  # cosine between the normals below which the edges count as at right angles


def _density(u: Array) -> Array:
    return np.asarray(np.exp(-0.5 * np.minimum(u * u, 80.0)) / np.sqrt(2.0 * np.pi))


def _mixed(u: Array, v: Array, r: Array) -> Array:
    """4 times the integral of phi2 over the correlation from 0 to r (n, 1)."""
    if np.all(np.abs(r) < _RIGHT):
        return 4.0 * r * _density(u) * _density(v)
    half = 0.5 * np.arcsin(r)
    total = np.zeros_like(u)
    squares, product = u * u + v * v, 2.0 * u * v
    for node, weight in zip(_NODES, _WEIGHTS, strict=True):
        sine = np.sin(half * (1.0 + node))
        exponent = (squares - product * sine) / (2.0 * (1.0 - sine**2))
        total += weight * np.exp(-np.minimum(exponent, 80.0))
    return np.asarray(total * half * (2.0 / np.pi))


def _edge(shape: Array, which: int, dx: Array, dy: Array, curvature: Array) -> tuple[Array, Array, Array, Array]:
    """Distance (n, p) to an edge and its derivatives by cx, cy and the normal's angle."""
    c, s = np.cos(shape[:, which, None]), np.sin(shape[:, which, None])
    along, across, k = -s * dx + c * dy, c * dx + s * dy, curvature[:, None]
    bend = k * along
    return across - 0.5 * bend * along, -c - bend * s, -s + bend * c, along + bend * across


def blurred_corner(shape: Array, curvature: Array, x: Array, y: Array) -> tuple[Array, Array]:
    """Values f (n, p) from -1 to 1 and derivatives (n, 5, p) by the shape.

    Parameters
    ----------
    shape : (n, 5) corner cx, cy (px), angles (rad) of the normals n1, n2 of both edges, ln s. f is positive where both
        distances have the same sign.
    curvature : (n, 2) 1/px of the edges, positive where an edge bends towards its normal.
    x, y : (n, p) pixels.
    """
    dx, dy = x - shape[:, 0, None], y - shape[:, 1, None]
    s = np.exp(shape[:, 4, None])
    d1, d1x, d1y, d1t = _edge(shape, 2, dx, dy, curvature[:, 0])
    d2, d2x, d2y, d2t = _edge(shape, 3, dx, dy, curvature[:, 1])
    u, v = d1 / s, d2 / s
    r = np.cos(shape[:, 2] - shape[:, 3])[:, None]
    q = np.sqrt(np.maximum(1.0 - r * r, 1e-6))
    value = (2.0 * ndtr(u) - 1.0) * (2.0 * ndtr(v) - 1.0) + _mixed(u, v, r)
    by_u = 2.0 * _density(u) * (2.0 * ndtr((v - r * u) / q) - 1.0)
    by_v = 2.0 * _density(v) * (2.0 * ndtr((u - r * v) / q) - 1.0)
    by_r = 4.0 * _density(u) * _density((v - r * u) / q) / q
    turn = np.sin(shape[:, 2] - shape[:, 3])[:, None]
    gradient = np.empty((len(shape), SHAPE_PARAMETERS, x.shape[1]))
    gradient[:, 0] = (by_u * d1x + by_v * d2x) / s
    gradient[:, 1] = (by_u * d1y + by_v * d2y) / s
    gradient[:, 2] = by_u * d1t / s - by_r * turn
    gradient[:, 3] = by_v * d2t / s + by_r * turn
    gradient[:, 4] = -(by_u * u + by_v * v)
    return value, gradient
