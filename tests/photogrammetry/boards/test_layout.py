"""Layout of boards: ids and coordinates as documented, impossible ones refused, body files of them."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from robcal.errors import InvalidInput
from robcal.files.body_file import body_from_file, read_body, write_body
from robcal.photogrammetry.boards.layout import Board
from robcal.photogrammetry.core.bodies import Body

pytestmark = pytest.mark.unit


def test_charuco_corners_are_in_opencvs_order() -> None:
    board = Board("charuco", 7, 5, square=0.03, marker=0.022, dictionary="DICT_4X4_50")
    theirs = cv2.aruco.CharucoBoard((7, 5), 0.03, 0.022, cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50))
    np.testing.assert_allclose(board.points(), theirs.getChessboardCorners(), atol=1e-7)
    np.testing.assert_allclose(board.marker_corners(), np.array(theirs.getObjPoints())[..., :2], atol=1e-7)
    theirs.setLegacyPattern(True)
    np.testing.assert_allclose(board.marker_corners(legacy=True), np.array(theirs.getObjPoints())[..., :2], atol=1e-7)


def test_legacy_charuco_of_an_even_number_of_rows() -> None:
    theirs = cv2.aruco.CharucoBoard((5, 4), 0.03, 0.02, cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50))
    theirs.setLegacyPattern(True)
    board = Board("charuco", 5, 4, square=0.03, marker=0.02, dictionary="DICT_4X4_50")
    np.testing.assert_allclose(board.marker_corners(legacy=True), np.array(theirs.getObjPoints())[..., :2], atol=1e-7)


def test_first_and_last_target_of_each_kind() -> None:
    chess = Board("chessboard", 9, 6, square=0.025).points()
    assert chess[0].tolist() == [0.025, 0.025, 0.0]
    np.testing.assert_allclose(chess[-1], [9 * 0.025, 6 * 0.025, 0.0])
    np.testing.assert_allclose(chess[1] - chess[0], [0.025, 0.0, 0.0])
    circles = Board("circles", 7, 6, spacing=0.02, diameter=0.01).points()
    assert circles[0].tolist() == [0.0, 0.0, 0.0]
    np.testing.assert_allclose(circles[7], [0.0, 0.02, 0.0])
    uneven = Board("asymmetric_circles", 4, 11, spacing=0.02).points()
    np.testing.assert_allclose(uneven[[1, 4, 43]], [[0.04, 0, 0], [0.02, 0.02, 0], [0.12, 0.2, 0]], atol=1e-12)


def test_tags_of_an_aprilgrid_count_from_the_lower_left() -> None:
    board = Board("aprilgrid", 6, 4, marker=0.088, spacing=0.0264)
    points = board.points()
    assert board.dictionary == "DICT_APRILTAG_36h11"
    assert len(points) == 4 * 24
    pitch = 0.088 + 0.0264
    np.testing.assert_allclose(points[0], [0.0264, 0.0264 + 3 * pitch, 0.0])
    np.testing.assert_allclose(points[1:4] - points[0], [[0.088, 0, 0], [0.088, 0.088, 0], [0, 0.088, 0]], atol=1e-12)
    np.testing.assert_allclose(points[4] - points[0], [pitch, 0, 0], atol=1e-12)
    np.testing.assert_allclose(points[4 * 18], [0.0264, 0.0264, 0.0], atol=1e-12)
    np.testing.assert_allclose(board.size, [6 * pitch + 0.0264, 4 * pitch + 0.0264])


@pytest.mark.parametrize(
    ("board", "turns"),
    [
        (Board("chessboard", 9, 6, square=0.02), 1),
        (Board("chessboard", 8, 6, square=0.02), 2),
        (Board("chessboard", 7, 7, square=0.02), 2),
        (Board("chessboard", 6, 6, square=0.02), 4),
        (Board("circles", 7, 6, spacing=0.02), 2),
        (Board("circles", 5, 5, spacing=0.02), 4),
        (Board("asymmetric_circles", 4, 11, spacing=0.02), 1),
        (Board("asymmetric_circles", 4, 10, spacing=0.02), 2),
    ],
)
def test_symmetry_is_that_of_the_picture(board: Board, turns: int) -> None:
    assert board.turns == turns
    half = board.points()[:, :2] - board.points()[:, :2].mean(axis=0)
    if board.has_circles:
        same = np.linalg.norm(half[:, None] + half[None], axis=2).min(axis=1) < 1e-9
        assert same.all() == (turns > 1)


def _write(path: Path, text: str) -> Path:
    path.write_text(f"format: robcal/body-1\n{text}")
    return path


def test_body_file_of_a_board(tmp_path: Path) -> None:
    path = _write(tmp_path / "b.yaml", "board: {kind: circles, columns: 7, rows: 6, spacing_mm: 20, diameter_mm: 12}\n")
    file = read_body(path)
    body = body_from_file("board", file)
    assert file.board == Board("circles", 7, 6, spacing=0.02, diameter=0.012)
    assert body.polarity == "dark"
    assert body.codes == ("circle",) * 42
    np.testing.assert_allclose(body.diameters, 0.012)
    np.testing.assert_allclose(body.points[8], [0.02, 0.02, 0.0])


def test_surveyed_coordinates_stand_beside_the_layout(tmp_path: Path) -> None:
    board = Board("charuco", 4, 3, square=0.03, marker=0.02, dictionary="DICT_4X4_50")
    points = board.points() + 1e-4
    body = Body("b", board.ids(), points, 1e-12 * np.eye(18), polarity="dark")
    write_body(tmp_path / "s.yaml", body, board=board)
    again = read_body(tmp_path / "s.yaml")
    assert again.board == board
    np.testing.assert_allclose(body_from_file("b", again).points, points, atol=1e-12)


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("board: {kind: chessboard, columns: 9, rows: 6}", "needs 'square_mm'"),
        ("board: {kind: chessboard, columns: 9, rows: 6, square_mm: 25, spacing_mm: 3}", "has no 'spacing_mm'"),
        ("board: {kind: chessboard, columns: 2, rows: 6, square_mm: 25}", "3 to 500"),
        ("board: {kind: checkers, columns: 9, rows: 6, square_mm: 25}", "must be 'charuco'"),
        ("board: {kind: charuco, columns: 9, rows: 6, square_mm: 25, marker_mm: 18, dictionary: 4X4_9}", "is unknown"),
        ("board: {kind: charuco, columns: 9, rows: 6, square_mm: 25, marker_mm: 25, dictionary: 4X4_50}", "not fit"),
        ("board: {kind: charuco, columns: 11, rows: 10, square_mm: 25, marker_mm: 18, dictionary: 4X4_50}", "has 50"),
        ("board: {kind: circles, columns: 9, rows: 6, spacing_mm: 20, diameter_mm: 20}", "touch"),
        ("board: {kind: circles, columns: 9, rows: 6, spacing: 20}", "did you mean 'spacing_mm'"),
        ("board: {kind: circles, columns: 9, rows: 6, spacing_mm: -20}", "larger than zero"),
        ("board: {kind: circles, columns: 2, rows: 2, spacing_mm: 9}\ntargets: [{id: 4, xyz_mm: [0, 0, 0]}]", "0 to 3"),
        ("polarity: dark", "or a 'board'"),
    ],
)
def test_impossible_boards_are_told_in_one_sentence(tmp_path: Path, text: str, told: str) -> None:
    with pytest.raises(InvalidInput) as error:
        read_body(_write(tmp_path / "b.yaml", text))
    message = str(error.value)
    assert told in message
    assert "b.yaml" in message
    assert "\n" not in message
