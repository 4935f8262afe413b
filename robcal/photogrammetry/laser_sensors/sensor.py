"""Laser sensors: how a raw reading follows from a point, and the point with its covariance from a reading.

All kinds look along +z of the sensor. Every one is a function from a point to what it reads, with the derivatives by
the point and by the sensor's own numbers; the point of a reading is the inverse, and both the noise of the reading and
the uncertainty of the numbers go through the implicit derivative (Foerstner and Wrobel 2016, section 2.7).

- point (1D): a beam along z, its spot on a line sensor at u: ``z = H / (1 - B u) - z0`` (similar triangles; Luhmann et
  al. 2020, section 6.6; z0 where depth is not counted from the line that the camera stands on).
- section (2D): a plane of light, x = 0, in an image: (u, v) is a projectivity of (y, z) (Hartley and Zisserman 2004,
  section 2.3).
- spot (3D): the distance from a point sensor, and the centre of an ellipse in an image of the surface at that distance:
  a camera of eleven numbers (direct linear transformation, Abdel-Aziz and Karara 1971) whose ray meets the plane z.
- axial (1D): a distance along z, read with a scale and from a zero of its own.

Weaknesses: no lens distortion; a surface that is tilted puts the ellipse of a `spot` at another depth than the beam.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from robcal.errors import InvalidInput
from robcal.transforms import Array

READINGS: Mapping[str, tuple[str, ...]] = {
    "point": ("u_px",),
    "section": ("u_px", "v_px"),
    "spot": ("u_px", "x_px", "y_px"),
    "axial": ("distance_mm",),
}
"""Columns of a reading."""
FREE: Mapping[str, tuple[int, ...]] = {"point": (2,), "section": (1, 2), "spot": (0, 1, 2), "axial": (2,)}
"""Coordinates that a reading tells."""
NUMBERS: Mapping[str, tuple[str, ...]] = {
    "point": ("H_m", "B_per_px", "zero_m"),
    "section": tuple(f"g{k}" for k in range(8)),
    "spot": ("H_m", "B_per_px", "zero_m", *(f"p{k}" for k in range(11))),
    "axial": ("zero_mm", "mm_per_m"),
}
"""Numbers of a sensor, readings in their own units, places in metres."""


@dataclass(frozen=True)
class LaserSensor:
    """A calibrated sensor.

    Attributes
    ----------
    kind : of :data:`READINGS`. numbers : (k,) of :data:`NUMBERS`; covariance : (k, k).
    noise : (r,) standard deviation of each reading. ranges : (r, 2) readings of the calibration.
    aim : m; standard deviation sideways, in coordinates that no reading tells: how far beside the target it looks.

    Raises
    ------
    InvalidInput : an unknown kind, arrays of other sizes, noise that is not above zero, no aim where it is needed.
    """

    kind: str
    numbers: Array
    covariance: Array = field(repr=False)
    noise: Array
    ranges: Array
    aim: float = 0.0

    def __post_init__(self) -> None:
        if self.kind not in READINGS:
            raise InvalidInput(f"'{self.kind}' is no kind of sensor: known are {', '.join(READINGS)}")
        k, r = len(NUMBERS[self.kind]), len(READINGS[self.kind])
        shapes = {"numbers": (k,), "covariance": (k, k), "noise": (r,), "ranges": (r, 2)}
        for name, shape in shapes.items():
            value = np.asarray(getattr(self, name), dtype=float)
            if value.shape != shape:
                raise InvalidInput(f"a sensor of kind '{self.kind}' has {name} of shape {shape}, got {value.shape}")
            object.__setattr__(self, name, value)
        if not np.all(self.noise > 0):
            raise InvalidInput("the noise of a sensor's readings must be above zero")
        if len(FREE[self.kind]) < 3 and not self.aim > 0:
            raise InvalidInput(
                f"a sensor of kind '{self.kind}' does not tell all coordinates: state how far beside the target it may "
                "look (aim_mm)"
            )

    def read(self, p: Array) -> tuple[Array, Array, Array]:
        """What it reads (m, r) of points (m, 3), and its derivatives by the points (m, r, 3) and by the numbers."""
        return model(self.kind, p, self.numbers)

    def outside(self, readings: Array) -> Array:
        """Which of the readings (m, r) no point gives, or lie beyond those of the calibration by more than a tenth of
        their range (m,)."""
        low, high = self.ranges.T
        tolerance = 0.1 * (high - low)
        far = ((readings < low - tolerance) | (readings > high + tolerance)).any(axis=1)
        return np.asarray(far | ~np.isfinite(_inverse(self.kind, readings, self.numbers)).all(axis=1))

    def points(self, readings: Array) -> tuple[Array, Array, Array]:
        """Points (m, 3), m, the covariance (m, 3, 3) of their own noise, and (m, 3, k) derivatives by the numbers."""
        p = _inverse(self.kind, np.asarray(readings, dtype=float), self.numbers)
        at = list(FREE[self.kind])
        _, A, N = self.read(p)
        inverse = np.linalg.inv(A[:, :, at])
        J = np.zeros((len(p), 3, len(self.numbers)))
        J[:, at] = -inverse @ N
        C = np.zeros((len(p), 3, 3))
        C[:, [0, 1, 2], [0, 1, 2]] = self.aim**2
        C[:, np.array(at)[:, None], np.array(at)] = (inverse * self.noise**2) @ np.swapaxes(inverse, 1, 2)
        return p, C, J


def model(kind: str, p: Array, numbers: Array) -> tuple[Array, Array, Array]:
    """Readings (m, r) of points (m, 3) by a sensor's numbers (k,), derivatives (m, r, 3) and (m, r, k)."""
    if kind == "axial":
        return _axial(p, numbers)
    if kind == "point":
        return _beam(p, numbers)
    if kind == "section":
        u, by_point, by_numbers = _projective(p[:, 1:], np.append(numbers, 1.0).reshape(3, 3))
        return u, np.concatenate([np.zeros((len(p), 2, 1)), by_point], axis=2), by_numbers
    u, by_point, by_numbers = _beam(p, numbers[:3])
    x, x_by_point, x_by_numbers = _projective(p, np.append(numbers[3:], 1.0).reshape(3, 4))
    both = np.zeros((len(p), 3, 14))
    both[:, :1, :3], both[:, 1:, 3:] = by_numbers, x_by_numbers
    return np.concatenate([u, x], axis=1), np.concatenate([by_point, x_by_point], axis=1), both


