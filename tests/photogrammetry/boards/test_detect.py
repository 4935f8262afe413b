"""Boards in rendered images: every id right, errors as large as their covariance says, what is covered is left out."""

from dataclasses import replace

import numpy as np
import pytest

from fixtures.board_scene import BoardImage, BoardLight, render_board
from fixtures.optics import Sensor
from robcal.imaging.detections import Detections, Reason
from robcal.photogrammetry.boards.detect import find_board
from robcal.photogrammetry.core.camera import Camera
from robcal.photogrammetry.core.eccentricity import centre_shift
from tests.photogrammetry.boards.rendered import CAMERA, PATTERNS, layout, looking_at

pytestmark = pytest.mark.unit
_VIEW = (22.0, -14.0, 8.0)


def _errors(found: Detections, image: BoardImage) -> np.ndarray:
    return found.xy - image.xy[found.code]


@pytest.mark.parametrize("kind", ["charuco", "chessboard", "aprilgrid"])
def test_corners_are_identified_to_hundredths_of_a_pixel(kind: str) -> None:
    pattern = PATTERNS[kind]
    image = render_board(pattern, CAMERA, looking_at(pattern, 0.5, _VIEW), BoardLight(gradient=(0.3, 0.2)), seed=1)
    found = find_board(image.image, layout(pattern))
    assert sorted(found.code) == np.flatnonzero(image.visible).tolist()
    error = _errors(found, image)
    # pixel (0, 0) is the centre of the upper left one: a convention off by half a pixel would be a hundred sigma
    assert np.abs(error.mean(axis=0)).max() < 0.003
    assert np.abs(error).max() < 0.03
    nees = np.einsum("ni,nij,nj->n", error, np.linalg.inv(found.covariance), error).mean() / 2
    assert 0.45 < nees < 1.7


@pytest.mark.parametrize("kind", ["circles", "asymmetric_circles"])
def test_circles_are_identified_and_their_eccentricity_is_known(kind: str) -> None:
    pattern = PATTERNS[kind]
    pose = looking_at(pattern, 0.5, _VIEW)
    image = render_board(pattern, CAMERA, pose, seed=2)
    board = layout(pattern)
    found = find_board(image.image, board)
    assert sorted(found.code) == np.flatnonzero(image.visible).tolist()
    error = _errors(found, image)
    body = board.body()
    camera = Camera(CAMERA.width, CAMERA.height, CAMERA.fx, CAMERA.fy, CAMERA.cx, CAMERA.cy, CAMERA.k1)
    centre = body.points[found.code] @ pose[:3, :3].T + pose[:3, 3]
    normal = np.tile(pose[:3, :3] @ [0.0, 0.0, -1.0], (len(centre), 1))
    error -= centre_shift(camera, centre, normal, 0.5 * body.diameters[found.code])
    assert np.abs(error.mean(axis=0)).max() < 0.003
    nees = np.einsum("ni,nij,nj->n", error, np.linalg.inv(found.covariance), error).mean() / 2
    assert 0.45 < nees < 1.7


@pytest.mark.parametrize("kind", ["charuco", "aprilgrid"])
def test_a_board_with_markers_is_found_in_part(kind: str) -> None:
    pattern = PATTERNS[kind]
    cover = np.array([[300.0, -10.0], [650.0, -10.0], [650.0, 250.0], [340.0, 250.0]])
    image = render_board(pattern, CAMERA, looking_at(pattern, 0.5, _VIEW), BoardLight(covers=(cover,)), seed=3)
    found = find_board(image.image, layout(pattern))
    assert 8 <= len(found) < len(image.xy)
    assert image.visible[found.code].all()
    assert np.abs(_errors(found, image)).max() < 0.05


