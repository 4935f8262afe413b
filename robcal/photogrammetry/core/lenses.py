"""Lenses beside Brown's: OpenCV's rational model with thin prism terms, and its fisheye.

Sources: OpenCV documentation, "Camera Calibration and 3D Reconstruction" and "Fisheye camera model"; thin prism terms
after Weng, Cohen, Herniou (1992); equidistant polynomial after Kannala and Brandt (2006). Both work wherever a camera
does that is not itself adjusted as one of nine numbers: projection, resection, hand-eye calibration.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from robcal.photogrammetry.core.camera import INTRINSIC_NAMES, Camera, normalise, project, project_with_jacobians
from robcal.transforms import Array

RATIONAL_NAMES = (*INTRINSIC_NAMES, "k4", "k5", "k6", "s1", "s2", "s3", "s4")
FISHEYE_NAMES = ("fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4")
NEAR_AXIS = 1e-7
"""Distance from the optical axis by the distance from the camera below which a fisheye's image is linear."""


@dataclass(frozen=True)
class RationalCamera(Camera):
    """Radial distortion as a quotient of polynomials (k1 k2 k3 over k4 k5 k6), thin prism terms s1 to s4."""

    k4: float = 0.0
    k5: float = 0.0
    k6: float = 0.0
    s1: float = 0.0
    s2: float = 0.0
    s3: float = 0.0
    s4: float = 0.0

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the sixteen numbers in the order of the vector."""
        return RATIONAL_NAMES

    @property
    def distortion(self) -> Array:
        """OpenCV's vector (k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4)."""
        return self.vector[4:]


@dataclass(frozen=True)
class FisheyeCamera(Camera):
    """Equidistant projection with a polynomial of the angle to the axis: theta (1 + k1 theta^2 + ... + k4 theta^8).

    p1 and p2 stay zero. Sees points beside and behind itself, up to half a turn from the axis.
    """

    k4: float = 0.0

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the eight numbers in the order of the vector."""
        return FISHEYE_NAMES

    @property
    def distortion(self) -> Array:
        """OpenCV's vector (k1, k2, k3, k4)."""
        return self.vector[4:]


@project.register
def _project_rational(camera: RationalCamera, p_camera: ArrayLike) -> Array:
    return project_with_jacobians(camera, p_camera)[0]


@project_with_jacobians.register
def _rational(camera: RationalCamera, p_camera: ArrayLike) -> tuple[Array, Array, Array]:
    p = np.asarray(p_camera, dtype=float)
    z = np.where(p[..., 2] > 0, p[..., 2], np.nan)
    x, y = p[..., 0] / z, p[..., 1] / z
    r2 = x * x + y * y
    above = 1.0 + r2 * (camera.k1 + r2 * (camera.k2 + r2 * camera.k3))
    below = 1.0 + r2 * (camera.k4 + r2 * (camera.k5 + r2 * camera.k6))
    radial = above / below
    rising = camera.k1 + r2 * (2.0 * camera.k2 + 3.0 * camera.k3 * r2)
    slope = (rising - radial * (camera.k4 + r2 * (2.0 * camera.k5 + 3.0 * camera.k6 * r2))) / below
    p1, p2 = camera.p1, camera.p2
    xd = x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x) + r2 * (camera.s1 + camera.s2 * r2)
    yd = y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y + r2 * (camera.s3 + camera.s4 * r2)
    along, across = 2.0 * (camera.s1 + 2.0 * camera.s2 * r2), 2.0 * (camera.s3 + 2.0 * camera.s4 * r2)
    mixed = 2.0 * (x * y * slope + p1 * x + p2 * y)
    by_ideal = np.empty((*x.shape, 2, 2))
    by_ideal[..., 0, 0] = radial + 2.0 * x * x * slope + 2.0 * p1 * y + 6.0 * p2 * x + along * x
    by_ideal[..., 0, 1] = mixed + along * y
    by_ideal[..., 1, 0] = mixed + across * x
    by_ideal[..., 1, 1] = radial + 2.0 * y * y * slope + 6.0 * p1 * y + 2.0 * p2 * x + across * y
    focal = np.array([camera.fx, camera.fy])
    d_point = np.empty((*x.shape, 2, 3))
    d_point[..., :2] = by_ideal * focal[:, None] / z[..., None, None]
    d_point[..., 2] = -(d_point[..., 0] * x[..., None] + d_point[..., 1] * y[..., None])
    columns = [(x * r2**k / below, y * r2**k / below) for k in (1, 2)]
    columns += [
        (2.0 * x * y, r2 + 2.0 * y * y),
        (r2 + 2.0 * x * x, 2.0 * x * y),
        (x * r2**3 / below, y * r2**3 / below),
    ]
    columns += [(-x * radial * r2**k / below, -y * radial * r2**k / below) for k in (1, 2, 3)]
    zero = np.zeros_like(x)
    columns += [(r2, zero), (r2 * r2, zero), (zero, r2), (zero, r2 * r2)]
    return _assembled(camera, xd, yd, d_point, columns)


