"""A board in an image: identified marks with sub-pixel places and covariance, in the table that dots come in."""

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from robcal.imaging.corner_fit import CornerFits, fit_corners
from robcal.imaging.detect import check_image, detect_targets, saturation_level
from robcal.imaging.detections import CodeState, Detections, Reason, RejectionLog, TargetKind, empty_columns
from robcal.imaging.noise import NoiseModel, estimate_noise
from robcal.imaging.settings import DetectionSettings, Polarity
from robcal.photogrammetry.boards.board_map import BoardMap, fit_map
from robcal.photogrammetry.boards.corner_windows import corner_windows, edge_curvatures
from robcal.photogrammetry.boards.first_places import FirstPlaces, find_corners
from robcal.photogrammetry.boards.layout import Board
from robcal.photogrammetry.boards.surroundings import Surroundings, surroundings
from robcal.photogrammetry.boards.whole_grid import oriented
from robcal.transforms import Array

_MISFIT, _MISFIT_CLEAN, _MISFIT_USUAL = 0.08, 0.02, 3.0
"""RMS residual beyond noise by contrast above which a corner is covered, reflects or is no corner: always; never below
this; by that of the image's other corners."""
_CONTRAST = 8.0
"""Least contrast by the noise."""
_TURNED = np.radians(25.0)
_OFF_SIGMA, _OFF_LEAST = 8.0, 1.0
"""A mark farther from the smooth map of the others than so many of its sigmas and so many pixels is refused."""


def find_board(image: NDArray, board: Board, polarity: Polarity = "dark") -> Detections:
    """Find a board in a grey image.

    Parameters
    ----------
    image : (h, w) uint8 or uint16; not changed. polarity : of the circles of a grid.

    Returns
    -------
    Detections of kind CORNER or CIRCLE whose codes are the board's ids; empty with a message where it is not found.

    Raises
    ------
    InvalidInput : not a two-dimensional image of 8 or 16 bit.

    Notes
    -----
    ChArUco boards and AprilGrids are found in part, chessboards and grids of circles as a whole. Centres of circles are
    those of their image ellipses, not corrected for eccentricity; axes and angle allow that where camera and pose are
    known. A board that looks the same when turned is numbered with its x axis to the right in the image.
    """
    check_image(image)
    if board.has_circles:
        return _circles(image, board, polarity)
    noise = estimate_noise(image)
    log = RejectionLog()
    places = find_corners(_eight_bit(image), board)
    if len(places.ids) == 0:
        return _table(image, empty_columns(), noise, log, places.reason)
    board_xy = board.points()[places.ids, :2]
    board_map = fit_map(board_xy, places.xy)
    if board_map is None:
        return _table(image, empty_columns(), noise, log, "too few corners of the board are seen, or all in a line")
    around = surroundings(board, places.border_bits, places.legacy).select(places.ids)
    first = _sharpened(_eight_bit(image), places, board_map, board_xy, around)
    near = np.linalg.norm(first - board_map(board_xy), axis=1) < max(_OFF_LEAST * 3, _OFF_SIGMA * board_map.sigma)
    first = np.where(near[:, None], first, places.xy)
    board_map = fit_map(board_xy, first) or board_map
    windows, start = corner_windows(image, first, board_xy, board_map, around, saturation_level(image))

    def curvature_of(xy: Array, good: NDArray[np.bool_]) -> Array:
        better = fit_map(board_xy[good], xy[good])
        return np.zeros((len(xy), 2)) if better is None else edge_curvatures(better, board_xy)

    fits = fit_corners(windows, start, noise, curvature_of)
    keep = _judged(fits, first, start, around, board, noise, board_xy, log)
    columns = _columns(places.ids, fits, windows.half)
    message = "" if keep.any() else "no corner of the board is a clean crossing of two edges: check focus and light"
    return _table(image, {name: column[keep] for name, column in columns.items()}, noise, log, message)


