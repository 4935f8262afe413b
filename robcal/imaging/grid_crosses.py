"""Crosses of a measuring grid (reseau) in an image: found by correlation, fitted to grey values with covariance.

Grey value = b0 + b1 x + b2 y + a (1 - (1 - h1)(1 - h2)) with ``h`` the profile of a bar of width w behind a normal blur
s: ``h(d) = Phi((d + w/2) / s) - Phi((d - w/2) / s)``, ``d`` the distance from the middle of the bar. Both bars cross in
the point that is sought; pixels and their noise as in :mod:`robcal.imaging.corner_fit`.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from robcal.columns import Columns
from robcal.estimation.batched import NormalEquations, minimise_each
from robcal.estimation.summary import TerminationSettings
from robcal.transforms import Array

PARAMETERS = 10
"""x, y, angles of both bars' normals, ln blur, ln width, b0, b1, b2, a."""
LIKENESS = 0.55
"""Least correlation with a cross of the nominal size."""
MISFIT = 0.12
"""Largest RMS residual by contrast of a clean cross."""
LEAST_CONTRAST = 4.0
"""Least contrast by the scatter of the residuals."""
_FLOOR = 0.002
"""px, systematic part that no noise covers."""
_LN_SIGMA = 0.3
_SETTINGS = TerminationSettings(max_iterations=30, cost_tolerance=1e-8, negligible=1e-6)


@dataclass(frozen=True)
class CrossSize:
    """Size of the crosses in the image, px: width of a bar, length of an arm from the middle; dark on bright ground."""

    width: float
    arm: float
    dark: bool = True


@dataclass(frozen=True)
class Crosses(Columns):
    """Crosses of an image: ``xy`` (n, 2) px, ``covariance`` (n, 2, 2) px^2, ``contrast`` (n,), ``misfit`` (n,)."""

    xy: Array
    covariance: Array
    contrast: Array
    misfit: Array

    def __len__(self) -> int:
        return len(self.xy)


def find_crosses(image: NDArray, size: CrossSize) -> Crosses:
    """All clean crosses of an image (h, w) whose bars lie within some degrees of rows and columns."""
    grey = image.astype(np.float32)
    half = int(np.ceil(size.arm))
    if min(image.shape) < 2 * half + 3:
        return _none()
    template = _template(size, half)
    likeness = cv2.matchTemplate(grey, template if not size.dark else -template, cv2.TM_CCOEFF_NORMED)
    near = max(3, round(size.arm) | 1)
    highest = cv2.dilate(likeness, np.ones((near, near), np.uint8))
    y, x = np.nonzero((likeness >= highest) & (likeness > LIKENESS))
    if not len(x):
        return _none()
    return _fit(image.astype(float), np.column_stack([x, y]) + half, size)


def _none() -> Crosses:
    return Crosses(np.zeros((0, 2)), np.zeros((0, 2, 2)), np.zeros(0), np.zeros(0))


def _template(size: CrossSize, half: int) -> NDArray[np.float32]:
    line = np.clip(0.5 * size.width + 0.5 - np.abs(np.arange(-half, half + 1)), 0.0, 1.0)
    cross = np.maximum(line[:, None], line[None, :])
    return np.asarray(cv2.GaussianBlur(cross, (0, 0), max(0.7, 0.25 * size.width)), dtype=np.float32)


def cross_values(p: Array, x: Array, y: Array, half: float) -> tuple[Array, Array]:
    """Grey values (n, k) of crosses ``p`` (n, 10) at places x, y (k,) of their windows, derivatives (n, k, 10)."""
    blur, width = np.exp(p[:, 4, None]), np.exp(p[:, 5, None])
    dx, dy = x - p[:, 0, None], y - p[:, 1, None]
    J = np.empty((len(p), len(x), PARAMETERS))
    h, slope, by_angle, by_blur, by_width, normal = [], [], [], [], [], []
    for k in (2, 3):
        c, s = np.cos(p[:, k, None]), np.sin(p[:, k, None])
        d = c * dx + s * dy
        upper, lower = (d + 0.5 * width) / blur, (d - 0.5 * width) / blur
        above, below = _density(upper), _density(lower)
        h.append(ndtr(upper) - ndtr(lower))
        slope.append((above - below) / blur)
        by_angle.append(slope[-1] * (c * dy - s * dx))
        by_blur.append(-(upper * above - lower * below))
        by_width.append(0.5 * width * (above + below) / blur)
        normal.append((c, s))
    a = p[:, 9, None]
    rest = [1.0 - h[1], 1.0 - h[0]]
    J[..., 0] = -a * (slope[0] * rest[0] * normal[0][0] + slope[1] * rest[1] * normal[1][0])
    J[..., 1] = -a * (slope[0] * rest[0] * normal[0][1] + slope[1] * rest[1] * normal[1][1])
    J[..., 2], J[..., 3] = a * by_angle[0] * rest[0], a * by_angle[1] * rest[1]
    J[..., 4] = a * (by_blur[0] * rest[0] + by_blur[1] * rest[1])
    J[..., 5] = a * (by_width[0] * rest[0] + by_width[1] * rest[1])
    cover = 1.0 - rest[0] * rest[1]
    J[..., 6], J[..., 7], J[..., 8], J[..., 9] = 1.0, x / half, y / half, cover
    return p[:, 6, None] + p[:, 7, None] * x / half + p[:, 8, None] * y / half + a * cover, J


