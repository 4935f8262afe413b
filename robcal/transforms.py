"""Frames as homogeneous 4x4 matrices, their six pose parameters, small perturbations and covariance transport.

Conventions (the one place where they are stated):

- ``a_T_b`` maps coordinates in b to coordinates in a: ``p_a = a_T_b p_b``.
- ``R(roll, pitch, yaw) = Rz(yaw) Ry(pitch) Rx(roll)``; pose parameters are ``(x, y, z, roll, pitch, yaw)``.
- A frame is perturbed on the right, translation first: ``retract(a_T_b, (rho, omega)) = a_T_b [Exp(omega), rho]``,
  so a 6x6 covariance is in the coordinates of b, metres first, then radians.

All functions broadcast over leading axes; lengths in metres, angles in radians.
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from robcal.errors import DegenerateGeometry, InvalidInput

Array = NDArray[np.float64]

_SMALL_ANGLE = 1e-6


def rotation_from_rpy(rpy: ArrayLike) -> Array:
    """Rotation matrices ``Rz(yaw) Ry(pitch) Rx(roll)`` from ``(..., 3)`` angles in rad; shape ``(..., 3, 3)``."""
    angles = np.asarray(rpy, dtype=float)
    cr, cp, cy = np.moveaxis(np.cos(angles), -1, 0)
    sr, sp, sy = np.moveaxis(np.sin(angles), -1, 0)
    out = np.empty((*angles.shape[:-1], 3, 3))
    out[..., 0, 0], out[..., 0, 1], out[..., 0, 2] = cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr
    out[..., 1, 0], out[..., 1, 1], out[..., 1, 2] = sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr
    out[..., 2, 0], out[..., 2, 1], out[..., 2, 2] = -sp, cp * sr, cp * cr
    return out


def rpy_from_rotation(a_R_b: ArrayLike) -> Array:
    """Angles (roll, pitch, yaw) in rad, shape ``(..., 3)``; inverse of :func:`rotation_from_rpy`.

    Weakness: at pitch = +-90 degrees only the sum or difference of roll and yaw is defined; roll is then set to zero.
    """
    R = np.asarray(a_R_b, dtype=float)
    cos_pitch = np.hypot(R[..., 0, 0], R[..., 1, 0])
    pitch = np.arctan2(-R[..., 2, 0], cos_pitch)
    locked = cos_pitch < 1e-12
    roll = np.where(locked, 0.0, np.arctan2(R[..., 2, 1], R[..., 2, 2]))
    yaw = np.where(locked, np.arctan2(-R[..., 0, 1], R[..., 1, 1]), np.arctan2(R[..., 1, 0], R[..., 0, 0]))
    return np.stack([roll, pitch, yaw], axis=-1)


def frame(a_R_b: ArrayLike, a_t_b: ArrayLike) -> Array:
    """Homogeneous matrices ``(..., 4, 4)`` from rotations ``(..., 3, 3)`` and translations ``(..., 3)``."""
    R = np.asarray(a_R_b, dtype=float)
    t = np.asarray(a_t_b, dtype=float)
    out = np.zeros((*np.broadcast_shapes(R.shape[:-2], t.shape[:-1]), 4, 4))
    out[..., :3, :3] = R
    out[..., :3, 3] = t
    out[..., 3, 3] = 1.0
    return out


def frame_from_xyzrpy(six: ArrayLike) -> Array:
    """Frames ``(..., 4, 4)`` from pose parameters ``(..., 6)``: x, y, z in m, roll, pitch, yaw in rad."""
    numbers = np.asarray(six, dtype=float)
    return frame(rotation_from_rpy(numbers[..., 3:]), numbers[..., :3])


def xyzrpy_from_frame(a_T_b: ArrayLike) -> Array:
    """Pose parameters ``(..., 6)`` of frames ``(..., 4, 4)``; inverse of :func:`frame_from_xyzrpy`.

    >>> base_T_tool = frame_from_xyzrpy([0.1, 0.2, 0.3, 0.0, 0.0, 0.5])
    >>> xyzrpy_from_frame(base_T_tool).round(9)
    array([0.1, 0.2, 0.3, 0. , 0. , 0.5])
    """
    T = np.asarray(a_T_b, dtype=float)
    return np.concatenate([T[..., :3, 3], rpy_from_rotation(T[..., :3, :3])], axis=-1)


def invert(a_T_b: ArrayLike) -> Array:
    """``b_T_a`` of ``a_T_b``, shape ``(..., 4, 4)``."""
    T = np.asarray(a_T_b, dtype=float)
    b_R_a = np.swapaxes(T[..., :3, :3], -1, -2)
    return frame(b_R_a, -np.einsum("...ij,...j->...i", b_R_a, T[..., :3, 3]))


def transform(a_T_b: ArrayLike, p_b: ArrayLike) -> Array:
    """Points ``p_a = a_T_b p_b``; frames ``(..., 4, 4)`` and points ``(..., 3)`` broadcast against each other.

    >>> world_T_base = frame_from_xyzrpy([1.0, 0.0, 0.0, 0.0, 0.0, np.pi / 2])
    >>> transform(world_T_base, [0.5, 0.0, 0.2]).round(9)
    array([1. , 0.5, 0.2])
    """
    T = np.asarray(a_T_b, dtype=float)
    return np.einsum("...ij,...j->...i", T[..., :3, :3], np.asarray(p_b, dtype=float)) + T[..., :3, 3]


def skew(v: ArrayLike) -> Array:
    """Cross-product matrices ``[v]`` with ``[v] w = v x w``; ``(..., 3)`` to ``(..., 3, 3)``."""
    w = np.asarray(v, dtype=float)
    out = np.zeros((*w.shape[:-1], 3, 3))
    out[..., 2, 1], out[..., 0, 2], out[..., 1, 0] = w[..., 0], w[..., 1], w[..., 2]
    out[..., 1, 2], out[..., 2, 0], out[..., 0, 1] = -w[..., 0], -w[..., 1], -w[..., 2]
    return out


def exp_so3(omega: ArrayLike) -> Array:
    """Rotation matrices of rotation vectors ``(..., 3)`` in rad (Rodrigues), accurate near zero."""
    w = np.asarray(omega, dtype=float)
    angle2 = np.sum(w * w, axis=-1)[..., None, None]
    angle = np.sqrt(angle2)
    small = angle < _SMALL_ANGLE
    safe = np.where(small, 1.0, angle)
    a = np.where(small, 1.0 - angle2 / 6.0, np.sin(safe) / safe)
    b = np.where(small, 0.5 - angle2 / 24.0, 0.5 * (np.sin(0.5 * safe) / (0.5 * safe)) ** 2)
    W = skew(w)
    return np.eye(3) + a * W + b * (W @ W)


def log_so3(a_R_b: ArrayLike) -> Array:
    """Rotation vectors ``(..., 3)`` of rotation matrices, by way of the quaternion: accurate from 0 to pi."""
    R = np.asarray(a_R_b, dtype=float)
    flat = R.reshape(-1, 3, 3)
    # Shepperd's choice: build the quaternion from its largest component so that nothing is divided by a small number.
    trace = np.trace(flat, axis1=1, axis2=2)
    squares = np.stack([trace, flat[:, 0, 0], flat[:, 1, 1], flat[:, 2, 2]], axis=1)
    best = np.argmax(squares, axis=1)
    quaternion = np.empty((len(flat), 4))
    for choice in np.unique(best):
        rows = best == choice
        M = flat[rows]
        if choice == 0:
            w = 1.0 + trace[rows]
            q = [w, M[:, 2, 1] - M[:, 1, 2], M[:, 0, 2] - M[:, 2, 0], M[:, 1, 0] - M[:, 0, 1]]
        else:
            i = choice - 1
            j, k = (i + 1) % 3, (i + 2) % 3
            vector = [np.empty(0)] * 3
            vector[i] = 1.0 + M[:, i, i] - M[:, j, j] - M[:, k, k]
            vector[j] = M[:, j, i] + M[:, i, j]
            vector[k] = M[:, k, i] + M[:, i, k]
            q = [M[:, k, j] - M[:, j, k], *vector]
        quaternion[rows] = np.stack(q, axis=1)
    quaternion *= np.where(quaternion[:, :1] < 0, -1.0, 1.0)
    quaternion /= np.linalg.norm(quaternion, axis=1, keepdims=True)
    sine = np.linalg.norm(quaternion[:, 1:], axis=1)
    angle = 2.0 * np.arctan2(sine, quaternion[:, 0])
    factor = np.where(sine < 0.5 * _SMALL_ANGLE, 2.0, angle / np.where(sine > 0, sine, 1.0))
    return (quaternion[:, 1:] * factor[:, None]).reshape(R.shape[:-1])


def retract(a_T_b: ArrayLike, delta: ArrayLike) -> Array:
    """Perturbed frames ``a_T_b [Exp(omega), rho]`` for ``delta = (rho, omega)``, shape ``(..., 6)``, in b."""
    d = np.asarray(delta, dtype=float)
    return np.asarray(a_T_b, dtype=float) @ frame(exp_so3(d[..., 3:]), d[..., :3])


def difference(a_T_b: ArrayLike, a_T_c: ArrayLike) -> Array:
    """``delta`` (..., 6) with ``retract(a_T_b, delta) = a_T_c``; inverse of :func:`retract`."""
    b_T_c = invert(a_T_b) @ np.asarray(a_T_c, dtype=float)
    return np.concatenate([b_T_c[..., :3, 3], log_so3(b_T_c[..., :3, :3])], axis=-1)


def twist_from_six(six: Array) -> Array:
    """(n, 6, 6) Jacobian of the right perturbation (rho, omega) of a frame by its numbers x, y, z, roll, pitch, yaw.

    With R = Rz(yaw) Ry(pitch) Rx(roll): rho = R' dt, and the body's turn is the sum of the rates about the line that
    each angle turns about: omega = droll ex + Rx' dpitch ey + Rx' Ry' dyaw ez.
    """
    zero = np.zeros_like(six)
    roll, pitch = zero.copy(), zero.copy()
    roll[:, 3], pitch[:, 4] = six[:, 3], six[:, 4]
    Rx = frame_from_xyzrpy(roll)[:, :3, :3]
    Ry = frame_from_xyzrpy(pitch)[:, :3, :3]
    R = frame_from_xyzrpy(six)[:, :3, :3]
    jacobian = np.zeros((len(six), 6, 6))
    jacobian[:, :3, :3] = np.swapaxes(R, 1, 2)
    jacobian[:, 3, 3] = 1.0
    jacobian[:, 3:, 4] = np.swapaxes(Rx, 1, 2)[:, :, 1]
    jacobian[:, 3:, 5] = (np.swapaxes(Rx, 1, 2) @ np.swapaxes(Ry, 1, 2))[:, :, 2]
    return jacobian


def adjoint(a_T_b: ArrayLike) -> Array:
    """Matrices ``(..., 6, 6)`` that move a small perturbation on the right of b to one on the right of a.

    To first order ``[Exp(w_a), r_a] a_T_b = a_T_b [Exp(w_b), r_b]`` with ``(r_a, w_a) = adjoint(a_T_b) (r_b, w_b)``.
    """
    T = np.asarray(a_T_b, dtype=float)
    R = T[..., :3, :3]
    out = np.zeros((*T.shape[:-2], 6, 6))
    out[..., :3, :3] = R
    out[..., 3:, 3:] = R
    out[..., :3, 3:] = skew(T[..., :3, 3]) @ R
    return out


def transport_covariance(matrix: ArrayLike, covariance: ArrayLike) -> Array:
    """``A C A'`` over leading axes: covariance of ``A x``."""
    A = np.asarray(matrix, dtype=float)
    return A @ np.asarray(covariance, dtype=float) @ np.swapaxes(A, -1, -2)


