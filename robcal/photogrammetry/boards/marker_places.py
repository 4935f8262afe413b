"""Square markers of a ChArUco board or AprilGrid: read, checked against one another, and what corners they predict.

A marker counts only if another one lies where the first expects it; so a misread one identifies nothing. How tags were
turned when they were printed, and which pattern of a ChArUco board was used, the arrangement of the markers tells.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from robcal.imaging.aruco_markers import dictionary_by_name
from robcal.photogrammetry.boards.layout import Board
from robcal.transforms import Array

_NEAR = 2.3
"""Markers within so many pitches predict one another."""
_OFF = 0.35
"""Largest error of such a prediction by the marker's side and pitch of distance."""
_DISAGREE = 0.15
"""Largest difference of two markers' predictions of a corner, by the marker's side."""
_GROWN = (0, 3, 5)
"""Pixels by which bright areas are grown: it parts tags from the dark squares that touch them."""


@dataclass(frozen=True)
class MarkerReading:
    """Checked markers of an image.

    Attributes
    ----------
    ids : (m,). corners : (m, 4, 2) px. board_corners : (m, 4, 2) m, in the same order.
    border_bits : dark modules around the codes. legacy : pattern of a ChArUco board.
    """

    ids: NDArray[np.int64]
    corners: Array
    board_corners: Array
    border_bits: int = 1
    legacy: bool = False

    @classmethod
    def none(cls) -> "MarkerReading":
        """Nothing read."""
        return cls(np.empty(0, np.int64), np.empty((0, 4, 2)), np.empty((0, 4, 2)))


def read_markers(grey: NDArray[np.uint8], board: Board, border_bits: int) -> MarkerReading:
    """The largest set of markers in an 8-bit image (h, w) that agree where the board is."""
    parameters = cv2.aruco.DetectorParameters()
    parameters.markerBorderBits = border_bits
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_NONE
    detector = cv2.aruco.ArucoDetector(dictionary_by_name(board.dictionary or ""), parameters)
    found: dict[int, Array] = {}
    for grown in _GROWN if board.kind == "aprilgrid" else (0,):
        picture = grey if grown == 0 else cv2.dilate(grey, np.ones((grown, grown), np.uint8))
        corners, ids, _ = detector.detectMarkers(picture)
        if ids is None:
            continue
        read = [int(number) for number in np.asarray(ids).ravel()]
        for number, place in zip(read, corners, strict=True):
            if 0 <= number < board.markers and read.count(number) == 1:
                found.setdefault(number, np.asarray(place, dtype=float).reshape(4, 2))
    best = MarkerReading.none()
    if len(found) < 2:
        return best
    numbers = np.array(sorted(found), dtype=np.int64)
    image = np.array([found[number] for number in sorted(found)])
    for legacy in (False, True) if board.kind == "charuco" and board.rows % 2 == 0 else (False,):
        for turns in range(4) if board.kind == "aprilgrid" else (0,):
            sheet = np.roll(board.marker_corners(legacy=legacy)[numbers], turns, axis=1)
            keep = _agreeing(sheet, image)
            if keep.sum() > len(best.ids):
                best = MarkerReading(
                    np.asarray(numbers[keep], dtype=np.int64), image[keep], sheet[keep], border_bits, legacy
                )
    return best if len(best.ids) >= 2 else MarkerReading.none()


def _homographies(sheet: Array, image: Array) -> Array:
    """(m, 3, 3) of each marker alone."""
    return np.array(
        [
            cv2.getPerspectiveTransform(s.astype(np.float32), i.astype(np.float32)).astype(float)
            for s, i in zip(sheet, image, strict=True)
        ]
    )


def _through(homography: Array, xy: Array) -> Array:
    h = xy @ homography[:, :2].T + homography[:, 2]
    return np.asarray(h[:, :2] / np.where(np.abs(h[:, 2:]) < 1e-12, 1e-12, h[:, 2:]))


def _agreeing(sheet: Array, image: Array) -> NDArray[np.bool_]:
    """(m,) the largest group of markers in which each is confirmed by a neighbour."""
    m = len(sheet)
    maps = _homographies(sheet, image)
    middle = sheet.mean(axis=1)
    side_m = np.linalg.norm(sheet[:, 1] - sheet[:, 0], axis=1)
    side_px = np.linalg.norm(np.roll(image, -1, axis=1) - image, axis=2).mean(axis=1)
    distance = np.linalg.norm(middle[:, None] - middle[None], axis=2)
    nearest = np.where(np.eye(m, dtype=bool), np.inf, distance).min(axis=1)
    pitch = float(np.median(nearest))
    pairs = np.argwhere(np.triu((distance < _NEAR * pitch) & (distance > 0)))
    linked = []
    for i, j in pairs.tolist():
        errors = [
            np.linalg.norm(_through(maps[a], sheet[b]) - image[b], axis=1).max()
            / (max(side_px[a], side_px[b]) * max(1.0, distance[a, b] / side_m[a]))
            for a, b in ((i, j), (j, i))
        ]
        if max(errors) < _OFF:
            linked.append((i, j))
    if not linked:
        return np.zeros(m, dtype=bool)
    i, j = np.array(linked).T
    _, label = connected_components(coo_matrix((np.ones(len(i)), (i, j)), shape=(m, m)), directed=False)
    counts = np.bincount(label)
    return np.asarray((label == np.argmax(counts)) & (counts.max() >= 2))


def corners_from_markers(board: Board, reading: MarkerReading) -> tuple[NDArray[np.int64], Array]:
    """Ids (n,) and predicted places (n, 2) px of the board's corners beside markers that were read."""
    if board.kind == "aprilgrid":
        ids = 4 * reading.ids[:, None] + np.arange(4)
        # by place on the sheet: tags may be printed turned
        order = _order_on_sheet(reading.board_corners)
        return ids.ravel(), np.take_along_axis(reading.corners, order[..., None], axis=1).reshape(-1, 2)
    points = board.points()[:, :2]
    maps = _homographies(reading.board_corners, reading.corners)
    side = np.linalg.norm(np.roll(reading.corners, -1, axis=1) - reading.corners, axis=2).mean(axis=1)
    middle = reading.board_corners.mean(axis=1)
    beside = np.abs(points[:, None] - middle[None]).max(axis=2) < 0.51 * (board.square or 0.0)
    corners: list[int] = []
    places: list[Array] = []
    for number in np.flatnonzero(beside.any(axis=1)).tolist():
        rows = np.flatnonzero(beside[number])
        seen = np.array([_through(maps[row], points[number][None])[0] for row in rows])
        if np.ptp(seen, axis=0).max() <= _DISAGREE * side[rows].max():
            corners.append(number)
            places.append(seen.mean(axis=0))
    return np.array(corners, dtype=np.int64), np.array(places, dtype=float).reshape(-1, 2)


def _order_on_sheet(board_corners: Array) -> NDArray[np.int64]:
    """(m, 4) which of each tag's corners lies in its upper left, upper right, lower right, lower left."""
    away = board_corners - board_corners.mean(axis=1, keepdims=True)
    wanted = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
    return np.asarray(np.argmax(np.einsum("mkc,qc->mqk", away, wanted), axis=2))
