"""Square markers of OpenCV's dictionaries: identity, and a centre that is accurate: edges fitted, corners intersected.

The centre is the meeting point of the diagonals, which perspective keeps (unlike the mean of the corners).
"""

import cv2
import numpy as np
from numpy.typing import NDArray

from robcal.errors import InvalidInput
from robcal.imaging.detections import CodeState, TargetKind, empty_columns
from robcal.imaging.noise import NoiseModel

Array = NDArray[np.float64]

_FLOOR = 0.01  # px, of a corner: bent edges, print, aliasing


def dictionary_by_name(name: str) -> cv2.aruco.Dictionary:
    """OpenCV's dictionary called "4X4_50", "DICT_4X4_50", "apriltag_36h11", ...

    Raises
    ------
    InvalidInput : no such dictionary.
    """
    available = {key.upper(): getattr(cv2.aruco, key) for key in dir(cv2.aruco) if key.startswith("DICT_")}
    wanted = name.strip().upper()
    wanted = wanted if wanted.startswith("DICT_") else f"DICT_{wanted}"
    if wanted not in available:
        known = ", ".join(sorted(key.removeprefix("DICT_") for key in available))
        raise InvalidInput(f"marker dictionary {name!r} is unknown; choose one of {known}")
    return cv2.aruco.getPredefinedDictionary(available[wanted])


def diagonal_intersection(corners: Array) -> tuple[Array, Array]:
    """Meeting point (n, 2) of the diagonals of quadrilaterals (n, 4, 2) and its derivative (n, 2, 4, 2)."""
    a, b, c, d = (corners[:, k] for k in range(4))

    def cross(p: Array, q: Array) -> Array:
        return p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0]

    first, second = c - a, d - b
    determinant = cross(first, second)
    t = cross(b - a, second) / determinant
    u = cross(b - a, first) / determinant
    centre = a + t[:, None] * first
    derivative = np.empty((len(corners), 2, 4, 2))
    # moving an end of one diagonal moves the point along the other one
    normal_first = np.stack([-first[:, 1], first[:, 0]], axis=-1) / determinant[:, None]
    normal_second = np.stack([-second[:, 1], second[:, 0]], axis=-1) / determinant[:, None]
    for corner, weight, along, normal in (
        (0, 1 - t, second, normal_first),
        (2, t, second, normal_first),
        (1, -(1 - u), first, normal_second),
        (3, -u, first, normal_second),
    ):
        derivative[:, :, corner, :] = weight[:, None, None] * along[:, :, None] * normal[:, None, :]
    return centre, derivative


def find_markers(image: NDArray, dictionary: str, noise: NoiseModel) -> dict[str, NDArray]:
    """Markers of a grey image as columns of :class:`robcal.imaging.detections.Detections`.

    Parameters
    ----------
    image : (h, w) uint8 or uint16. dictionary : see :func:`dictionary_by_name`. noise : of the image.

    Notes
    -----
    Corner covariance is that of the gradient's structure tensor around the corner (Foerstner and Guelch 1987),
    var = sigma^2 (sum g g')^-1, times two for the corner's own neighbourhood being in its weight, plus (0.01 px)^2.
    """
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    grey = image if image.dtype == np.uint8 else _to_8_bit(image)
    found, ids, _ = cv2.aruco.ArucoDetector(dictionary_by_name(dictionary), parameters).detectMarkers(grey)
    if ids is None or len(ids) == 0:
        return empty_columns()
    corners = np.array(found, dtype=float).reshape(-1, 4, 2)
    n = len(corners)
    columns = empty_columns(n)
    scale = 255.0 / float(image.max()) if image.dtype != np.uint8 else 1.0
    sigma2 = max(float(noise.variance) * scale**2, 1.0 / 12.0)
    corner_covariance = _corner_covariance(grey, corners, sigma2)
    centre, derivative = diagonal_intersection(corners)
    columns["covariance"] = np.einsum("nick,nckl,njcl->nij", derivative, corner_covariance, derivative)
    side = np.linalg.norm(np.roll(corners, -1, axis=1) - corners, axis=2)
    columns["xy"] = centre
    columns["semi_axes"] = np.stack([side.max(axis=1), side.min(axis=1)], axis=-1) / 2.0
    columns["angle"] = np.arctan2(corners[:, 1, 1] - corners[:, 0, 1], corners[:, 1, 0] - corners[:, 0, 0])
    columns["code"] = ids.ravel().astype(np.int64)
    columns["kind"] = np.full(n, TargetKind.ARUCO, np.int8)
    columns["code_state"] = np.full(n, CodeState.READ, np.int8)
    # a marker is black in a white border: contrast by the brightest and darkest tenth inside
    for row in range(n):
        low, high = np.floor(corners[row].min(axis=0)).astype(int), np.ceil(corners[row].max(axis=0)).astype(int)
        patch = image[max(low[1], 0) : high[1] + 1, max(low[0], 0) : high[0] + 1]
        dark, light = np.quantile(patch, [0.1, 0.9])
        columns["contrast"][row], columns["background"][row] = dark - light, light
        columns["saturated"][row] = bool((patch == np.iinfo(image.dtype).max).any())
    return columns


def _to_8_bit(image: NDArray) -> NDArray[np.uint8]:
    return (image * (255.0 / max(1, int(image.max())))).astype(np.uint8)


def _corner_covariance(grey: NDArray[np.uint8], corners: Array, sigma2: float) -> Array:
    """(n, 4, 2, 2)."""
    height, width = grey.shape
    reach = 5  # half window of the corner refinement
    offset = np.arange(-reach, reach + 1)
    centre = np.rint(corners).astype(int)
    rows = np.clip(centre[..., 1, None] + offset, 1, height - 2)[..., :, None]
    columns = np.clip(centre[..., 0, None] + offset, 1, width - 2)[..., None, :]
    gx = 0.5 * (grey[rows, columns + 1].astype(float) - grey[rows, columns - 1])
    gy = 0.5 * (grey[rows + 1, columns].astype(float) - grey[rows - 1, columns])
    tensor = np.empty((*corners.shape[:2], 2, 2))
    tensor[..., 0, 0] = (gx * gx).sum(axis=(-1, -2))
    tensor[..., 1, 1] = (gy * gy).sum(axis=(-1, -2))
    tensor[..., 0, 1] = tensor[..., 1, 0] = (gx * gy).sum(axis=(-1, -2))
    tensor += 1e-6 * np.trace(tensor, axis1=-2, axis2=-1)[..., None, None] * np.eye(2) + 1e-9 * np.eye(2)
    return 2.0 * sigma2 * np.linalg.inv(tensor) + _FLOOR**2 * np.eye(2)
