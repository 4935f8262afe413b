"""Coarse dots: places that are dot-like at some scale, for bodies whose dots no ellipse of even brightness describes.

Drilled holes, balls lit from the side, dots seen through water: their outline is round, their brightness is not even,
and the strict fit of :mod:`robcal.imaging.detect` refuses them. Extrema of the scale-normalised Laplacian of Gaussian
(Lindeberg 1998, "Feature detection with automatic scale selection") find them at a fraction of their radius, which is
enough to identify them by geometry; their covariance is stated accordingly.
"""

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from robcal.imaging.detections import Detections, TargetKind, empty_columns

Array = NDArray[np.float64]

_STEP = 1.26
"""Ratio of neighbouring scales: three to the octave."""
_MIN_RADIUS, _MAX_RADIUS = 1.5, 20.0
_CONTRAST_SIGMA = 6.0
_CENTRE_SHARE = 0.12
"""Standard deviation of a coarse centre as a share of the radius: side light moves the centroid of a ball by about a
tenth of its radius."""


def with_coarse_dots(image: NDArray, found: Detections, *, polarity: str = "bright", limit: int = 2500) -> Detections:
    """Detections with coarse dots added where the strict detection has nothing.

    Parameters
    ----------
    image : (h, w) the image of ``found``. limit : coarse dots at most, those of most contrast.

    Notes
    -----
    Coarse dots have ``residual`` NaN (no ellipse was fitted) and a covariance of a tenth of their radius. Weakness:
    most coarse dots of a real image are dust and reflections; use them only where geometry decides.
    """
    turned = image if polarity == "bright" else np.iinfo(image.dtype).max - image
    xy, radius, contrast, background = coarse_dots(turned, float(found.noise.sigma))
    if len(found) and len(xy):
        d = np.linalg.norm(xy[:, None] - found.xy[None], axis=-1)
        free = (d > np.maximum(radius[:, None], 0.7 * found.semi_axes[None, :, 0])).all(axis=1)
        xy, radius, contrast, background = xy[free], radius[free], contrast[free], background[free]
    keep = np.sort(np.argsort(-contrast, kind="stable")[:limit])
    n = len(keep)
    if n == 0:
        return found
    columns = empty_columns(n)
    sign = 1.0 if polarity == "bright" else -1.0
    columns["xy"] = xy[keep]
    columns["covariance"] = ((_CENTRE_SHARE * radius[keep]) ** 2 + 0.01)[:, None, None] * np.eye(2)
    columns["semi_axes"] = np.repeat(radius[keep, None], 2, axis=1)
    columns["contrast"] = sign * contrast[keep]
    columns["background"] = background[keep] if sign > 0 else np.iinfo(image.dtype).max - background[keep]
    columns["kind"] = np.full(n, int(TargetKind.DOT), np.int8)
    columns["blur"] = np.full(n, np.nan)
    columns["residual"] = np.full(n, np.nan)
    joined: dict[str, Any] = {name: np.concatenate([old, columns[name]]) for name, old in found.columns().items()}
    return Detections(shape=found.shape, noise=found.noise, rejected=found.rejected, message="", **joined)


def coarse_dots(image: NDArray, noise_sigma: float) -> tuple[Array, Array, Array, Array]:
    """Bright dots of an image (h, w) at their own scales.

    Returns
    -------
    Centres (n, 2) px, radii (n,) px, contrast (n,) and background (n,) grey values.
    """
    # a median of 3 x 3 takes single hot pixels and dust of one pixel away and leaves dots of radius 1.5 or more
    grey = cv2.medianBlur(image, 3).astype(np.float32)
    scales = [_MIN_RADIUS / np.sqrt(2)]
    while scales[-1] * np.sqrt(2) < _MAX_RADIUS:
        scales.append(scales[-1] * _STEP)
    stack = np.stack([_laplacian(grey, s) for s in scales])
    # bright disc of contrast c and matching radius: response c / e * 2 (at r = sqrt(2) sigma)
    floor = 2.0 / np.e * _CONTRAST_SIGMA * max(noise_sigma, 0.3)
    peak = np.empty(stack.shape, dtype=bool)
    kernel = np.ones((3, 3), np.uint8)
    widest = [cv2.dilate(level, kernel) for level in stack]
    for k, level in enumerate(stack):
        near = np.maximum.reduce(widest[max(0, k - 1) : k + 2])
        peak[k] = (level >= near) & (level > floor)
    which, rows, columns = np.nonzero(peak[:-1])  # the coarsest level has no neighbour above: no extremum
    if len(which) == 0:
        return np.empty((0, 2)), np.empty(0), np.empty(0), np.empty(0)
    order = np.argsort(-stack[which, rows, columns], kind="stable")
    which, rows, columns = which[order], rows[order], columns[order]
    radius = np.asarray(scales)[which] * np.sqrt(2)
    xy, contrast, background = _centroids(grey, columns, rows, radius)
    ok = (contrast > _CONTRAST_SIGMA * noise_sigma) & (
        np.linalg.norm(xy - np.column_stack([columns, rows]), axis=1) < np.maximum(0.5 * radius, 1.0)
    )
    return xy[ok], radius[ok], contrast[ok], background[ok]


def _laplacian(grey: NDArray[np.float32], sigma: float) -> NDArray[np.float32]:
    """Negative scale-normalised Laplacian, as a difference of two Gaussians of nearly equal width."""
    ratio = 1.1
    narrow = cv2.GaussianBlur(grey, (0, 0), sigma / np.sqrt(ratio))
    wide = cv2.GaussianBlur(grey, (0, 0), sigma * np.sqrt(ratio))
    # G(s2) - G(s1) ~ (s2^2 - s1^2) / 2 * Laplacian
    return np.asarray((narrow - wide) * (2.0 / (ratio - 1.0 / ratio)), dtype=np.float32)


def _centroids(grey: NDArray[np.float32], x: NDArray, y: NDArray, radius: Array) -> tuple[Array, Array, Array]:
    """Grey centroids above half contrast in a disc of 1.5 radii, contrast and background of each extremum."""
    h, w = grey.shape
    xy = np.column_stack([x, y]).astype(float)
    contrast = np.zeros(len(x))
    background = np.zeros(len(x))
    for k, (cx, cy, r) in enumerate(zip(x, y, radius, strict=True)):
        reach = int(np.ceil(2.2 * r)) + 1
        x0, x1, y0, y1 = max(0, cx - reach), min(w, cx + reach + 1), max(0, cy - reach), min(h, cy + reach + 1)
        patch = grey[y0:y1, x0:x1]
        gx, gy = np.meshgrid(np.arange(x0, x1) - cx, np.arange(y0, y1) - cy)
        distance = np.hypot(gx, gy)
        ring = patch[(distance > 1.5 * r) & (distance <= 2.2 * r + 1)]
        inner = patch[distance <= 0.7 * r]
        if ring.size == 0 or inner.size == 0:
            continue
        background[k] = np.median(ring)
        contrast[k] = np.mean(inner) - background[k]
        # all that stands out counts alike up to the mean brightness: side light moves a centroid less when it is cut
        weight = np.where(distance <= 1.5 * r, np.clip(patch - background[k] - 0.3 * contrast[k], 0, contrast[k]), 0)
        total = float(weight.sum())
        if total > 0:
            xy[k] += np.array([(weight * gx).sum(), (weight * gy).sum()]) / total
    return xy, contrast, background
