"""What a corner of a board has around it: how far its edges go, where markers begin, which sides are dark."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from robcal.columns import Columns
from robcal.imaging.aruco_markers import dictionary_by_name
from robcal.photogrammetry.boards.layout import Board
from robcal.transforms import Array

QUADRANTS = ((-1, -1), (1, -1), (1, 1), (-1, 1))
"""Signs of x and y of the quadrants around a corner, clockwise from the upper left."""


@dataclass(frozen=True)
class Surroundings(Columns):
    """Of n corners; lengths in m along the board's axes.

    Attributes
    ----------
    reach : (n, 4) to the left, right, up, down half way to the next edge. next_edge : (n, 4) all the way.
    depth : (n, 4) how far from both edges the quadrants of :data:`QUADRANTS` are even, infinite without a marker.
    dark : (n, 4) bool, their brightness beside the corner.
    """

    reach: Array
    next_edge: Array
    depth: Array
    dark: NDArray[np.bool_]


def surroundings(board: Board, border_bits: int = 1, legacy: bool = False) -> Surroundings:
    """Of all corners by id; ``border_bits``: dark modules around the code of a tag; ``legacy``: see ``Board``."""
    n = len(board.ids())
    if board.kind == "aprilgrid":
        return _of_tags(board, border_bits)
    square = board.square or 0.0
    fewer = 1 if board.kind == "charuco" else 0
    row, column = np.divmod(np.arange(n), board.columns - fewer)
    # the square at the upper left of corner (0, 0) is dark
    dark = np.empty((n, 4), dtype=bool)
    first = 1 if legacy and board.kind == "charuco" and board.rows % 2 == 0 else 0
    for k, (sx, sy) in enumerate(QUADRANTS):
        dark[:, k] = (row + (sy > 0) + column + (sx > 0)) % 2 == first
    depth = np.full((n, 4), np.inf)
    if board.marker is not None:
        depth[~dark] = 0.5 * (square - board.marker)
    return Surroundings(np.full((n, 4), 0.5 * square), np.full((n, 4), square), depth, dark)


def _of_tags(board: Board, border_bits: int) -> Surroundings:
    marker, gap = board.marker or 0.0, board.spacing or 0.0
    n = len(board.ids())
    tag_side = np.tile([[1, 1], [-1, 1], [-1, -1], [1, -1]], (n // 4, 1))  # where the tag lies from its corner
    next_edge = np.empty((n, 4))
    next_edge[:, 0] = np.where(tag_side[:, 0] < 0, marker, gap)
    next_edge[:, 1] = np.where(tag_side[:, 0] > 0, marker, gap)
    next_edge[:, 2] = np.where(tag_side[:, 1] < 0, marker, gap)
    next_edge[:, 3] = np.where(tag_side[:, 1] > 0, marker, gap)
    modules = dictionary_by_name(board.dictionary or "").markerSize + 2 * border_bits
    dark, depth = np.empty((n, 4), dtype=bool), np.full((n, 4), np.inf)
    for k, (sx, sy) in enumerate(QUADRANTS):
        tag = (tag_side[:, 0] == sx) & (tag_side[:, 1] == sy)
        square = (tag_side[:, 0] == -sx) & (tag_side[:, 1] == -sy)
        dark[:, k] = tag | square
        depth[tag, k] = marker * border_bits / modules
    return Surroundings(0.5 * next_edge, next_edge, depth, dark)
