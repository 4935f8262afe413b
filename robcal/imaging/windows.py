"""Pixels around candidates, gathered into padded arrays of equal width so that all fits of a group run as one."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from robcal.imaging.blobs import Candidates
from robcal.imaging.edge_model import matrix_from_axes, signed_distance

Array = NDArray[np.float64]

_PIXELS_PER_GROUP = 25_000  # a group's Jacobian of some 2 MB stays in the processor's cache
_EVEN_MAX = 250  # pixels kept of the even inside, and of the background; the centre is in the edge


@dataclass(frozen=True)
class Windows:
    """Pixels of n candidates, p each, padded.

    Attributes
    ----------
    index : (n,) rows of the candidates. x, y, value : (n, p). valid : (n, p) bool.
    u, v : (n, p) x and y from the start's centre in units of its radius.
    radius : (n,) geometric mean of the start's semi-axes, px.
    inside : (n, p) bool, well inside the edge. saturated : (n, p) bool.
    """

    index: NDArray[np.int64]
    x: Array
    y: Array
    u: Array
    v: Array
    value: Array
    valid: NDArray[np.bool_]
    radius: Array
    inside: NDArray[np.bool_]
    saturated: NDArray[np.bool_]

    def take(self, chosen: NDArray) -> Windows:
        """The chosen rows."""
        if len(chosen) == len(self.index) and np.array_equal(chosen, np.arange(len(chosen))):
            return self
        return Windows(*(getattr(self, name)[chosen] for name in Windows.__dataclass_fields__))


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
    # groups of nearly equal size waste little padding
    size_class = np.where(half <= 12, half, 12 + np.ceil(np.log(np.maximum(half, 12) / 12.0) / 0.2).astype(int))
    groups: list[Windows] = []
    for cls in np.unique(size_class):
        members = np.flatnonzero(size_class == cls)
        h = int(half[members].max())
        per_group = max(1, _PIXELS_PER_GROUP // (2 * h + 1) ** 2)
        for start in range(0, len(members), per_group):
            chosen = members[start : start + per_group]
            groups.append(_gather(image, candidates, shape, margin, chosen, h, saturation, neighbours))
    return groups


def _gather(
    image: NDArray, candidates: Candidates, shape: Array, margin: Array, chosen: NDArray[np.int64], half: int,
    saturation: float, neighbours: bool,
) -> Windows:  # fmt: skip
    height, width = image.shape
    offset = np.arange(-half, half + 1)
    centre = np.rint(candidates.xy[chosen]).astype(int)
    rows, columns = centre[:, 1, None] + offset, centre[:, 0, None] + offset
    within = ((rows >= 0) & (rows < height))[:, :, None] & ((columns >= 0) & (columns < width))[:, None, :]
    values = image[np.clip(rows, 0, height - 1)[:, :, None], np.clip(columns, 0, width - 1)[:, None, :]].astype(float)
    n, side = len(chosen), len(offset)
    x = np.broadcast_to(columns[:, None, :], (n, side, side)).astype(float)
    y = np.broadcast_to(rows[:, :, None], (n, side, side)).astype(float)
    distance = signed_distance(shape[chosen], x.reshape(n, -1), y.reshape(n, -1)).reshape(n, side, side)
    blur = candidates.blur[chosen][:, None, None]
    valid = within & (distance < margin[chosen][:, None, None])
    if neighbours:
        base, peak = candidates.base[chosen][:, None, None], candidates.peak[chosen][:, None, None]
        other = (values > base + 0.2 * (peak - base)) & (distance > 2.0 * blur + 0.7)
        valid &= ~_dilate(other)
    inside = distance < -(2.5 * blur + 0.5)
    # every k-th row of a large inside or background: neighbours along rows stay, they tell of correlated noise
    for even in (inside, valid & (distance > 2.5 * blur + 0.5)):
        every = np.maximum(1, np.ceil(even.sum(axis=(1, 2)) / _EVEN_MAX)).astype(int)[:, None, None]
        valid &= ~even | (rows[:, :, None] % every == 0)
    order = np.argsort(~valid.reshape(n, -1), axis=1, kind="stable")[:, : max(1, int(valid.sum(axis=(1, 2)).max()))]

    def flat(array: NDArray) -> NDArray:
        return np.take_along_axis(array.reshape(n, -1), order, axis=1)

    px, py, value = flat(x), flat(y), flat(values)
    radius = np.sqrt(np.prod(candidates.semi_axes[chosen], axis=1))
    start = candidates.xy[chosen]
    u, v = (px - start[:, :1]) / radius[:, None], (py - start[:, 1:]) / radius[:, None]
    return Windows(chosen, px, py, u, v, value, flat(valid), radius, flat(inside), value >= saturation)
