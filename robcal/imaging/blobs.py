"""Shape of single blobs: moments of their pixels, the limits of a dot, the step of grey values across the outline."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from robcal.columns import Columns

Array = NDArray[np.float64]


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
