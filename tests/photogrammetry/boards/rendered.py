"""Rendered boards for tests: the fixtures' pattern and the library's layout of the same board."""

import numpy as np

from fixtures.board_pattern import BoardPattern
from fixtures.optics import TrueCamera
from fixtures.rigid import Array, frame, rotation
from robcal.photogrammetry.boards.layout import Board

CAMERA = TrueCamera(560, 420, 640.0, 640.0, 281.0, 208.0, k1=-0.1, psf_px=0.7)
PATTERNS = {
    "charuco": BoardPattern("charuco", 6, 5, square=0.03, marker=0.022),
    "chessboard": BoardPattern("chessboard", 7, 6, square=0.025),
    "aprilgrid": BoardPattern(
        "aprilgrid", 4, 3, marker=0.04, spacing=0.012, dictionary="DICT_APRILTAG_36h11", border_bits=2, tag_turns=2
    ),
    "circles": BoardPattern("circles", 7, 5, spacing=0.028, diameter=0.016),
    "asymmetric_circles": BoardPattern("asymmetric_circles", 4, 9, spacing=0.018, diameter=0.015),
}


def layout(pattern: BoardPattern) -> Board:
    """The same board as the library knows it."""
    return Board(
        pattern.kind,  # type: ignore[arg-type]
        pattern.columns,
        pattern.rows,
        square=pattern.square or None,
        marker=pattern.marker or None,
        dictionary=pattern.dictionary if pattern.marker else None,
        spacing=pattern.spacing or None,
        diameter=pattern.diameter or None,
    )


def looking_at(pattern: BoardPattern, distance: float, rpy_deg: tuple[float, float, float]) -> Array:
    """camera_T_board with the middle of the sheet on the optical axis."""
    left, top, right, bottom = pattern.sheet()
    turn = rotation(np.radians(rpy_deg))
    return frame(turn, np.array([0.0, 0.0, distance]) - turn @ [(left + right) / 2, (top + bottom) / 2, 0.0])
