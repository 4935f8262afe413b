"""What of a printed board or ring code is dark: shapes in m, to be drawn to scale."""

from dataclasses import dataclass

import cv2
import numpy as np

from robcal.imaging.aruco_markers import dictionary_by_name
from robcal.photogrammetry.boards.layout import Board
from robcal.transforms import Array

KALIBR_BORDER = 2
"""Dark modules around the code of an AprilGrid's tag, as Kalibr prints and reads them."""


@dataclass(frozen=True)
class Artwork:
    """Dark shapes in a board's frame: ``boxes`` (n, 4) left top right bottom; ``discs`` (m, 3) centre, radius."""

    boxes: Array
    discs: Array


def board_artwork(board: Board) -> Artwork:
    """The dark parts of a board; those of boxes touch one another but do not overlap.

    Circles without a stated diameter have half their distance.
    """
    if board.has_circles:
        nearest = (board.spacing or 0.0) * (np.sqrt(2.0) if board.kind == "asymmetric_circles" else 1.0)
        radius = 0.5 * (board.diameter or 0.5 * nearest)
        points = board.points()[:, :2]
        return Artwork(np.empty((0, 4)), np.column_stack([points, np.full(len(points), radius)]))
    boxes: list[tuple[float, float, float, float]] = []
    if board.kind == "aprilgrid":
        gap, pitch = board.spacing or 0.0, (board.spacing or 0.0) + (board.marker or 0.0)
        squares = [(i * pitch, j * pitch) for j in range(board.rows + 1) for i in range(board.columns + 1)]
        boxes += [(x, y, x + gap, y + gap) for x, y in squares]
    else:
        more = 1 if board.kind == "chessboard" else 0
        s = board.square or 0.0
        for j in range(board.rows + more):
            boxes += [(i * s, j * s, (i + 1) * s, (j + 1) * s) for i in range(board.columns + more) if (i + j) % 2 == 0]
    border = KALIBR_BORDER if board.kind == "aprilgrid" else 1
    for number, corners in enumerate(board.marker_corners()):
        boxes += _marker(board, number, border, corners[0], corners[2])
    return Artwork(np.array(boxes, dtype=float), np.empty((0, 3)))


def _marker(
    board: Board, number: int, border: int, first: Array, last: Array
) -> list[tuple[float, float, float, float]]:
    """Runs of dark modules of a marker, each run one box."""
    dictionary = dictionary_by_name(board.dictionary or "")
    side = dictionary.markerSize + 2 * border
    dark = cv2.aruco.generateImageMarker(dictionary, number, side, borderBits=border) < 128
    module = (last - first) / side
    boxes = []
    for row in range(side):
        edges = np.flatnonzero(np.diff(np.concatenate([[0], dark[row].astype(int), [0]])))
        for begin, end in edges.reshape(-1, 2).tolist():
            x0, y0 = first + module * (begin, row)
            x1, y1 = first + module * (end, row + 1)
            boxes.append((float(x0), float(y0), float(x1), float(y1)))
    return boxes


def ring_sectors(number: int, segments: int = 12) -> list[tuple[float, float]]:
    """Bright runs of a ring code as (first, last) angle in rad, clockwise from the top, where the first bit begins."""
    bits = [bool(number >> (segments - 1 - k) & 1) for k in range(segments)]
    step = 2.0 * np.pi / segments
    if all(bits):
        return [(0.0, 2.0 * np.pi)]
    runs = []
    for k in range(segments):
        if bits[k] and not bits[k - 1]:
            length = next(n for n in range(1, segments) if not bits[(k + n) % segments])
            runs.append((k * step, (k + length) * step))
    return runs
