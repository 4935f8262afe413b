"""Three-point resection in closed form, for many triples at once.

Source: Grunert's solution in the form of Haralick, Lee, Ottenberg and Nolle (1994), "Review and analysis of solutions
of the three point perspective pose estimation problem"; the distances are then polished by Newton steps.
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from robcal.transforms import Array, frame


def _quartic_roots(coefficients: NDArray[np.complex128]) -> NDArray[np.complex128]:
    """Four complex roots (k, 4) of quartics (k, 5), highest power first (Ferrari), polished by Newton steps."""
    c = coefficients[:, 1:] / coefficients[:, :1]
    a, b, d, e = c.T
    p = b - 3 * a**2 / 8
    q = d - a * b / 2 + a**3 / 8
    r = e - a * d / 4 + a**2 * b / 16 - 3 * a**4 / 256
    # resolvent 8 m^3 + 8 p m^2 + (2 p^2 - 8 r) m - q^2 = 0 by Cardano; its largest root avoids division by zero
    d0 = p**2 + 12 * r
    d1 = 2 * p**3 + 27 * q**2 - 72 * p * r
    inner = np.sqrt(d1**2 - 4 * d0**3)
    cube = ((d1 + np.where(np.abs(d1 + inner) >= np.abs(d1 - inner), inner, -inner)) / 2) ** (1 / 3)
    turns = np.exp(2j * np.pi * np.arange(3) / 3)
    with np.errstate(divide="ignore", invalid="ignore"):
        s = cube[:, None] * turns
        m = (-2 * p[:, None] + s + np.where(s == 0, 0, d0[:, None] / np.where(s == 0, 1, s))) / 6
        m = np.take_along_axis(m, np.argmax(np.abs(m), axis=1)[:, None], axis=1)[:, 0]
        w = np.sqrt(2 * m)
        ratio = np.where(w == 0, 0, 2 * q / np.where(w == 0, 1, w))
        first = np.sqrt(-(2 * p + 2 * m + ratio))
        second = np.sqrt(-(2 * p + 2 * m - ratio))
    roots = np.stack([w + first, w - first, -w + second, -w - second], axis=1) / 2 - a[:, None] / 4
    for _ in range(2):
        value = np.ones_like(roots)
        slope = np.zeros_like(roots)
        for k in range(4):
            slope = slope * roots + value
            value = value * roots + c[:, k : k + 1]
        with np.errstate(divide="ignore", invalid="ignore"):
            step = value / slope
        roots = roots - np.where(np.isfinite(step), step, 0)
    return roots


def _triangle_frame(points: Array) -> Array:
    u = points[..., 1, :] - points[..., 0, :]
    v = points[..., 2, :] - points[..., 0, :]
    with np.errstate(divide="ignore", invalid="ignore"):
        ex = u / np.linalg.norm(u, axis=-1, keepdims=True)
        n = np.cross(u, v)
        ez = n / np.linalg.norm(n, axis=-1, keepdims=True)
    return frame(np.stack([ex, np.cross(ez, ex), ez], axis=-1), points[..., 0, :])


def three_point_poses(rays: ArrayLike, points: ArrayLike) -> Array:
    """All poses that put three points on three rays.

    Parameters
    ----------
    rays : (k, 3, 2) ideal image coordinates x/z, y/z.
    points : (k, 3, 3) m in the body frame.

    Returns
    -------
    (k, 4, 4, 4) camera_T_body, NaN where a solution does not exist or lies behind the camera. Weakness: the danger
    cylinder (camera above the circumcircle of the triangle) makes double roots of low accuracy.
    """
    uv = np.asarray(rays, dtype=float)
    x = np.asarray(points, dtype=float)
    j = np.concatenate([uv, np.ones_like(uv[..., :1])], axis=-1)
    j /= np.linalg.norm(j, axis=-1, keepdims=True)
    a2 = np.sum((x[:, 1] - x[:, 2]) ** 2, axis=1)
    b2 = np.sum((x[:, 0] - x[:, 2]) ** 2, axis=1)
    c2 = np.sum((x[:, 0] - x[:, 1]) ** 2, axis=1)
    ca, cb, cg = (np.sum(j[:, m] * j[:, n], axis=1) for m, n in ((1, 2), (0, 2), (0, 1)))
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        e, f, g, h = (a2 - c2) / b2, (a2 + c2) / b2, c2 / b2, a2 / b2
        quartic = np.stack(
            [
                (e - 1) ** 2 - 4 * g * ca**2,
                4 * (e * (1 - e) * cb - (1 - f) * ca * cg + 2 * g * ca**2 * cb),
                2 * (e**2 - 1 + 2 * e**2 * cb**2 + 2 * (1 - g) * ca**2 - 4 * f * ca * cb * cg + 2 * (1 - h) * cg**2),
                4 * (-e * (1 + e) * cb + 2 * h * cg**2 * cb - (1 - f) * ca * cg),
                (1 + e) ** 2 - 4 * h * cg**2,
            ],
            axis=1,
        )
        # a vanishing leading coefficient sends one root to infinity: a tiny one instead keeps the formula alive
        size = np.max(np.abs(quartic), axis=1)
        quartic[:, 0] = np.where(np.abs(quartic[:, 0]) < 1e-14 * size, 1e-14 * size, quartic[:, 0])
        roots = _quartic_roots(quartic.astype(complex))
        v = np.where(np.abs(roots.imag) < 1e-3 * np.maximum(np.abs(roots.real), 1e-6), roots.real, np.nan)
        top = (-1 + e)[:, None] * v**2 - 2 * (e * cb)[:, None] * v + (1 + e)[:, None]
        u = top / (2 * (cg[:, None] - v * ca[:, None]))
        s1 = np.sqrt(b2[:, None] / (1 + v**2 - 2 * v * cb[:, None]))
    s = np.stack([s1, u * s1, v * s1], axis=-1)
    s = np.where((s > 0).all(axis=-1, keepdims=True), s, np.nan)
    s = _polish(s, np.stack([ca, cb, cg], axis=-1)[:, None], np.stack([a2, b2, c2], axis=-1)[:, None])
    p_camera = s[..., None] * j[:, None]
    poses = _triangle_frame(p_camera) @ np.linalg.inv(_safe(_triangle_frame(x)))[:, None]
    bad = ~np.isfinite(poses).all(axis=(-2, -1)) | ~(p_camera[..., 2] > 0).all(axis=-1)
    poses[bad] = np.nan
    return np.asarray(poses)


def _safe(frames: Array) -> Array:
    bad = ~np.isfinite(frames).all(axis=(-2, -1))
    frames[bad] = np.eye(4)
    return frames


def _polish(s: Array, cosines: Array, squares: Array) -> Array:
    """Two Newton steps on the three laws of cosines; solutions that do not fulfil them become NaN."""
    order = np.array([[1, 2], [0, 2], [0, 1]])
    for step in range(3):
        one, two = s[..., order[:, 0]], s[..., order[:, 1]]
        residual = one**2 + two**2 - 2 * one * two * cosines - squares
        if step == 2:
            break
        jacobian = np.zeros((*s.shape, 3))
        for row, (m, n) in enumerate(order):
            jacobian[..., row, m] = 2 * (one - two * cosines)[..., row]
            jacobian[..., row, n] = 2 * (two - one * cosines)[..., row]
        flat = np.where(np.isfinite(jacobian).all(axis=(-2, -1), keepdims=True), jacobian, np.eye(3))
        flat = flat + 1e-12 * np.eye(3) * np.abs(flat).max(axis=(-2, -1), keepdims=True)
        singular = np.abs(np.linalg.det(flat)) < 1e-12 * np.abs(flat).max(axis=(-2, -1)) ** 3
        flat[singular] = np.eye(3)
        update = np.linalg.solve(flat, residual[..., None])[..., 0]
        s = s - np.where(singular[..., None], 0.0, update)
    wrong = np.abs(residual).max(axis=-1) > 1e-5 * squares.max(axis=-1)
    return np.where(wrong[..., None], np.nan, s)
