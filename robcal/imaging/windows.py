"""Pixels around candidates, gathered into padded arrays of equal width so that all fits of a group run as one.

Places count from a pixel near the candidate, so that single precision holds them to a hundred-thousandth of a pixel.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from robcal.imaging.blobs import Candidates
from robcal.imaging.edge_model import matrix_from_axes

Array = NDArray[np.float64]

_PIXELS_PER_GROUP = 32_000  # larger ones leave the processor's cache, smaller ones spend the time on calls


@dataclass(frozen=True)
class Windows:
    """Pixels of n candidates, p each, padded.

    Attributes
    ----------
    index : (n,) rows of the candidates. origin : (n, 2) pixel of the image from which places count.
    x, y, value : (n, p) place from the origin, px, and grey value, single precision. valid : (n, p) bool.
    u, v : (n, p) x and y from the start's centre in units of its radius.
    radius : (n,) geometric mean of the start's semi-axes, px. saturated : (n, p) bool.
    """

    index: NDArray[np.int64]
    origin: Array
    x: Array
    y: Array
    u: Array
    v: Array
    value: Array
    valid: NDArray[np.bool_]
    radius: Array
    saturated: NDArray[np.bool_]

    def select(self, chosen: NDArray) -> "Windows":
        """The chosen rows."""
        if len(chosen) == len(self.index) and np.array_equal(chosen, np.arange(len(chosen))):
            return self
        return Windows(*(getattr(self, name)[chosen] for name in Windows.__dataclass_fields__))

    @property
    def censored(self) -> bool:
        """Whether any pixel is saturated."""
        return bool(self.saturated.any())

    def double(self) -> "Windows":
        """The same in double precision."""
        wide = {name: getattr(self, name).astype(np.float64) for name in ("x", "y", "u", "v", "value")}
        return replace(self, **wide)


def gather_windows(image: NDArray, candidates: Candidates, saturation: float, neighbours: bool = True) -> list[Windows]:
    """Windows of all candidates in groups of similar size.

    Parameters
    ----------
    image : (h, w). candidates : starts. saturation : grey value from which a pixel is saturated.
    neighbours : leave out the pixels of other bright things (with a border of one pixel).
    """
    n = len(candidates)
    if n == 0:
        return []
    matrix = matrix_from_axes(candidates.semi_axes, candidates.angle)
    shape = np.column_stack([candidates.xy, matrix, np.log(np.maximum(candidates.blur, 0.3))])
    margin = 3.0 * candidates.blur + 1.5
    # half extents of the ellipse along x and y
    c2, s2 = np.cos(candidates.angle) ** 2, np.sin(candidates.angle) ** 2
    a2, b2 = candidates.semi_axes[:, 0] ** 2, candidates.semi_axes[:, 1] ** 2
    extent = np.sqrt(np.maximum(a2 * c2 + b2 * s2, a2 * s2 + b2 * c2))
    half = np.ceil(extent + margin).astype(int)
    return [
        _gather(image, candidates, shape, margin, members, int(half[members].max()), saturation, neighbours)
        for members in _groups(half)
    ]


def _groups(half: NDArray[np.int64]) -> list[NDArray[np.int64]]:
    """Windows of half sides (n,) in groups of nearly equal size (little padding) that are large enough to pay."""
    groups: list[NDArray[np.int64]] = []
    order = np.argsort(half, kind="stable")
    begin = 0
    for end in range(1, len(order) + 1):
        if end < len(order):
            pixels = (end + 1 - begin) * (2 * int(half[order[end]]) + 1) ** 2
            padded = half[order[end]] > 1.15 * half[order[begin]] + 0.5 and pixels > _PIXELS_PER_GROUP // 4
            if pixels <= _PIXELS_PER_GROUP and not padded:
                continue
        groups.append(order[begin:end])
        begin = end
    return groups


def _gather(
    image: NDArray,
    candidates: Candidates,
    shape: Array,
    margin: Array,
    chosen: NDArray[np.int64],
    half: int,
    saturation: float,
    neighbours: bool,
) -> Windows:
    from robcal.imaging.window_loop import gather_pixels  # compiled: imported where it runs

    n, side = len(chosen), 2 * half + 1
    centre = np.rint(candidates.xy[chosen]).astype(int)
    local = np.concatenate([candidates.xy[chosen] - centre, shape[chosen, 2:]], axis=1)
    base, peak = candidates.base[chosen], candidates.peak[chosen]
    scales = np.stack([candidates.blur[chosen], margin[chosen], base + 0.2 * (peak - base)], axis=1)
    every: list[NDArray] = [np.zeros((n, side * side), np.float32) for _ in range(3)]
    counts = gather_pixels(image, centre - half, local, scales, half, neighbours, *every)
    # padded with pixels that are not valid
    width_kept = max(1, int(counts.max()))
    x, y, value = (np.ascontiguousarray(column[:, :width_kept]) for column in every)
    valid = np.arange(width_kept) < counts[:, None]
    radius = np.sqrt(np.prod(candidates.semi_axes[chosen], axis=1))
    start = local[:, :2].astype(np.float32)
    scale = (1.0 / radius).astype(np.float32)[:, None]
    u, v = (x - start[:, :1]) * scale, (y - start[:, 1:]) * scale
    return Windows(chosen, centre.astype(float), x, y, u, v, value, valid, radius, valid & (value >= saturation))