def _eight_bit(image: NDArray) -> NDArray[np.uint8]:
    if image.dtype == np.uint8:
        return image
    top = max(1.0, float(np.quantile(image[:: max(1, image.shape[0] // 400)], 0.999)))
    return np.asarray(np.clip(image * (255.0 / top), 0, 255), dtype=np.uint8)


def _sharpened(
    grey: NDArray[np.uint8], places: FirstPlaces, board_map: BoardMap, board_xy: Array, around: Surroundings
) -> Array:
    """First places by OpenCV's gradient method, in windows that see no other corner."""
    first, _ = board_map.derivatives(board_xy)
    size = np.linalg.norm(first, axis=1)[:, [0, 0, 1, 1]] * around.reach
    half = int(np.clip(0.6 * np.median(size.min(axis=1)), 2, 8))
    inside = (places.xy > half + 2).all(axis=1) & (places.xy < np.array(grey.shape[::-1]) - half - 3).all(axis=1)
    result = places.xy.copy()
    if inside.any():
        criteria = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 30, 0.005)
        corners = places.xy[inside].astype(np.float32).reshape(-1, 1, 2)
        found = cv2.cornerSubPix(grey, corners, (half, half), (-1, -1), criteria)
        moved = np.asarray(found, dtype=float).reshape(-1, 2)
        near = np.linalg.norm(moved - places.xy[inside], axis=1) < half
        result[inside] = np.where(near[:, None], moved, places.xy[inside])
    return result


def _judged(
    fits: CornerFits,
    first: Array,
    start: Array,
    around: Surroundings,
    board: Board,
    noise: NoiseModel,
    board_xy: Array,
    log: RejectionLog,
) -> NDArray[np.bool_]:
    """(n,) corners that are clean, of the right colours, and where the board has them."""
    contrast = 2.0 * np.abs(fits.amplitude)
    typical = float(np.median(fits.misfit[fits.converged])) if fits.converged.any() else 0.0
    clean = fits.converged & (fits.misfit < min(_MISFIT, max(_MISFIT_CLEAN, _MISFIT_USUAL * typical)))
    clean &= contrast > _CONTRAST * np.sqrt(noise.at(fits.level))
    clean &= np.linalg.norm(fits.xy - first, axis=1) < 3.0
    turn = (fits.angle - start[:, 2:4] + np.pi) % (2 * np.pi) - np.pi
    clean &= (np.abs(turn) < _TURNED).all(axis=1)
    log.add_rows(first[~clean], np.full((~clean).sum(), 6.0), Reason.CORNER)
    # f is positive at the lower right
    wrong = (fits.amplitude > 0) == around.dark[:, 2]
    if board.turns > 1 and clean.any() and wrong[clean].mean() > 0.5:
        wrong = ~wrong  # a board that looks the same when turned may be printed with a bright square at its upper left
    right = clean & ~wrong
    board_map = fit_map(board_xy[right], fits.xy[right]) if right.sum() >= 4 else None
    if board_map is not None:
        away = np.linalg.norm(fits.xy - board_map(board_xy), axis=1)
        right &= away < np.maximum(_OFF_LEAST, _OFF_SIGMA * board_map.sigma)
    off = clean & ~right
    log.add_rows(fits.xy[off], np.full(off.sum(), 6.0), Reason.OFF_BOARD)
    return right


def _columns(ids: NDArray[np.int64], fits: CornerFits, half: float) -> dict[str, NDArray]:
    columns = empty_columns(len(ids))
    contrast = 2.0 * np.abs(fits.amplitude)
    return columns | {
        "xy": fits.xy,
        "covariance": fits.covariance,
        "semi_axes": np.full((len(ids), 2), half),
        "angle": fits.angle[:, 0],
        "contrast": contrast,
        "background": fits.level - 0.5 * contrast,
        "saturated": fits.saturated,
        "code": ids,
        "kind": np.full(len(ids), TargetKind.CORNER, np.int8),
        "code_state": np.full(len(ids), CodeState.READ, np.int8),
        "blur": np.sqrt(np.maximum(fits.blur**2 - 1.0 / 12.0, 0.0)),
        "residual": fits.misfit,
        "chi2": fits.chi2,
    }


def _table(
    image: NDArray, columns: dict[str, Any], noise: NoiseModel, log: RejectionLog, message: str = ""
) -> Detections:
    return Detections(
        shape=(int(image.shape[0]), int(image.shape[1])), noise=noise, rejected=log.result(), message=message, **columns
    )


def _circles(image: NDArray, board: Board, polarity: Polarity) -> Detections:
    """A grid of circles: dots by their ellipses, their order by OpenCV."""
    dots = detect_targets(image, DetectionSettings(polarity=polarity, ring12=False))
    rows = _grid_of_dots(dots, board)
    log = RejectionLog()
    for reason, count in dots.rejected.counts.items():
        log.count(reason, count)
    if rows is None:
        text = (
            f"{len(dots)} dots but no grid of {board.columns} x {board.rows} circles among them: it must be seen as a "
            "whole, and no other dots near it"
        )
        return _table(image, empty_columns(), dots.noise, log, dots.message or text)
    columns = {name: column[rows] for name, column in dots.columns().items()}
    columns["code"] = board.ids()
    columns["kind"] = np.full(len(rows), TargetKind.CIRCLE, np.int8)
    columns["code_state"] = np.full(len(rows), CodeState.READ, np.int8)
    return Detections(dots.shape, noise=dots.noise, rejected=dots.rejected, message="", **columns)


_find_grid: Any = cv2.findCirclesGrid  # the stubs do not know that without a blob detector it takes points


def _grid_of_dots(dots: Detections, board: Board) -> NDArray[np.int64] | None:
    """(t,) row of the dot of each circle, None where they form no such grid."""
    if len(dots) < board.columns * board.rows:
        return None
    basic = cv2.CALIB_CB_ASYMMETRIC_GRID if board.kind == "asymmetric_circles" else cv2.CALIB_CB_SYMMETRIC_GRID
    size = np.sqrt(dots.semi_axes.prod(axis=1))
    alike = np.flatnonzero(np.abs(np.log(size / np.median(size))) < np.log(2.5))
    for chosen in (np.arange(len(dots)), alike):
        if len(chosen) < board.columns * board.rows:
            continue
        points = dots.xy[chosen].astype(np.float32).reshape(-1, 1, 2)
        for flags in (basic, basic | cv2.CALIB_CB_CLUSTERING):
            found, centres = _find_grid(
                points, (board.columns, board.rows), flags, None, cv2.CirclesGridFinderParameters()
            )
            if not found:
                continue
            order, _ = oriented(board, np.asarray(centres, dtype=float).reshape(-1, 2), None)
            if order is None:
                continue
            distance = np.linalg.norm(order[:, None] - dots.xy[None], axis=2)
            rows = np.argmin(distance, axis=1)
            if distance[np.arange(len(rows)), rows].max() < 0.5 and len(np.unique(rows)) == len(rows):
                return np.asarray(rows, dtype=np.int64)
    return None
