"""Pinhole camera with OpenCV's radial and tangential distortion: projection, its derivatives, and the inverse.

Other lenses (:mod:`robcal.photogrammetry.core.lenses`) are subclasses and register their own functions.

Pixels are (x, y) with the centre of the top-left pixel at (0, 0). The camera looks along its +z, x to the right,
y down. Source of the model: OpenCV documentation, "Camera Calibration and 3D Reconstruction" (five coefficients).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import singledispatch
from typing import Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from robcal.errors import InvalidInput
from robcal.transforms import Array

INTRINSIC_NAMES = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3")
"""Order of the interior orientation in vectors and covariances (OpenCV's own order of coefficients)."""


@dataclass(frozen=True)
class Camera:
    """Interior orientation of one camera: size and nine intrinsic parameters in pixels and OpenCV's coefficients."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    k1: float = 0.0
    k2: float = 0.0
    p1: float = 0.0
    p2: float = 0.0
    k3: float = 0.0

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the intrinsic parameters in the order of the vector."""
        return INTRINSIC_NAMES

    @property
    def vector(self) -> Array:
        """The intrinsic parameters in the order of the names, (9,) those of :data:`INTRINSIC_NAMES`."""
        return np.array([getattr(self, name) for name in self.names], dtype=float)

    def with_vector(self, numbers: ArrayLike) -> Self:
        """The same camera with other intrinsic parameters."""
        values = np.asarray(numbers, dtype=float)
        if values.shape != (len(self.names),):
            raise InvalidInput(f"interior orientation needs {len(self.names)} parameters, got shape {values.shape}")
        return replace(self, **dict(zip(self.names, values.tolist(), strict=True)))

    @property
    def matrix(self) -> Array:
        """The 3x3 camera matrix K."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    @property
    def distortion(self) -> Array:
        """OpenCV's vector (k1, k2, p1, p2, k3)."""
        return np.array([self.k1, self.k2, self.p1, self.p2, self.k3])

    @classmethod
    def from_size(cls, width: int, height: int, focal_factor: float = 1.2) -> "Camera":
        """Start values from the image size alone: centred, no distortion, f = focal_factor * longer side."""
        f = focal_factor * max(width, height)
        return cls(width, height, f, f, (width - 1) / 2, (height - 1) / 2)


def _distort(xn: Array, yn: Array, camera: Camera) -> tuple[Array, Array]:
    r2 = xn * xn + yn * yn
    radial = 1.0 + r2 * (camera.k1 + r2 * (camera.k2 + r2 * camera.k3))
    xd = xn * radial + 2.0 * camera.p1 * xn * yn + camera.p2 * (r2 + 2.0 * xn * xn)
    yd = yn * radial + camera.p1 * (r2 + 2.0 * yn * yn) + 2.0 * camera.p2 * xn * yn
    return xd, yd


@singledispatch
def project(camera: Camera, p_camera: ArrayLike) -> Array:
    """Image points ``(..., 2)`` in px of points ``(..., 3)`` in the camera frame.

    Points behind the camera (z <= 0) come out as NaN. Weakness: beyond the monotonic range of the distortion
    polynomial far outside points fold back into the image; callers that search must check the field of view.
    """
    p = np.asarray(p_camera, dtype=float)
    z = np.where(p[..., 2] > 0, p[..., 2], np.nan)
    xd, yd = _distort(p[..., 0] / z, p[..., 1] / z, camera)
    return np.stack([camera.fx * xd + camera.cx, camera.fy * yd + camera.cy], axis=-1)


@singledispatch
def project_with_jacobians(camera: Camera, p_camera: ArrayLike) -> tuple[Array, Array, Array]:
    """Image points, their derivatives by the point and by the interior orientation.

    Returns
    -------
    xy : (..., 2) px.
    d_point : (..., 2, 3) px per m, by the point in the camera frame.
    d_intrinsics : (..., 2, 9) by the numbers in the order of the camera's names.
    """
    p = np.asarray(p_camera, dtype=float)
    z = np.where(p[..., 2] > 0, p[..., 2], np.nan)
    x, y = p[..., 0] / z, p[..., 1] / z
    r2 = x * x + y * y
    radial = 1.0 + r2 * (camera.k1 + r2 * (camera.k2 + r2 * camera.k3))
    slope = camera.k1 + r2 * (2.0 * camera.k2 + 3.0 * camera.k3 * r2)
    xd = x * radial + 2.0 * camera.p1 * x * y + camera.p2 * (r2 + 2.0 * x * x)
    yd = y * radial + camera.p1 * (r2 + 2.0 * y * y) + 2.0 * camera.p2 * x * y
    # derivatives of the distorted by the ideal image coordinates
    dxx = radial + 2.0 * x * x * slope + 2.0 * camera.p1 * y + 6.0 * camera.p2 * x
    dxy = 2.0 * x * y * slope + 2.0 * camera.p1 * x + 2.0 * camera.p2 * y
    dyy = radial + 2.0 * y * y * slope + 6.0 * camera.p1 * y + 2.0 * camera.p2 * x
    d_point = np.empty((*x.shape, 2, 3))
    d_point[..., 0, 0] = camera.fx * dxx / z
    d_point[..., 0, 1] = camera.fx * dxy / z
    d_point[..., 0, 2] = -camera.fx * (dxx * x + dxy * y) / z
    d_point[..., 1, 0] = camera.fy * dxy / z
    d_point[..., 1, 1] = camera.fy * dyy / z
    d_point[..., 1, 2] = -camera.fy * (dxy * x + dyy * y) / z
    d_in = np.zeros((*x.shape, 2, 9))
    d_in[..., 0, 0] = xd
    d_in[..., 1, 1] = yd
    d_in[..., 0, 2] = 1.0
    d_in[..., 1, 3] = 1.0
    powers = np.stack([r2, r2 * r2, r2 * r2 * r2], axis=-1)
    for column, power in zip((4, 5, 8), range(3), strict=True):
        d_in[..., 0, column] = camera.fx * x * powers[..., power]
        d_in[..., 1, column] = camera.fy * y * powers[..., power]
    d_in[..., 0, 6] = camera.fx * 2.0 * x * y
    d_in[..., 1, 6] = camera.fy * (r2 + 2.0 * y * y)
    d_in[..., 0, 7] = camera.fx * (r2 + 2.0 * x * x)
    d_in[..., 1, 7] = camera.fy * 2.0 * x * y
    return np.stack([camera.fx * xd + camera.cx, camera.fy * yd + camera.cy], axis=-1), d_point, d_in


def project_each(cameras: Sequence[Camera], camera: NDArray[np.integer], p_camera: Array) -> tuple[Array, Array, Array]:
    """:func:`project_with_jacobians` of points (m, 3), each by its own one, ``camera`` (m,), of the ``cameras``."""
    if len(cameras) == 1:
        return project_with_jacobians(cameras[0], p_camera)
    m = len(p_camera)
    xy, d_point, d_in = np.empty((m, 2)), np.empty((m, 2, 3)), np.empty((m, 2, 9))
    for c, one in enumerate(cameras):
        rows = camera == c
        xy[rows], d_point[rows], d_in[rows] = project_with_jacobians(one, p_camera[rows])
    return xy, d_point, d_in


@singledispatch
def normalise(camera: Camera, xy: ArrayLike, iterations: int = 50) -> Array:
    """Ideal image coordinates ``(..., 2)`` (x/z, y/z) of pixels ``(..., 2)``: distortion removed by Newton steps.

    Weakness: where the distortion polynomial is not invertible the result is NaN.
    """
    pixels = np.asarray(xy, dtype=float)
    target = (pixels - [camera.cx, camera.cy]) / [camera.fx, camera.fy]
    ideal = target.copy()
    unit = replace(camera, fx=1.0, fy=1.0, cx=0.0, cy=0.0)
    for _ in range(iterations):
        ray = np.concatenate([ideal, np.ones_like(ideal[..., :1])], axis=-1)
        value, d_point, _ = project_with_jacobians(unit, ray)
        with np.errstate(invalid="ignore", divide="ignore"):
            a, b = d_point[..., 0, 0], d_point[..., 0, 1]
            c, d = d_point[..., 1, 0], d_point[..., 1, 1]
            det = a * d - b * c
            residual = target - value
            step = np.stack(
                [
                    (d * residual[..., 0] - b * residual[..., 1]) / det,
                    (a * residual[..., 1] - c * residual[..., 0]) / det,
                ],
                axis=-1,
            )
        ideal = ideal + step
        if np.all(~np.isfinite(step) | (np.abs(step) < 1e-14)):
            break
    ray = np.concatenate([ideal, np.ones_like(ideal[..., :1])], axis=-1)
    bad = np.linalg.norm(project(unit, ray) - target, axis=-1) > 1e-9
    ideal[bad] = np.nan
    return ideal