def _density(u: Array) -> Array:
    return np.asarray(np.exp(-0.5 * np.minimum(u * u, 80.0)) / np.sqrt(2.0 * np.pi))


def _fit(image: Array, places: NDArray[np.int64], size: CrossSize) -> Crosses:
    """Fits around whole pixels (n, 2); those that are no clean crosses are left out."""
    half = max(3, int(0.85 * size.arm))
    h, w = image.shape
    inside = (places >= half).all(axis=1) & (places[:, 0] < w - half) & (places[:, 1] < h - half)
    places = places[inside]
    if not len(places):
        return _none()
    j, i = (v.ravel() for v in np.mgrid[-half : half + 1, -half : half + 1])
    value = image[places[:, 1, None] + j, places[:, 0, None] + i]
    low, high = np.percentile(value, [10, 80], axis=1) if size.dark else np.percentile(value, [90, 20], axis=1)
    start = np.zeros((len(places), PARAMETERS))
    start[:, 3] = np.pi / 2
    start[:, 4], start[:, 5] = np.log(0.9), np.log(size.width)
    start[:, 6], start[:, 9] = high, low - high
    x, y = i.astype(float), j.astype(float)
    expected = start[:, 4:6].copy()

    def equations(p: Array, rows: NDArray[np.int64]) -> NormalEquations:
        grey, J = cross_values(p, x, y, float(half))
        scale = np.maximum(np.abs(start[rows, 9]), 1.0)[:, None]
        r = (value[rows] - grey) / scale
        J = J / scale[..., None]
        matrix = np.swapaxes(J, 1, 2) @ J
        right = (np.swapaxes(J, 1, 2) @ r[..., None])[..., 0]
        off = expected[rows] - p[:, 4:6]
        weight = 1e-3 * len(x) / _LN_SIGMA**2  # keeps blur and width apart where the bars are thin
        matrix[:, [4, 5], [4, 5]] += weight
        right[:, 4:6] += weight * off
        return NormalEquations(matrix, right, (r**2).sum(axis=1) + weight * (off**2).sum(axis=1))

    def retract(p: Array, step: Array) -> Array:
        moved = p + step * np.minimum(1.0, 1.0 / np.maximum(np.abs(step[:, :2]).max(axis=1), 1e-12))[:, None]
        moved[:, 4:6] = np.clip(moved[:, 4:6], -1.5, np.log(size.arm))
        return moved

    solved = minimise_each(equations, retract, start, _SETTINGS)
    return _clean(solved.state, value, places, x, y, half, size)


def _clean(
    p: Array, value: Array, places: NDArray[np.int64], x: Array, y: Array, half: int, size: CrossSize
) -> Crosses:
    grey, J = cross_values(p, x, y, float(half))
    variance = ((value - grey) ** 2).sum(axis=1) / (len(x) - PARAMETERS)
    normal = np.swapaxes(J, 1, 2) @ J
    covariance = NormalEquations(normal, p, variance).inverse()[:, :2, :2] * variance[:, None, None]
    covariance = covariance + _FLOOR**2 * np.eye(2)
    contrast = np.abs(p[:, 9])
    misfit = np.sqrt(variance) / np.maximum(contrast, 1e-9)
    upright = (np.abs(p[:, 2]) < 0.2) & (np.abs(p[:, 3] - np.pi / 2) < 0.2)
    good = (np.abs(p[:, :2]) < 0.4 * half).all(axis=1) & upright & (misfit < MISFIT)
    good &= ((p[:, 9] < 0) == size.dark) & (contrast > LEAST_CONTRAST * np.sqrt(variance))
    good &= np.isfinite(covariance).all(axis=(1, 2))
    return Crosses(p[:, :2] + places, covariance, contrast, misfit).select(good)
