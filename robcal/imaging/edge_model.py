"""Image of an evenly bright ellipse behind a blurring lens, per pixel, with exact derivatives; batches of ellipses.

The ellipse is {x: |B (x - c)| = 1} with B symmetric, positive definite. The pixel value is the step profile
Phi(-d / s) of the signed distance d to the edge (negative inside), s^2 = blur^2 + 1/12: the integration over the
pixel's area acts on a straight edge like a blur of variance 1/12 px^2. d is exact for circles; for ellipses it is a
first-order distance that is exact at the edge, with its slope, and smooth at the centre:

    q = |B (x-c)|^2,  w = |B^2 (x-c)|,  k = det B
    inside   d = (w - sqrt(w^2 + k (1 - q))) / k        (= (q - 1) / (w + sqrt(...)))
    outside  d = (q - sqrt q) / w

Numerically compared with supersampled blurred ellipses the misfit stays below 0.5 % of the contrast and the centre's
bias below 0.005 px while the minor semi-axis exceeds 2 s; for smaller ones :func:`spot` is the better model.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

Array = NDArray[np.float64]

SHAPE_PARAMETERS = 6  # cx, cy, B11, B12, B22, ln s
_SQRT_2PI = float(np.sqrt(2.0 * np.pi))


def _geometry(shape: Array, x: Array, y: Array) -> tuple[Array, ...]:
    """Common parts: dx, dy, u, v, q, w and k of the module's formulas."""
    b11, b12, b22 = (shape[:, k, None] for k in (2, 3, 4))
    dx, dy = x - shape[:, 0, None], y - shape[:, 1, None]
    u1, u2 = b11 * dx + b12 * dy, b12 * dx + b22 * dy
    v1, v2 = b11 * u1 + b12 * u2, b12 * u1 + b22 * u2
    q = u1 * u1 + u2 * u2
    w = np.sqrt(v1 * v1 + v2 * v2)
    np.maximum(w, 1e-9, out=w)
    return dx, dy, u1, u2, v1, v2, q, w, b11 * b22 - b12 * b12


def signed_distance(shape: Array, x: Array, y: Array) -> Array:
    """First-order signed distance (n, p) of pixels (n, p) to the edge of ellipses (n, >= 5), px, negative inside."""
    _, _, _, _, _, _, q, w, k = _geometry(shape, x, y)
    inside = (w - np.sqrt(np.maximum(w * w + k * (1.0 - q), 0.0))) / k
    return np.where(q < 1.0, inside, (q - np.sqrt(q)) / w)


def edge_distance(shape: Array, x: Array, y: Array) -> tuple[Array, Array]:
    """Signed distance as above, and its derivative.

    Parameters
    ----------
    shape : (n, 6) cx, cy, B11, B12, B22, ln s. x, y : (n, p) pixels.

    Returns
    -------
    d : (n, p) px, negative inside. derivative : (n, p, 5) by cx, cy, B11, B12, B22.
    """
    b11, b12, b22 = (shape[:, k, None] for k in (2, 3, 4))
    dx, dy, u1, u2, v1, v2, q, w, k = _geometry(shape, x, y)
    z1, z2 = b11 * v1 + b12 * v2, b12 * v1 + b22 * v2
    inside = q < 1.0
    root = np.sqrt(np.where(inside, np.maximum(w * w + k * (1.0 - q), 1e-18), q))
    half_by_root, half_by_w = 0.5 / root, 0.5 / w
    # outside, root is sqrt q
    d = np.where(inside, (w - root) / k, (q - root) / w)
    by_q = 2.0 * np.where(inside, half_by_root, (1.0 - half_by_root) / w)
    by_w2 = 2.0 * np.where(inside, (half_by_w - half_by_root) / k, -d * half_by_w / w)
    by_k = np.where(inside, -((1.0 - q) * half_by_root + d) / k, 0.0)
    derivative = np.empty((*x.shape, 5))
    # w2 = |B u|^2: its derivative by c needs B z with z = B v
    along1, along2 = by_q * u1 + by_w2 * z1, by_q * u2 + by_w2 * z2
    derivative[..., 0] = -(b11 * along1 + b12 * along2)
    derivative[..., 1] = -(b12 * along1 + b22 * along2)
    derivative[..., 2] = along1 * dx + by_w2 * (v1 * u1) + by_k * b22
    derivative[..., 3] = along1 * dy + along2 * dx + by_w2 * (v1 * u2 + v2 * u1) - 2.0 * by_k * b12
    derivative[..., 4] = along2 * dy + by_w2 * (v2 * u2) + by_k * b11
    return d, derivative


