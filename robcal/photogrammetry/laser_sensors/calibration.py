"""A laser sensor calibrated by readings of a target that is moved to known places, which give its coordinates."""

from dataclasses import dataclass, field

import numpy as np

from robcal.errors import DegenerateGeometry, InvalidInput
from robcal.estimation.covariance import cofactor
from robcal.estimation.gauss_newton import gauss_newton
from robcal.photogrammetry.laser_sensors.sensor import FREE, NUMBERS, READINGS, LaserSensor, model
from robcal.transforms import Array

SPARE = 2
"""Readings beyond the numbers that are determined, so that something is left to judge by."""
FLAT = 1e-3
"""Share of the largest singular value below which the places do not determine a sensor."""
FAR = 5.0
"""Standard deviations from which single readings are told."""


@dataclass(frozen=True)
class SensorCalibration:
    """A sensor and how it fits: ``residual`` (m, r) in the units of the readings, ``redundancy``; ``odd`` : readings
    that are off by more than five standard deviations of all others."""

    sensor: LaserSensor
    residual: Array = field(repr=False)
    redundancy: int
    odd: tuple[int, ...]


def calibrate_sensor(
    kind: str, readings: Array, places: Array, sigma: float = 0.0, aim: float = 0.0
) -> SensorCalibration:
    """Numbers of a sensor by least squares in its readings, noise from the residuals.

    Parameters
    ----------
    readings : (m, r) of the kind. places : (m, 3) m, of the target, in what becomes the sensor's coordinates.
    sigma : m; standard deviation of a coordinate of the places, in which the readings were taken.
    aim : as of :class:`LaserSensor`.

    Raises
    ------
    DegenerateGeometry : too few places, or places that do not determine the numbers.
    InvalidInput : readings that no such sensor gives.
    """
    count, columns, at = len(NUMBERS[kind]), len(READINGS[kind]), list(FREE[kind])
    least = -(-(count + SPARE) // columns)
    if len(readings) < least:
        raise DegenerateGeometry(
            f"{len(readings)} places: a sensor of kind '{kind}' has {count} numbers, {least} places are needed at least"
        )
    spread = np.linalg.svd(places[:, at] - places[:, at].mean(axis=0), compute_uv=False)
    if spread[-1] <= FLAT * max(spread[0], 1e-12) or np.ptp(places[:, 2]) <= 0:
        what = {1: "do not differ in depth (z)", 2: "lie on a line", 3: "lie in a plane"}[len(at)]
        raise DegenerateGeometry(f"the places {what}: move the target through the whole range of the sensor")
    still = [name for name, values in zip(READINGS[kind], readings.T, strict=True) if np.ptp(values) == 0]
    if still:
        raise InvalidInput(f"the readings of {still[0]} are all the same: they belong to no target that was moved")
    start = _start(kind, readings, places)
    weight = np.ones(columns)
    numbers = start
    for _ in range(3):  # the columns of a reading may scatter differently, and places by what they move them

        def residuals(x: Array, weight: Array = weight) -> Array:
            return np.asarray(((readings - model(kind, places, x)[0]) / weight).ravel())

        def linearise(x: Array, weight: Array = weight) -> tuple[Array, Array]:
            r, _, J = model(kind, places, x)
            return ((readings - r) / weight).ravel(), (J / weight[:, None]).reshape(-1, count)

        numbers, _ = gauss_newton(linearise, residuals, lambda x, step: x + step, numbers)
        left = readings - model(kind, places, numbers)[0]
        share = 1.0 - count / left.size
        weight = np.maximum(np.sqrt(np.mean(left**2, axis=0) / share), 1e-12 * np.abs(readings).max(axis=0))
    if not np.isfinite(numbers).all() or np.any(np.sqrt(np.mean(left**2, axis=0)) > 0.1 * np.ptp(readings, axis=0)):
        raise InvalidInput(
            f"the readings are those of no sensor of kind '{kind}' at these places: check the kind, the units (mm, px) "
            "and that the rows belong together"
        )
    _, A, J = model(kind, places, numbers)
    covariance = cofactor((J / weight[:, None]).reshape(-1, count))
    moved = np.sqrt(np.mean(np.sum((A * sigma) ** 2, axis=2), axis=0))
    noise = np.sqrt(np.maximum(weight**2 - moved**2, (0.1 * weight) ** 2))
    ranges = np.column_stack([readings.min(axis=0), readings.max(axis=0)])
    sensor = LaserSensor(kind, numbers, covariance, noise, ranges, aim)
    odd = np.flatnonzero((np.abs(left) > FAR * weight).any(axis=1))
    return SensorCalibration(sensor, left, left.size - count, tuple(int(k) for k in odd))


def _start(kind: str, readings: Array, places: Array) -> Array:
    """Numbers by linear equations."""
    if kind == "axial":
        return np.asarray(np.linalg.lstsq(np.column_stack([np.ones(len(places)), places[:, 2]]), readings[:, 0])[0])
    beam = np.zeros(0)
    if kind in ("point", "spot"):
        z, u = places[:, 2], readings[:, 0]
        # (z + z0)(1 - B u) = H: linear in H - z0, B and B z0
        size = max(float(np.abs(u).max()), 1.0)
        ahead, B, both = np.linalg.lstsq(np.column_stack([np.ones(len(z)), u * z / size, u / size]), z)[0]
        if not abs(B) > 0:
            raise InvalidInput("the readings do not change with depth: check the column u_px")
        beam = np.array([ahead + both / B, B / size, both / B])
    if kind == "point":
        return beam
    x = places[:, 1:] if kind == "section" else places
    images = readings[:, -2:]
    middle, size = images.mean(axis=0), max(float(np.ptp(images)), 1e-12)
    h = np.column_stack([x, np.ones(len(x))])
    zero = np.zeros_like(h)
    a, b = ((images - middle) / size).T
    rows = np.concatenate([np.hstack([h, zero, -a[:, None] * h]), np.hstack([zero, h, -b[:, None] * h])])
    scale = np.maximum(np.linalg.norm(rows, axis=0), 1e-300)
    G = (np.linalg.svd(rows / scale)[2][-1] / scale).reshape(3, -1)
    G = np.array([[size, 0.0, middle[0]], [0.0, size, middle[1]], [0.0, 0.0, 1.0]]) @ G
    return np.concatenate([beam, (G / G[2, -1]).ravel()[:-1]])
