"""Self-calibration of a camera from real images of a board: our corners or circles beside OpenCV's, the same images.

Run: ``python -m benchmarks.real_boards FOLDER --board board.yaml`` with any folder of photographs of one camera. One
table: images and marks that both found, and for each kind of mark the RMS reprojection error (px, a coordinate) of
OpenCV's own ``calibrateCamera`` (k1 k2 p1 p2 k3), its focal length, and the RMS error of images left out: a fifth of
them in turn, resected from half of their marks with the camera of the others, the other half compared. The calibration
is the same for all, so that only the marks differ.
"""

import argparse
import time
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from robcal.files.body_file import read_body
from robcal.files.images import list_images, read_image
from robcal.photogrammetry.boards.detect import find_board
from robcal.photogrammetry.boards.layout import Board

Array = NDArray[np.float64]
Marks = dict[str, tuple[NDArray[np.int64], Array]]
"""By image: ids (n,), places (n, 2) px."""


def opencv_marks(grey: NDArray[np.uint8], board: Board, ids: NDArray[np.int64], near: Array) -> dict[str, Array]:
    """Places (n, 2) of the marks ``ids`` as OpenCV measures them, by method; ``near`` (n, 2) numbers them."""
    size = (board.columns, board.rows)
    found: dict[str, Array] = {}
    if board.has_circles:
        flags = cv2.CALIB_CB_ASYMMETRIC_GRID if board.kind == "asymmetric_circles" else cv2.CALIB_CB_SYMMETRIC_GRID
        ok, centres = cv2.findCirclesGrid(grey, size, flags=flags)
        return {"findCirclesGrid": _nearest(centres, near)} if ok else {}
    criteria = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 60, 1e-4)
    start = np.rint(near).astype(np.float32).reshape(-1, 1, 2)
    found["cornerSubPix 5"] = np.asarray(cv2.cornerSubPix(grey, start.copy(), (5, 5), (-1, -1), criteria), float)
    found["cornerSubPix 11"] = np.asarray(cv2.cornerSubPix(grey, start.copy(), (11, 11), (-1, -1), criteria), float)
    found = {name: xy.reshape(-1, 2) for name, xy in found.items()}
    if board.kind == "chessboard":
        ok, corners = cv2.findChessboardCornersSB(
            grey, size, flags=cv2.CALIB_CB_ACCURACY | cv2.CALIB_CB_NORMALIZE_IMAGE
        )
        if ok:
            found["ChessboardCornersSB"] = _nearest(corners, near)
    return found


def _nearest(places: NDArray, near: Array) -> Array:
    xy = np.asarray(places, dtype=float).reshape(-1, 2)
    return np.asarray(xy[np.linalg.norm(xy[None] - near[:, None], axis=2).argmin(axis=1)])


def measure(folder: Path, board: Board, polarity: str) -> tuple[dict[str, Marks], tuple[int, int], float]:
    """Marks by method and image, the images' size, and seconds of a processor for an image of ours."""
    methods: dict[str, Marks] = {}
    size, seconds, count = (0, 0), 0.0, 0
    for name, path in list_images(folder, "the images").items():
        image = read_image(path)
        begin = time.process_time()
        found = find_board(image, board, "dark" if polarity == "dark" else "bright")
        seconds, count = seconds + time.process_time() - begin, count + 1
        size = (image.shape[1], image.shape[0])
        if len(found) < 8:
            print(f"  {name}: {len(found)} marks {found.message}")
            continue
        grey = image if image.dtype == np.uint8 else (image >> 8).astype(np.uint8)
        methods.setdefault("ours", {})[name] = (found.code, found.xy)
        for method, xy in opencv_marks(np.ascontiguousarray(grey), board, found.code, found.xy).items():
            methods.setdefault(method, {})[name] = (found.code, xy)
    return methods, size, seconds / max(count, 1)


def calibrate(marks: Marks, points: Array, size: tuple[int, int]) -> tuple[float, Array, Array]:
    """RMS px of a coordinate, camera matrix, distortion."""
    objects = [points[ids].astype(np.float32) for ids, _ in marks.values()]
    images = [xy.astype(np.float32).reshape(-1, 1, 2) for _, xy in marks.values()]
    guess = cv2.initCameraMatrix2D(objects, images, size)
    flags = cv2.CALIB_USE_INTRINSIC_GUESS
    rms, matrix, distortion, _, _ = cv2.calibrateCamera(objects, images, size, guess, np.zeros(5), flags=flags)
    return float(rms) / np.sqrt(2.0), np.asarray(matrix), np.asarray(distortion)


def left_out(marks: Marks, points: Array, size: tuple[int, int], folds: int = 5) -> float:
    """RMS px of a coordinate of half the marks of images that the camera was not calibrated with."""
    names, squares = list(marks), []
    for fold in range(folds):
        held = names[fold::folds]
        _, matrix, distortion = calibrate({n: marks[n] for n in names if n not in held}, points, size)
        for name in held:
            ids, xy = marks[name]
            half = np.arange(len(ids)) % 2 == 0
            _, turn, shift = cv2.solvePnP(points[ids[half]], xy[half].reshape(-1, 1, 2), matrix, distortion)
            seen, _ = cv2.projectPoints(points[ids[~half]], turn, shift, matrix, distortion)
            squares.append((np.asarray(seen).reshape(-1, 2) - xy[~half]) ** 2)
    return float(np.sqrt(np.mean(np.concatenate(squares))))


def main() -> None:
    """The table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--board", type=Path, required=True)
    arguments = parser.parse_args()
    file = read_body(arguments.board)
    if file.board is None:
        parser.error(f"{arguments.board} states no board")
    points = file.board.points()
    methods, size, seconds = measure(arguments.folder, file.board, file.polarity)
    common = set.intersection(*(set(marks) for marks in methods.values())) if methods else set()
    print(f"{arguments.folder}: {len(common)} images that all found, {seconds:.2f} s an image (ours)")
    print("marks                 RMS px  left out px      f px")
    for method, marks in methods.items():
        chosen = {name: marks[name] for name in marks if name in common}
        rms, matrix, _ = calibrate(chosen, points, size)
        print(f"{method:20s} {rms:7.4f} {left_out(chosen, points, size):12.4f} {matrix[0, 0]:9.2f}")


if __name__ == "__main__":
    main()
