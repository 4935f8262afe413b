"""Which pixels around a corner show this corner alone, and how its edges run there, from the map of the board.

Windows reach half way to the next corner, so that no pixel serves two of them: errors of corners are independent.
"""

import numpy as np
from numpy.typing import NDArray

from robcal.imaging.corner_fit import CornerWindows
from robcal.photogrammetry.boards.board_map import BoardMap
from robcal.photogrammetry.boards.surroundings import QUADRANTS, Surroundings
from robcal.transforms import Array

_LARGEST = 28.0
"""px; beyond it lines bend by more than the map of the board tells."""
_BLUR = 0.8
_BAND = 6.0
"""px from an edge within which pixels are used."""
_MARGIN = 2.4
"""px from foreign edges: their blur has ended there."""


def corner_windows(
    image: NDArray, xy: Array, board_xy: Array, board_map: BoardMap, around: Surroundings, saturation: float
) -> tuple[CornerWindows, Array]:
    """Windows of n corners and where their fits start.

    Parameters
    ----------
    image : (h, w). xy : (n, 2) px first places. board_xy : (n, 2) m. saturation : grey value from which pixels are
        saturated.

    Returns
    -------
    windows. start : (n, 5) shapes: place from the window's origin, angles of both normals, ln s.
    """
    first, _ = board_map.derivatives(board_xy)
    px_per_m = np.linalg.norm(first, axis=1)  # (n, 2) along both axes
    # a foreign edge keeps its distance; half way to it is enough otherwise
    pixels = px_per_m[:, [0, 0, 1, 1]]
    reach = np.maximum(np.minimum(around.reach, around.next_edge - _MARGIN / pixels), 0.25 * around.reach)
    reach = np.minimum(reach, _LARGEST / pixels)
    half = int(np.ceil(min(_LARGEST, float((reach[:, [0, 2]] + reach[:, [1, 3]]).max(axis=0) @ px_per_m.max(axis=0)))))
    half = max(half, 3)
    origin = np.rint(xy)
    offset = np.arange(-half, half + 1)
    rows, columns = origin[:, 1, None].astype(int) + offset, origin[:, 0, None].astype(int) + offset
    height, width = image.shape
    inside = ((rows >= 0) & (rows < height))[:, :, None] & ((columns >= 0) & (columns < width))[:, None, :]
    value = image[np.clip(rows, 0, height - 1)[:, :, None], np.clip(columns, 0, width - 1)[:, None, :]].astype(float)
    value = value.reshape(len(xy), -1)
    dx = (columns - xy[:, 0, None])[:, None, :] + np.zeros((1, len(offset), 1))
    dy = (rows - xy[:, 1, None])[:, :, None] + np.zeros((1, 1, len(offset)))
    away = np.stack([dx, dy], axis=-1).reshape(len(xy), -1, 2)
    valid = inside.reshape(len(xy), -1) & _own(away, first, reach, around, pixels)
    # the pixels used moved to the front, row by row, padded with pixels that are not
    order = np.argsort(~valid, axis=1, kind="stable")[:, : max(1, int(valid.sum(axis=1).max()))]
    from_origin = away + (xy - origin)[:, None]
    x, y, value, valid = (
        np.take_along_axis(column, order, axis=1) for column in (from_origin[..., 0], from_origin[..., 1], value, valid)
    )
    windows = CornerWindows(origin, x, y, value, valid, value >= saturation, np.zeros((len(xy), 2)), float(half))
    normals = _normals(first)
    angle = np.arctan2(normals[..., 1], normals[..., 0])
    start = np.column_stack([xy - origin, angle, np.full(len(xy), np.log(_BLUR))])
    return windows, start


def edge_curvatures(board_map: BoardMap, board_xy: Array) -> Array:
    """(n, 2) 1/px of the images of the lines along y and along x through places (n, 2) m of the board."""
    first, second = board_map.derivatives(board_xy)
    normals = _normals(first)
    bend = [
        np.einsum("ni,ni->n", normals[:, edge], second[:, :, axis]) / np.sum(first[:, :, axis] ** 2, axis=1)
        for edge, axis in ((0, 1), (1, 0))
    ]
    return np.stack(bend, axis=1)


def _normals(first: Array) -> Array:
    """(n, 2, 2) unit normals of the lines along y (to the side of x) and along x (to the side of y)."""
    along_x, along_y = first[:, :, 0], first[:, :, 1]
    return np.stack([_normal(along_y, along_x), _normal(along_x, along_y)], axis=1)


def _normal(along: Array, towards: Array) -> Array:
    """Unit normals (n, 2) of lines along ``along`` that point to the side of ``towards``."""
    normal = np.stack([-along[:, 1], along[:, 0]], axis=-1) / np.linalg.norm(along, axis=1, keepdims=True)
    return np.asarray(normal * np.sign(np.einsum("ni,ni->n", normal, towards))[:, None])


def _own(away: Array, first: Array, reach: Array, around: Surroundings, pixels: Array) -> NDArray[np.bool_]:
    """(n, p) pixels, ``away`` (n, p, 2) px from the corners, that show nothing but the two edges."""
    q = np.einsum("nij,npj->npi", np.linalg.inv(first), away)
    valid = (q[..., 0] > -reach[:, 0, None]) & (q[..., 0] < reach[:, 1, None])
    valid &= (q[..., 1] > -reach[:, 2, None]) & (q[..., 1] < reach[:, 3, None])
    valid &= np.abs(away).max(axis=2) <= _LARGEST
    # far from both edges is nothing that tells of the corner
    valid &= (np.abs(q) * pixels[:, None, ::2]).min(axis=2) < _BAND
    for k, (sx, sy) in enumerate(QUADRANTS):
        deep_x = around.depth[:, k] - _MARGIN / pixels[:, 0]
        deep_y = around.depth[:, k] - _MARGIN / pixels[:, 2]
        valid &= ~((sx * q[..., 0] > deep_x[:, None]) & (sy * q[..., 1] > deep_y[:, None]))
    return valid
