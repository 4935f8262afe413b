"""Subproblems of Paden and Kahan: joint angles from one geometric condition each, vectorised.

Sources: Murray, Li, Sastry, *A Mathematical Introduction to Robotic Manipulation* (1994), section 3.3;
Elias and Wen, *IK-Geo* (2022), for the fourth (moving a point onto a plane).

Directions are unit vectors. Arguments broadcast over leading axes; two solutions come in a new last axis. Where the
condition cannot be met the angles are NaN; a condition missed by rounding alone (``_EDGE`` of the cosine) is met at the
boundary, so an arm stretched out to its full reach still has its solution.
"""

import numpy as np

from robcal.transforms import Array

_EDGE = 1e-9


def _dot(a: Array, b: Array) -> Array:
    return np.sum(a * b, axis=-1)


def _across(w: Array, u: Array) -> Array:
    """Component of u perpendicular to w."""
    return u - _dot(w, u)[..., None] * w


def _arccos(cosine: Array) -> Array:
    inside = np.abs(cosine) <= 1.0 + _EDGE
    return np.where(inside, np.arccos(np.clip(np.where(inside, cosine, 0.0), -1.0, 1.0)), np.nan)


def rotate(w: Array, angle: Array, u: Array) -> Array:
    """Vectors u turned about direction w by angle (Rodrigues)."""
    along = _dot(w, u)[..., None] * w
    across = u - along
    c, s = np.cos(angle)[..., None], np.sin(angle)[..., None]
    return along + c * across + s * np.cross(w, across)


def angle_between(w: Array, u: Array, v: Array) -> Array:
    """Angle about w that turns u towards v (subproblem 1; only the components across w count)."""
    a, b = _across(w, u), _across(w, v)
    return np.arctan2(_dot(w, np.cross(a, b)), _dot(a, b))


def two_turns(w1: Array, w2: Array, u: Array, v: Array) -> tuple[Array, Array]:
    """Angles (t1, t2), shape (..., 2), with ``rot(w1, t1) rot(w2, t2) u = v`` for crossing axes (subproblem 2)."""
    c = _dot(w1, w2)
    a, b = _dot(w1, v), _dot(w2, u)
    s2 = 1.0 - c * c
    alpha, beta = (a - c * b) / s2, (b - c * a) / s2
    gamma2 = (_dot(u, u) - alpha**2 - beta**2 - 2.0 * alpha * beta * c) / s2
    scale = _dot(u, u) / s2
    possible = gamma2 >= -_EDGE * scale
    gamma = np.sqrt(np.where(possible, np.maximum(gamma2, 0.0), np.nan))
    plane = alpha[..., None] * w1 + beta[..., None] * w2
    z = plane[..., None, :] + np.stack([gamma, -gamma], axis=-1)[..., None] * np.cross(w1, w2)[..., None, :]
    t2 = angle_between(w2[..., None, :], u[..., None, :], z)
    t1 = angle_between(w1[..., None, :], z, v[..., None, :])
    return t1, t2


def to_distance(w: Array, u: Array, v: Array, distance2: Array) -> Array:
    """Angles (..., 2) with ``|v - rot(w, t) u|^2 = distance2`` (subproblem 3)."""
    a, b = _across(w, u), _across(w, v)
    rest = distance2 - _dot(w, u - v) ** 2
    product = np.sqrt(_dot(a, a) * _dot(b, b))
    with np.errstate(divide="ignore", invalid="ignore"):
        cosine = (_dot(a, a) + _dot(b, b) - rest) / (2.0 * product)
    middle, half = angle_between(w, a, b), _arccos(cosine)
    return np.stack([middle + half, middle - half], axis=-1)


def to_plane(w: Array, u: Array, normal: Array, height: Array) -> Array:
    """Angles (..., 2) with ``normal . rot(w, t) u = height`` (subproblem 4)."""
    across = _across(w, u)
    a, b = _dot(normal, across), _dot(normal, np.cross(w, across))
    rest = height - _dot(w, u) * _dot(normal, w)
    with np.errstate(divide="ignore", invalid="ignore"):
        half = _arccos(rest / np.hypot(a, b))
    middle = np.arctan2(b, a)
    return np.stack([middle + half, middle - half], axis=-1)