def blurred_ellipse(shape: Array, x: Array, y: Array) -> tuple[Array, Array]:
    """Step profile in 0..1 and its derivatives, (n, p) and (n, p, 6), by the six shape parameters."""
    d, derivative = edge_distance(shape, x, y)
    s = np.exp(shape[:, 5, None])
    t = d / s
    density = np.exp(-0.5 * np.minimum(t * t, 80.0)) / _SQRT_2PI
    gradient = np.empty((*x.shape, SHAPE_PARAMETERS))
    gradient[..., :5] = derivative * (-density / s)[..., None]
    gradient[..., 5] = density * t
    return ndtr(-t), gradient


def profile_only(shape: Array, x: Array, y: Array, is_spot: NDArray[np.bool_]) -> Array:
    """Profile values (n, p) of edges or spots without derivatives."""
    value = ndtr(-signed_distance(shape, x, y) / np.exp(shape[:, 5, None]))
    if is_spot.any():
        q = _geometry(shape[is_spot], x[is_spot], y[is_spot])[6]
        value[is_spot] = np.exp(-0.5 * np.minimum(q, 80.0))
    return np.asarray(value)


def spot(shape: Array, x: Array, y: Array) -> tuple[Array, Array]:
    """Gaussian spot exp(-q/2) and derivatives, for dots not larger than their blur; same parameters, ln s unused."""
    b11, b12, b22 = (shape[:, k, None] for k in (2, 3, 4))
    dx, dy = x - shape[:, 0, None], y - shape[:, 1, None]
    u1, u2 = b11 * dx + b12 * dy, b12 * dx + b22 * dy
    value = np.exp(-0.5 * np.minimum(u1 * u1 + u2 * u2, 80.0))
    gradient = np.empty((*x.shape, SHAPE_PARAMETERS))
    gradient[..., 0] = value * (b11 * u1 + b12 * u2)
    gradient[..., 1] = value * (b12 * u1 + b22 * u2)
    gradient[..., 2] = -value * u1 * dx
    gradient[..., 3] = -value * (u1 * dy + u2 * dx)
    gradient[..., 4] = -value * u2 * dy
    gradient[..., 5] = 0.0
    return value, gradient


def matrix_from_axes(semi_axes: Array, angle: Array) -> Array:
    """(n, 3) B11, B12, B22 of ellipses with semi-axes (n, 2) and angle (n,) of the first one."""
    c, s = np.cos(angle), np.sin(angle)
    first, second = 1.0 / semi_axes[:, 0], 1.0 / semi_axes[:, 1]
    return np.stack([c * c * first + s * s * second, c * s * (first - second), s * s * first + c * c * second], axis=-1)


def axes_from_matrix(b: Array) -> tuple[Array, Array]:
    """Semi-axes (n, 2), major first, and angle (n,) in (-pi/2, pi/2] of the major one, from (n, 3) B11, B12, B22."""
    mean, half = 0.5 * (b[:, 0] + b[:, 2]), 0.5 * (b[:, 0] - b[:, 2])
    radius = np.hypot(half, b[:, 1])
    small = np.maximum(mean - radius, 1e-12)
    # the major axis belongs to the smaller eigenvalue
    angle = 0.5 * np.arctan2(-b[:, 1], -half)
    return np.stack([1.0 / small, 1.0 / (mean + radius)], axis=-1), angle