def _beam(p: Array, numbers: Array) -> tuple[Array, Array, Array]:
    H, B, zero = numbers
    z = p[:, 2] + zero
    by_point = np.zeros((len(p), 1, 3))
    by_point[:, 0, 2] = H / (B * z**2)
    by_numbers = np.stack([-1.0 / (B * z), -(1.0 - H / z) / B**2, by_point[:, 0, 2]], axis=1)[:, None]
    return ((1.0 - H / z) / B)[:, None], by_point, by_numbers


def _axial(p: Array, numbers: Array) -> tuple[Array, Array, Array]:
    zero, scale = numbers
    by_point = np.zeros((len(p), 1, 3))
    by_point[:, 0, 2] = scale
    by_numbers = np.stack([np.ones(len(p)), p[:, 2]], axis=1)[:, None]
    return (zero + scale * p[:, 2])[:, None], by_point, by_numbers


def _projective(x: Array, G: Array) -> tuple[Array, Array, Array]:
    """Images (m, 2) of points (m, d) by a projective map (3, d + 1), by the points and all elements but the last."""
    h = np.column_stack([x, np.ones(len(x))])
    w = h @ G.T
    image = w[:, :2] / w[:, 2:]
    d = x.shape[1]
    by_point = (G[:2, :d] - image[:, :, None] * G[2, :d]) / w[:, 2, None, None]
    by_numbers = np.zeros((len(x), 2, 3, d + 1))
    for k in range(2):
        by_numbers[:, k, k] = h / w[:, 2:]
        by_numbers[:, k, 2] = -image[:, k, None] * h / w[:, 2:]
    return image, by_point, by_numbers.reshape(len(x), 2, -1)[:, :, :-1]


def _inverse(kind: str, readings: Array, numbers: Array) -> Array:
    """Points (m, 3) of readings (m, r); those that no point gives are not finite."""
    p = np.zeros((len(readings), 3))
    if kind == "axial":
        p[:, 2] = (readings[:, 0] - numbers[0]) / numbers[1]
    elif kind == "section":
        w = np.column_stack([readings, np.ones(len(p))]) @ np.linalg.inv(np.append(numbers, 1.0).reshape(3, 3)).T
        p[:, 1:] = w[:, :2] / w[:, 2:]
    else:
        turned = 1.0 - numbers[1] * readings[:, 0]
        p[:, 2] = np.where(turned > 0, numbers[0] / np.where(turned > 0, turned, 1.0) - numbers[2], np.nan)
    if kind == "spot":
        P = np.append(numbers[3:], 1.0).reshape(3, 4)
        for k, (_, x, y) in enumerate(readings):
            left = P[:2] - np.outer([x, y], P[2])
            p[k, :2] = np.linalg.solve(left[:, :2], -(left[:, 2] * p[k, 2] + left[:, 3]))
    return p
