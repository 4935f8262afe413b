"""Which marks of a board an image shows, and about where: OpenCV's detectors, made unambiguous and checked.

Boards with markers may be seen in part; a chessboard or a grid of circles is found as a whole or not at all.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from robcal.photogrammetry.boards.layout import Board
from robcal.photogrammetry.boards.marker_places import MarkerReading, corners_from_markers, read_markers
from robcal.photogrammetry.boards.whole_grid import oriented
from robcal.transforms import Array

Grey = NDArray[np.uint8]
_LARGE = 1600
"""Longer sides are reduced to this many pixels before a chessboard is searched: the search is for places only."""


@dataclass(frozen=True)
class FirstPlaces:
    """Marks of one image: ``ids`` (n,), ``xy`` (n, 2) px good to a pixel or so, ``reason`` if there are none.

    ``border_bits``, ``legacy``: which variant of the board was seen.
    """

    ids: NDArray[np.int64]
    xy: Array
    reason: str = ""
    border_bits: int = 1
    legacy: bool = False


def none_found(reason: str) -> FirstPlaces:
    """Nothing, with the reason."""
    return FirstPlaces(np.empty(0, np.int64), np.empty((0, 2)), reason)


def find_corners(grey: Grey, board: Board) -> FirstPlaces:
    """Corners of a board of squares or tags in an 8-bit image (h, w)."""
    return _chessboard(grey, board) if board.kind == "chessboard" else _marker_board(grey, board)


def _chessboard(grey: Grey, board: Board) -> FirstPlaces:
    factor = min(1.0, _LARGE / max(grey.shape))
    small = grey if factor == 1.0 else cv2.resize(grey, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA)
    size = (board.columns, board.rows)
    corners = None
    for flags in (cv2.CALIB_CB_NORMALIZE_IMAGE, cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_EXHAUSTIVE):
        found, corners = cv2.findChessboardCornersSB(small, size, flags=flags)
        if found:
            break
    else:
        flags = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE
        found, corners = cv2.findChessboardCorners(small, size, flags=flags)
    if not found or corners is None:
        return none_found(
            f"no chessboard of {board.columns} x {board.rows} inner corners: it must be seen as a whole, with a white "
            "margin around it"
        )
    # centres of pixels count from (0, 0): reducing by a factor moves them by half a pixel
    xy = (np.asarray(corners, dtype=float).reshape(-1, 2) + 0.5) / factor - 0.5
    places, reason = oriented(board, xy, grey)
    return none_found(reason) if places is None else FirstPlaces(board.ids(), places)


def _marker_board(grey: Grey, board: Board) -> FirstPlaces:
    variants = (2, 1) if board.kind == "aprilgrid" else (1,)
    best = MarkerReading.none()
    for border_bits in variants:
        reading = read_markers(grey, board, border_bits)
        if len(reading.ids) > len(best.ids):
            best = reading
    if len(best.ids) < 2:
        return none_found(
            f"no two neighbouring markers of the {board.kind} board (dictionary {board.dictionary}) were read: check "
            "dictionary, marker ids and sharpness"
        )
    ids, xy = corners_from_markers(board, best)
    return FirstPlaces(ids, xy, "", best.border_bits, best.legacy)
