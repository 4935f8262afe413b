"""What each image tells by itself: where the board is before the camera, and how far that agrees with the robot."""

from dataclasses import dataclass

import cv2
import numpy as np

from robcal.errors import DegenerateGeometry, NotIdentifiable
from robcal.handeye.data import BoolArray, HandEyeData
from robcal.photogrammetry.core.bodies import thickness_ratio
from robcal.photogrammetry.core.camera import INTRINSIC_NAMES, Camera
from robcal.photogrammetry.orientation.resection import Resection, resect_images
from robcal.transforms import Array, difference

FEWEST = 4
"""Marks that an image needs: three have several poses."""


@dataclass(frozen=True)
class SingleImages:
    """Poses of the board in single images.

    Attributes
    ----------
    camera_T_board : (n, 4, 4), NaN where an image has none; other : (n, 4, 4) the second pose of a plane, NaN without.
    marks : (m,) marks that agree with the pose of their image; pixel : noise over what is stated.
    failed : why an image has no pose, by its number.
    """

    camera_T_board: Array
    other: Array
    marks: BoolArray
    pixel: float
    failed: dict[int, str]

    @property
    def usable(self) -> BoolArray:
        """(n,) images with a pose."""
        return np.asarray(np.isfinite(self.camera_T_board).all(axis=(1, 2)))


def start_camera(data: HandEyeData, size: tuple[int, int]) -> Camera:
    """A camera from the images alone, where no start values are given (Zhang 2000; OpenCV's calibrateCamera).

    Raises
    ------
    NotIdentifiable : fewer than three images with enough marks, or nothing that fits them.
    """
    groups = [np.flatnonzero(data.image == i) for i in range(data.n)]
    groups = [rows for rows in groups if len(rows) >= 8][:40]
    if len(groups) < 3:
        raise NotIdentifiable(
            f"{len(groups)} images with eight marks or more cannot calibrate the camera as well: give its calibration, "
            "or more images"
        )
    points: list[Array] = [data.points[rows] for rows in groups]
    pixels = [data.xy[rows].astype(np.float32) for rows in groups]
    flags, guess = 0, None
    if thickness_ratio(data.body.points[data.body.known]) > 0:
        flags, guess = cv2.CALIB_USE_INTRINSIC_GUESS, Camera.from_size(*size).matrix
    else:
        points = [_in_plane(p, data.body.points[data.body.known]) for p in points]
    try:
        narrow = [p.astype(np.float32) for p in points]
        _, K, D, _, _ = cv2.calibrateCamera(narrow, pixels, size, guess, np.zeros(5), flags=flags | cv2.CALIB_FIX_K3)
    except cv2.error:
        K, D = np.full((3, 3), np.nan), np.zeros(5)
    longer = max(size)
    if not (np.isfinite(K).all() and 0.1 * longer < K[0, 0] < 100 * longer and 0.1 * longer < K[1, 1] < 100 * longer):
        raise NotIdentifiable(
            "the images do not tell the camera's focal length (all from the front?): give its calibration, or add "
            "images that look at the board at 20 to 45 degrees"
        )
    values = dict(zip(INTRINSIC_NAMES[4:], np.ravel(D)[:5].tolist(), strict=True))
    return Camera(*size, float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2]), **values)


def _in_plane(p: Array, board: Array) -> Array:
    """Points of a plane with z = 0, as OpenCV wants them."""
    centre = board.mean(axis=0)
    _, _, axes = np.linalg.svd(board - centre)
    if np.linalg.det(axes) < 0:
        axes[2] *= -1
    flat = (p - centre) @ axes.T
    flat[:, 2] = 0.0
    return flat


def resect(data: HandEyeData, camera: Camera) -> SingleImages:
    """The pose of the board in every image, wrong marks left out; noise of the marks from what is left over.

    Raises
    ------
    NotIdentifiable : no image has a pose.
    """
    scale = 1.0
    for _ in range(2):
        found = resect_images(
            camera, data.image, data.body.ids[data.target], data.xy, scale**2 * data.covariance, data.body, gate=5.0
        )
        chi2 = np.array([r.chi2 / r.redundancy for r in found if isinstance(r, Resection) and r.redundancy > 0])
        if not len(chi2):
            break
        factor = float(np.sqrt(np.median(chi2)))
        scale *= factor
        if 0.7 < factor < 1.4:
            break
    n = data.n
    T, other = np.full((n, 4, 4), np.nan), np.full((n, 4, 4), np.nan)
    marks = np.zeros(len(data.image), dtype=bool)
    failed: dict[int, str] = {}
    counts = np.bincount(data.image, minlength=n)
    for i in range(n):
        result = found[i] if i < len(found) else None
        if result is None or counts[i] == 0:
            failed[i] = "no mark of the board"
        elif isinstance(result, DegenerateGeometry):
            failed[i] = str(result)
        elif counts[i] < FEWEST:
            failed[i] = f"{counts[i]} marks of the board, {FEWEST} are needed"
        else:
            T[i] = result.camera_T_body
            marks |= result.inliers
            if result.ambiguous and result.alternative is not None:
                other[i] = result.alternative
    if not np.isfinite(T[:, 0, 0]).any():
        why = next(iter(failed.values()), "no marks")
        raise NotIdentifiable(f"no image tells where the board is: {why}")
    return SingleImages(T, other, marks, scale, failed)


def discrepancies(data: HandEyeData, views: Array, single: SingleImages) -> Array:
    """(n, 6) right twist from the predicted ``camera_T_board`` (n, 4, 4) to the one of the image; NaN without.

    Where a plane has two poses in an image, the one nearer to the prediction.
    """
    first = _twists(views, single.camera_T_board)
    second = _twists(views, single.other)
    size = np.ptp(data.body.points[data.body.known], axis=0).max()
    nearer = np.nan_to_num(_length(second, size), nan=np.inf) < np.nan_to_num(_length(first, size), nan=np.inf)
    return np.where(nearer[:, None], second, first)


def _twists(a: Array, b: Array) -> Array:
    out = np.full((len(a), 6), np.nan)
    ok = np.isfinite(b).all(axis=(1, 2))
    out[ok] = difference(a[ok], b[ok])
    return out


def _length(twist: Array, lever: float) -> Array:
    return np.sqrt(np.sum(twist[:, :3] ** 2, axis=1) + lever**2 * np.sum(twist[:, 3:] ** 2, axis=1))
