"""Pixels around candidates, gathered into padded arrays of equal width so that all fits of a group run as one.

Places count from a pixel near the candidate, so that single precision holds them to a hundred-thousandth of a pixel.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from robcal.imaging.blobs import Candidates
from robcal.imaging.edge_model import matrix_from_axes, signed_distance

Array = NDArray[np.float64]

_PIXELS_PER_GROUP = 32_000  # larger ones leave the processor's cache, smaller ones spend the time on calls
_EVEN_MAX = 250  # pixels kept of the even inside, and of the background; the centre is in the edge


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


def _dilate(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """3x3 dilation over the last two axes."""
    grown = mask.copy()
    grown[:, 1:] |= mask[:, :-1]
    grown[:, :-1] |= mask[:, 1:]
    wide = grown.copy()
    wide[:, :, 1:] |= grown[:, :, :-1]
    wide[:, :, :-1] |= grown[:, :, 1:]
    return wide


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
    height, width = image.shape
    offset = np.arange(-half, half + 1)
    centre = np.rint(candidates.xy[chosen]).astype(int)
    rows, columns = centre[:, 1, None] + offset, centre[:, 0, None] + offset
    within = ((rows >= 0) & (rows < height))[:, :, None] & ((columns >= 0) & (columns < width))[:, None, :]
    places = np.clip(rows, 0, height - 1)[:, :, None] * width + np.clip(columns, 0, width - 1)[:, None, :]
    values = image.ravel().take(places).astype(np.float32)
    n, side = len(chosen), len(offset)
    local = np.concatenate([candidates.xy[chosen] - centre, shape[chosen, 2:]], axis=1)
    place = offset.astype(np.float32)
    x: NDArray = np.broadcast_to(place[None, None, :], (n, side, side)).reshape(n, -1)
    y: NDArray = np.broadcast_to(place[None, :, None], (n, side, side)).reshape(n, -1)
    distance = signed_distance(local, x, y).reshape(n, side, side)
    blur = candidates.blur[chosen].astype(np.float32)[:, None, None]
    valid = within & (distance < margin[chosen].astype(np.float32)[:, None, None])
    if neighbours:
        base, peak = candidates.base[chosen], candidates.peak[chosen]
        bright = (base + 0.2 * (peak - base)).astype(np.float32)[:, None, None]
        other = (values > bright) & (distance > 2.0 * blur + 0.7)
        valid &= ~_dilate(other)
    # every k-th row of a large inside or background: neighbours along rows stay, they show correlated noise
    for even in (distance < -(2.5 * blur + 0.5), valid & (distance > 2.5 * blur + 0.5)):
        every = np.maximum(1, np.ceil(even.sum(axis=(1, 2)) / _EVEN_MAX)).astype(int)[:, None, None]
        if every.max() > 1:
            valid &= ~even | (rows[:, :, None] % every == 0)
    valid = valid.reshape(n, -1)
    # the valid pixels of each window moved to the front, padded with pixels that are not
    width_kept = max(1, int(valid.sum(axis=1).max()))
    order = np.argsort(~valid, axis=1, kind="stable")[:, :width_kept]

    def flat(array: NDArray) -> NDArray:
        return np.take_along_axis(array.reshape(n, -1), order, axis=1)

    px, py, value = flat(x), flat(y), flat(values)
    radius = np.sqrt(np.prod(candidates.semi_axes[chosen], axis=1))
    start = local[:, :2].astype(np.float32)
    scale = (1.0 / radius).astype(np.float32)[:, None]
    u, v = (px - start[:, :1]) * scale, (py - start[:, 1:]) * scale
    return Windows(chosen, centre.astype(float), px, py, u, v, value, flat(valid), radius, value >= saturation)