@pytest.mark.parametrize("kind", ["chessboard", "circles"])
def test_a_board_without_markers_is_refused_in_part(kind: str) -> None:
    pattern = PATTERNS[kind]
    cover = np.array([[330.0, -10.0], [650.0, -10.0], [650.0, 490.0], [330.0, 490.0]])
    image = render_board(pattern, CAMERA, looking_at(pattern, 0.5, _VIEW), BoardLight(covers=(cover,)), seed=3)
    found = find_board(image.image, layout(pattern))
    assert len(found) == 0
    assert "whole" in found.message


@pytest.mark.parametrize("roll", [100.0, 190.0])
@pytest.mark.parametrize("kind", ["chessboard", "asymmetric_circles"])
def test_an_unsymmetric_board_keeps_its_numbers_when_turned(kind: str, roll: float) -> None:
    pattern = PATTERNS[kind]
    assert layout(pattern).turns == 1
    image = render_board(pattern, CAMERA, looking_at(pattern, 0.6, (15.0, 10.0, roll)), seed=4)
    found = find_board(image.image, layout(pattern))
    assert len(found) == len(image.xy)
    assert np.abs(_errors(found, image)).max() < 0.3


@pytest.mark.parametrize(("roll", "turned"), [(20.0, False), (200.0, True)])
def test_a_symmetric_board_is_numbered_from_the_left(roll: float, turned: bool) -> None:
    pattern = replace(PATTERNS["chessboard"], columns=7, rows=5)
    assert layout(pattern).turns == 2
    image = render_board(pattern, CAMERA, looking_at(pattern, 0.5, (10.0, 5.0, roll)), seed=5)
    found = find_board(image.image, layout(pattern))
    ids = len(image.xy) - 1 - found.code if turned else found.code
    assert np.abs(found.xy - image.xy[ids]).max() < 0.1


def test_old_pattern_of_a_charuco_board_is_recognised() -> None:
    pattern = replace(PATTERNS["charuco"], columns=6, rows=4, legacy=True)
    image = render_board(pattern, CAMERA, looking_at(pattern, 0.5, _VIEW), seed=6)
    found = find_board(image.image, layout(pattern))
    assert len(found) == len(image.xy)
    assert np.abs(_errors(found, image)).max() < 0.05


def test_sixteen_bits() -> None:
    pattern = PATTERNS["charuco"]
    camera = replace(CAMERA, sensor=Sensor(bits=16))
    image = render_board(pattern, camera, looking_at(pattern, 0.5, _VIEW), seed=7)
    found = find_board(image.image, layout(pattern))
    assert len(found) == len(image.xy)
    assert np.abs(_errors(found, image)).max() < 0.03


def test_another_board_and_no_board_say_why() -> None:
    pattern = PATTERNS["charuco"]
    image = render_board(pattern, CAMERA, looking_at(pattern, 0.5, _VIEW), seed=8).image
    other = find_board(image, replace(layout(pattern), dictionary="DICT_5X5_100"))
    assert len(other) == 0
    assert "dictionary" in other.message
    assert "no chessboard" in find_board(image[200:280, 200:300], layout(PATTERNS["chessboard"])).message
    empty = find_board(np.full((200, 300), 128, np.uint8), layout(PATTERNS["circles"]))
    assert len(empty) == 0
    assert empty.message


def test_half_a_corner_under_a_reflection_is_refused() -> None:
    pattern = PATTERNS["charuco"]
    pose = looking_at(pattern, 0.5, _VIEW)
    bare = render_board(pattern, CAMERA, pose, seed=9)
    x, y = bare.xy[7]
    cover = np.array([[x - 3, y - 20], [x + 20, y - 20], [x + 20, y + 20], [x + 2, y + 20]])
    image = render_board(pattern, CAMERA, pose, BoardLight(covers=(cover,)), seed=9)
    found = find_board(image.image, layout(pattern))
    assert 7 not in found.code
    assert set(found.rejected.counts) & {Reason.CORNER, Reason.OFF_BOARD}
    assert np.abs(_errors(found, image)).max() < 0.05
