"""A linear camera: a cylindrical lens over a line of pixels. A reading says in which plane a light lies.

With ``(X, Y, Z)`` in the camera's frame (x along the pixels, y along the cylinder, z the viewing direction) the reading
is ``u = c + f x (1 + k1 x^2 + k2 x^4)``, ``x = X / Z``: the one-dimensional case of Brown's lens (Brown 1971). ``Y``
has no effect, so the place of the frame along its own y axis is a convention.
"""

from dataclasses import dataclass, replace

import numpy as np

from robcal.errors import InvalidInput
from robcal.transforms import Array, invert, retract, skew, transform

NUMBERS = ("x", "z", "rx", "ry", "rz", "f", "c", "k1", "k2")
"""Adjustable numbers: place along the own x and z (m), turns about the own axes (rad), f and c (px), distortion."""
POSE_COLUMNS = [0, 2, 3, 4, 5]
"""Those of the six numbers of a right perturbation of the frame, translation first, that a reading tells."""


@dataclass(frozen=True)
class LineCamera:
    """A linear camera.

    Attributes
    ----------
    world_T_camera : (4, 4), m.
    f, c : px, focal length and reading of the axis; k1, k2 : distortion.
    calibrated : smallest and largest reading (px) that the calibration had; None where that is not known.
    """

    world_T_camera: Array
    f: float
    c: float
    k1: float = 0.0
    k2: float = 0.0
    calibrated: tuple[float, float] | None = None

    def moved(self, step: Array) -> "LineCamera":
        """With the numbers of :data:`NUMBERS` changed by a step (9,)."""
        six = np.zeros(6)
        six[POSE_COLUMNS] = step[:5]
        f, c, k1, k2 = np.array([self.f, self.c, self.k1, self.k2]) + step[5:]
        return replace(self, world_T_camera=retract(self.world_T_camera, six), f=f, c=c, k1=k1, k2=k2)

    def read(self, p_world: Array) -> tuple[Array, Array, Array]:
        """Readings (n,) of points (n, 3), NaN behind the camera; derivatives by point (n, 3) and numbers (n, 9)."""
        p = transform(invert(self.world_T_camera), p_world)
        with np.errstate(divide="ignore", invalid="ignore"):
            x = np.where(p[:, 2] > 0, p[:, 0] / p[:, 2], np.nan)
            zero = np.zeros_like(x)
            by_p = np.stack([1.0 / p[:, 2], zero, -x / p[:, 2]], axis=1)
        bent = x * (1.0 + self.k1 * x**2 + self.k2 * x**4)
        slope = self.f * (1.0 + 3.0 * self.k1 * x**2 + 5.0 * self.k2 * x**4)
        by_p *= slope[:, None]
        by_six = np.concatenate([-by_p, np.einsum("ni,nij->nj", by_p, skew(p))], axis=1)
        lens = np.stack([bent, np.ones_like(x), self.f * x**3, self.f * x**5], axis=1)
        by_world = by_p @ self.world_T_camera[:3, :3].T
        return self.c + self.f * bent, by_world, np.concatenate([by_six[:, POSE_COLUMNS], lens], axis=1)

    def beyond(self, u: Array) -> Array:
        """Which readings (n,) lie beyond those of the calibration by more than a tenth of their range."""
        if self.calibrated is None:
            return np.zeros(len(u), dtype=bool)
        low, high = self.calibrated
        margin = 0.1 * (high - low)
        return np.asarray((u < low - margin) | (u > high + margin))

    def undistorted(self, u: Array) -> Array:
        """Tangents ``X / Z`` (n,) of readings, by Newton steps; NaN where the distortion cannot be inverted."""
        target = (u - self.c) / self.f
        x = target.copy()
        for _ in range(20):
            square = x**2
            wrong = x * (1.0 + self.k1 * square + self.k2 * square**2) - target
            slope = 1.0 + 3.0 * self.k1 * square + 5.0 * self.k2 * square**2
            x = x - wrong / np.where(slope > 0.1, slope, np.nan)
        return x

    def planes(self, u: Array) -> tuple[Array, Array]:
        """Unit normals (n, 3) and offsets (n,), both in the world, of the planes ``normal . p = offset`` of readings"""
        R, t = self.world_T_camera[:3, :3], self.world_T_camera[:3, 3]
        x = self.undistorted(u)
        normal = (R[:, 0] - x[:, None] * R[:, 2]) / np.sqrt(1.0 + x**2)[:, None]
        return normal, normal @ t


@dataclass(frozen=True)
class LineCameraSystem:
    """Linear cameras fixed to one another.

    Attributes
    ----------
    names : of the cameras; cameras : in that order.
    covariance : (9 c, 9 c) of the numbers of all cameras, camera by camera, m, rad, px.
    noise : px, standard deviation of a reading.
    """

    names: tuple[str, ...]
    cameras: tuple[LineCamera, ...]
    covariance: Array
    noise: float

    def __post_init__(self) -> None:
        if len(self.cameras) < 3:
            raise InvalidInput(
                f"a system of {len(self.cameras)} linear cameras: a reading is one plane, three cameras make a point"
            )


@dataclass(frozen=True)
class Readings:
    """Readings of linear cameras, one row per camera and light.

    ``point`` (m,) numbers the lights, 0 .. n-1; ``camera`` (m,); ``u`` and ``sigma`` (m,) px.
    """

    point: np.ndarray
    camera: np.ndarray
    u: Array
    sigma: Array

    @property
    def n(self) -> int:
        """Number of lights."""
        return int(self.point.max(initial=-1)) + 1


def read_each(cameras: tuple[LineCamera, ...], camera: np.ndarray, p: Array) -> tuple[Array, Array, Array]:
    """Readings (m,) of points (m, 3) by the given camera each, and derivatives (m, 3), (m, 9)."""
    u, by_point, by_numbers = np.empty(len(p)), np.empty((len(p), 3)), np.empty((len(p), 9))
    for k, one in enumerate(cameras):
        rows = camera == k
        u[rows], by_point[rows], by_numbers[rows] = one.read(p[rows])
    return u, by_point, by_numbers
