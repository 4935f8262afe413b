"""Numbering of a grid that was found as a whole: turned and mirrored so that it is the board, or refused.

A board that looks the same when turned (``Board.turns`` > 1) has several numberings; the one whose x axis points most
to the right in the image is taken.
"""

import cv2
import numpy as np
from numpy.typing import NDArray

from robcal.photogrammetry.boards.layout import Board
from robcal.transforms import Array

_FIT = 0.25
"""RMS of a homography through the grid by the distance of neighbours; strong distortion stays below."""


def oriented(board: Board, xy: Array, grey: NDArray[np.uint8] | None) -> tuple[Array | None, str]:
    """Places (n, 2) px in the order of the ids, or None with the reason.

    Parameters
    ----------
    xy : (n, 2) of all marks in the order of rows and columns, from any corner of the board. grey : 8-bit image that
        tells dark squares from bright ones; None for circles.
    """
    points = board.points()[:, :2]
    colours_tell = board.kind == "chessboard" and (
        board.turns == 1 or (board.turns == 2 and board.columns == board.rows)
    )
    pitch = _pitch(xy.reshape(board.rows, board.columns, 2))
    fitting: list[tuple[float, Array]] = []
    for turned in _arrangements(xy.reshape(board.rows, board.columns, 2)):
        places = turned.reshape(-1, 2)
        homography, _ = cv2.findHomography(points, places, 0)
        # seen from the front: x to y turns clockwise, which in the image (y down) is a positive determinant
        if homography is None or _determinant(np.asarray(homography, dtype=float), points.mean(axis=0)) <= 0:
            continue
        flat = cv2.perspectiveTransform(points[None].astype(np.float64), homography)[0]
        if np.sqrt(np.mean((flat - places) ** 2)) > _FIT * pitch:
            continue
        if colours_tell and not _first_is_dark(turned, grey):
            continue
        ahead = turned[:, -1].mean(axis=0) - turned[:, 0].mean(axis=0)
        fitting.append((float(ahead[0] / np.linalg.norm(ahead)), places))
    if not fitting:
        return (
            None,
            f"a grid of {board.columns} x {board.rows} marks was found that is not this board (mirrored? bent?)",
        )
    return max(fitting, key=lambda item: item[0])[1], ""


def _pitch(grid: Array) -> float:
    steps = [np.linalg.norm(np.diff(grid, axis=axis), axis=-1).ravel() for axis in (0, 1)]
    return float(np.median(np.concatenate(steps)))


def _arrangements(grid: Array) -> list[Array]:
    """The grid (rows, columns, 2) turned and mirrored in all ways that keep its shape."""
    quarter = (0, 1, 2, 3) if grid.shape[0] == grid.shape[1] else (0, 2)
    return [np.rot90(side, k) for side in (grid, grid[:, ::-1]) for k in quarter]


def _determinant(homography: Array, at: Array) -> float:
    """Of the derivative of a homography at a place, up to a positive factor."""
    w = float(homography[2] @ [*at, 1.0])
    return float(np.linalg.det(homography) / (w**3 if w != 0 else 1e-12))


def _first_is_dark(grid: Array, grey: NDArray[np.uint8] | None) -> bool:
    """Whether the squares that should be dark, as the one in the upper left, are darker than the others."""
    if grey is None:
        return True
    middle = 0.25 * (grid[1:, 1:] + grid[1:, :-1] + grid[:-1, 1:] + grid[:-1, :-1])
    column = np.clip(np.rint(middle[..., 0]).astype(int), 0, grey.shape[1] - 1)
    row = np.clip(np.rint(middle[..., 1]).astype(int), 0, grey.shape[0] - 1)
    value = grey[row, column].astype(float)
    i, j = np.indices(value.shape)
    same = (i + j) % 2 == 0  # as the first inner square, which has the colour of the upper left one
    return bool(value[same].mean() < value[~same].mean())
