"""Shape of single blobs: moments of their pixels, the limits of a dot, the step of grey values across the outline."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from robcal.columns import Columns
from robcal.imaging.detections import Reason
from robcal.imaging.settings import DetectionSettings

Array = NDArray[np.float64]


_ROUGH_PIXELS = 40_000  # pixels of a part that are enough to estimate its noise


@dataclass(frozen=True)
class Candidates(Columns):
    """Blobs that may be dots, n of them, from moments of their pixels: a start for the fit.

    Attributes
    ----------
    xy : (n, 2). semi_axes : (n, 2) major first. angle : (n,) rad. base, peak : (n,) grey values. blur : (n,) px.
    nodes_exhausted : the image had more structure than is looked at.
    """

    xy: Array
    semi_axes: Array
    angle: Array
    base: Array
    peak: Array
    blur: Array
    nodes_exhausted: bool = False

    def __len__(self) -> int:
        return len(self.xy)


def judge(
    mask: NDArray[np.uint8],
    crop: NDArray,
    area: int,
    level: float,
    base: float,
    corner: tuple[int, int],
    shape: tuple[int, ...],
    settings: DetectionSettings,
    found: list[tuple[float, ...]],
) -> Reason | None:
    """None and an entry in `found` if the blob may be a dot, else why not."""
    height, width = mask.shape
    x, y = corner
    if max(width, height) > 2.2 * settings.max_axis_px + 2.0:
        return Reason.TOO_LARGE
    moments = cv2.moments(mask, binaryImage=True)
    cx, cy = moments["m10"] / area, moments["m01"] / area
    # a pixel is an area: 1/12 belongs to the second moments
    sxx, syy = moments["mu20"] / area + 1 / 12, moments["mu02"] / area + 1 / 12
    sxy = moments["mu11"] / area
    mean, radius = 0.5 * (sxx + syy), float(np.hypot(0.5 * (sxx - syy), sxy))
    major, minor = 2.0 * np.sqrt(mean + radius), 2.0 * np.sqrt(max(mean - radius, 1e-6))
    fill = area / (np.pi * major * minor)
    if minor < 0.6 * settings.min_axis_px:
        return Reason.TOO_SMALL if area < 9 else Reason.ELONGATED
    if major > 1.15 * settings.max_axis_px + 1.0:
        return Reason.TOO_LARGE
    if minor < 0.8 * settings.min_axis_ratio * major:
        return Reason.ELONGATED
    # filled ellipses have 1; half rings, crosses, squares with holes have less. Few pixels scatter
    if abs(fill - 1.0) > 0.08 + 0.9 / np.sqrt(area):
        return Reason.SHAPE
    if x <= 1 or y <= 1 or x + width >= shape[1] - 1 or y + height >= shape[0] - 1:
        return Reason.BORDER
    values = crop[mask > 0]
    peak = float(values.max())
    high = int(np.count_nonzero(values > 0.5 * (level + peak)))
    # between the levels 1/2 and 3/4 lie 0.674 sigma of a blurred edge, along the perimeter
    blur = (area - high) / (0.674 * 2.0 * np.pi * np.sqrt(0.5 * (major**2 + minor**2)))
    angle = 0.5 * np.arctan2(2.0 * sxy, sxx - syy)
    found.append(
        (x + cx, y + cy, major, minor, float(angle), base, peak, float(np.clip(blur, 0.35, 0.5 * minor + 0.5)))
    )
    return None


def rough_sigma(crop: NDArray, mask: NDArray[np.uint8]) -> float:
    """Noise inside a large node, by the median of second differences along rows."""
    every = 1 + crop.size // _ROUGH_PIXELS
    values, mask = crop[::every].astype(np.float32), mask[::every]
    second = values[:, 2:] - 2.0 * values[:, 1:-1] + values[:, :-2]
    inside = (mask[:, 2:] > 0) & (mask[:, :-2] > 0)
    if np.count_nonzero(inside) < 50:
        return 0.0
    # mean of the smaller half of |z| is 0.319 sigma; unlike the median it is not quantised
    size = np.abs(second[inside])
    return float(np.partition(size, size.size // 2)[: size.size // 2].mean() / (0.319 * np.sqrt(6.0)))


def step_all_around(image: NDArray, candidates: Candidates) -> tuple[Array, NDArray[np.bool_]]:
    """Step of grey values across the outline, (n,), and whether it is there in nearly every direction and about equal.

    A cheap test before the fit: parts of textures, corners and arcs fail it, dots beside others do not. The step is
    the median over all directions: the surroundings of a blob determine its contrast better than the coarse
    background does.
    """
    n = len(candidates)
    if n == 0:
        return np.zeros(0), np.zeros(0, bool)
    height, width = image.shape
    phi = np.arange(24) * (2.0 * np.pi / 24)
    c, s = np.cos(candidates.angle)[:, None], np.sin(candidates.angle)[:, None]
    a, b = candidates.semi_axes[:, :1], candidates.semi_axes[:, 1:]
    # outline, and its normal
    ex, ey = a * np.cos(phi), b * np.sin(phi)
    nx, ny = np.cos(phi) / a, np.sin(phi) / b
    length = np.hypot(nx, ny)
    reach = np.minimum(1.5 * candidates.blur + 1.0, 0.7 * b[:, 0])[:, None]
    out = np.minimum(1.5 * candidates.blur[:, None] + 1.0, 0.55 * b + 0.8)
    values = []
    for distance in (-reach, out):
        ux, uy = ex + distance * nx / length, ey + distance * ny / length
        x = np.clip(np.rint(candidates.xy[:, :1] + c * ux - s * uy), 0, width - 1).astype(int)
        y = np.clip(np.rint(candidates.xy[:, 1:] + s * ux + c * uy), 0, height - 1).astype(int)
        values.append(image[y, x].astype(float))
    inner, outer = values
    step = inner - outer
    typical = np.median(step, axis=1)
    low = np.sort(step, axis=1)[:, 3]
    # in blobs of two pixels the nearest pixel stands for too much
    tiny = candidates.semi_axes[:, 1] < 1.5
    low = np.where(tiny, typical, low)
    even = np.median(np.abs(step - typical[:, None]), axis=1) < 0.35 * typical
    return typical, (typical > 0) & (low > 0.15 * typical) & even