def _assembled(
    camera: Camera, xd: Array, yd: Array, d_point: Array, columns: list[tuple[Array, Array]]
) -> tuple[Array, Array, Array]:
    """Pixels and derivatives from distorted coordinates and their derivatives by the coefficients."""
    d_in = np.zeros((*xd.shape, 2, 4 + len(columns)))
    d_in[..., 0, 0], d_in[..., 1, 1], d_in[..., 0, 2], d_in[..., 1, 3] = xd, yd, 1.0, 1.0
    for k, (by_x, by_y) in enumerate(columns, start=4):
        d_in[..., 0, k], d_in[..., 1, k] = camera.fx * by_x, camera.fy * by_y
    return np.stack([camera.fx * xd + camera.cx, camera.fy * yd + camera.cy], axis=-1), d_point, d_in


@project.register
def _project_fisheye(camera: FisheyeCamera, p_camera: ArrayLike) -> Array:
    return project_with_jacobians(camera, p_camera)[0]


@project_with_jacobians.register
def _fisheye(camera: FisheyeCamera, p_camera: ArrayLike) -> tuple[Array, Array, Array]:
    p = np.asarray(p_camera, dtype=float)
    X, Y, Z = p[..., 0], p[..., 1], p[..., 2]
    rho, square = np.hypot(X, Y), np.sum(p * p, axis=-1)
    theta = np.arctan2(rho, Z)
    t2 = theta * theta
    k = camera.distortion
    bent = theta * (1.0 + t2 * (k[0] + t2 * (k[1] + t2 * (k[2] + t2 * k[3]))))
    slope = 1.0 + t2 * (3.0 * k[0] + t2 * (5.0 * k[1] + t2 * (7.0 * k[2] + t2 * 9.0 * k[3])))
    near = rho < NEAR_AXIS * np.sqrt(square)
    safe = np.where(near, 1.0, rho)
    with np.errstate(divide="ignore", invalid="ignore"):
        ahead = np.where(near & (Z > 0), 1.0 / Z, np.nan)
        stretch = np.where(near, ahead, bent / safe)  # distorted coordinate by coordinate
        # its derivative by rho, divided by rho; on the axis the second order does not count
        change = np.where(near, 0.0, (slope * Z / square - stretch) / safe**2)
    xd, yd = X * stretch, Y * stretch
    d_point = np.empty((*X.shape, 2, 3))
    d_point[..., 0, 0] = stretch + X * X * change
    d_point[..., 0, 1] = d_point[..., 1, 0] = X * Y * change
    d_point[..., 1, 1] = stretch + Y * Y * change
    d_point[..., 0, 2], d_point[..., 1, 2] = -slope * X / square, -slope * Y / square
    d_point *= np.array([camera.fx, camera.fy])[:, None]
    odd = [np.where(near, 0.0, theta ** (2 * j + 1) / safe) for j in (1, 2, 3, 4)]
    return _assembled(camera, xd, yd, d_point, [(X * o, Y * o) for o in odd])


@normalise.register
def _normalise_fisheye(camera: FisheyeCamera, xy: ArrayLike, iterations: int = 50) -> Array:
    """Ideal coordinates; NaN for directions beside or behind the camera, which have none."""
    bent = (np.asarray(xy, dtype=float) - [camera.cx, camera.cy]) / [camera.fx, camera.fy]
    length = np.linalg.norm(bent, axis=-1)
    k = camera.distortion
    theta = np.minimum(length, 1.5)
    for _ in range(iterations):
        t2 = theta * theta
        value = theta * (1.0 + t2 * (k[0] + t2 * (k[1] + t2 * (k[2] + t2 * k[3]))))
        slope = 1.0 + t2 * (3.0 * k[0] + t2 * (5.0 * k[1] + t2 * (7.0 * k[2] + t2 * 9.0 * k[3])))
        step = (length - value) / np.where(np.abs(slope) > 1e-9, slope, np.nan)
        theta = theta + np.clip(step, -0.3, 0.3)
        if np.all(~np.isfinite(step) | (np.abs(step) < 1e-14)):
            break
    good = np.isfinite(theta) & (theta >= 0.0) & (theta < 0.5 * np.pi) & (np.abs(length - value) < 1e-9)
    with np.errstate(divide="ignore", invalid="ignore"):
        factor = np.where(length > 0, np.tan(theta) / length, 1.0)
    return np.where(good[..., None], bent * factor[..., None], np.nan)