def gram_schmidt_frame(points: ArrayLike) -> Array:
    """Frame from three points ``(..., 3, 3)``: origin in the first, x to the second, third in the x-y plane (y > 0).

    Raises
    ------
    DegenerateGeometry : the points are (nearly) collinear.
    """
    p = np.asarray(points, dtype=float)
    u = p[..., 1, :] - p[..., 0, :]
    v = p[..., 2, :] - p[..., 0, :]
    normal = np.cross(u, v)
    spread = np.linalg.norm(u, axis=-1) * np.linalg.norm(v, axis=-1)
    if np.any(np.linalg.norm(normal, axis=-1) <= 1e-9 * spread) or np.any(spread == 0):
        raise DegenerateGeometry("three points in one line do not define a frame: choose targets that span a triangle")
    ex = u / np.linalg.norm(u, axis=-1, keepdims=True)
    ez = normal / np.linalg.norm(normal, axis=-1, keepdims=True)
    return frame(np.stack([ex, np.cross(ez, ex), ez], axis=-1), p[..., 0, :])


def fit_frame(p_a: ArrayLike, p_b: ArrayLike, weights: ArrayLike | None = None) -> Array:
    """Least-squares frame ``a_T_b`` (4, 4) with ``p_a ~ a_T_b p_b`` for at least three points ``(n, 3)``.

    Source: Umeyama (1991) without scale. Isotropic weights ``(n,)`` only; for covariances refine by Gauss-Newton.

    Raises
    ------
    InvalidInput : shapes differ or fewer than three points.
    DegenerateGeometry : the points lie in one line.
    """
    a, b = np.asarray(p_a, dtype=float), np.asarray(p_b, dtype=float)
    if a.shape != b.shape or a.ndim != 2 or a.shape[-1] != 3 or len(a) < 3:
        raise InvalidInput(f"a frame needs at least three pairs of points, got shapes {a.shape} and {b.shape}")
    w = np.ones(len(a)) if weights is None else np.asarray(weights, dtype=float)
    w = w / w.sum()
    centre_a, centre_b = w @ a, w @ b
    spread = (b - centre_b).T @ (w[:, None] * (b - centre_b))
    values = np.linalg.eigvalsh(spread)
    if values[1] <= 1e-12 * max(values[2], 1e-300):
        raise DegenerateGeometry("all points lie in one line: a frame cannot be fitted, use targets that span a plane")
    U, _, Vt = np.linalg.svd((a - centre_a).T @ (w[:, None] * (b - centre_b)))
    sign = np.sign(np.linalg.det(U @ Vt))
    R = U @ np.diag([1.0, 1.0, sign]) @ Vt
    return frame(R, centre_a - R @ centre_b)
