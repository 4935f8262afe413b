"""How uncertain a calibrated camera's projection is over its image, at a distance.

What the calibration leaves open moves pixels, but a part of that is the same as a small motion of the camera, which
whoever uses the camera finds anew with its place. After Kogan (mrcal, 2020): the motion that takes up most over the
whole image is taken off, and what is left is the uncertainty of projection.
"""

from dataclasses import dataclass

import numpy as np

from robcal.photogrammetry.core.camera import INTRINSIC_NAMES, Camera, normalise, project_with_jacobians
from robcal.transforms import Array, skew


@dataclass(frozen=True)
class ProjectionUncertainty:
    """Standard deviations of projection on a grid over the image.

    Attributes
    ----------
    x : (c,), y : (r,) px, the grid. sigma : (r, c) px, root mean square of both directions, NaN where the lens has no
        ray. distance : m, from the camera. pixel : m that a pixel is there in the middle of the image.
    """

    x: Array
    y: Array
    sigma: Array
    distance: float
    pixel: float


def projection_uncertainty(
    camera: Camera, covariance: Array, distance: float, columns: int = 25
) -> ProjectionUncertainty:
    """The map of a camera.

    Parameters
    ----------
    covariance : (9, 9) of its interior orientation in the order of INTRINSIC_NAMES.
    distance : m, of the points from the camera, along its axis.

    Notes
    -----
    Weakness: other coefficients of a lens count as exact, and what the calibration's own poses share with the interior
    orientation is taken up by one motion of the camera.
    """
    rows = max(3, round(columns * camera.height / camera.width))
    x, y = np.linspace(0, camera.width - 1, columns), np.linspace(0, camera.height - 1, rows)
    pixels = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    ideal = normalise(camera, pixels)
    p = distance * np.column_stack([ideal, np.ones(len(ideal))])
    _, by_point, by_numbers = project_with_jacobians(camera, p)
    good = np.isfinite(by_numbers).all(axis=(1, 2)) & np.isfinite(by_point).all(axis=(1, 2))
    J = by_numbers[good].reshape(-1, len(INTRINSIC_NAMES))
    motion = by_point[good] @ np.concatenate([np.tile(np.eye(3), (int(good.sum()), 1, 1)), -skew(p[good])], axis=2)
    A = motion.reshape(-1, 6)
    left = (J - A @ np.linalg.lstsq(A, J, rcond=None)[0]).reshape(-1, 2, len(INTRINSIC_NAMES))
    variance = np.full(len(p), np.nan)
    variance[good] = np.einsum("nij,jk,nik->n", left, covariance, left) / 2.0
    pixel = distance / (0.5 * (camera.fx + camera.fy))
    return ProjectionUncertainty(x, y, np.sqrt(np.maximum(variance, 0.0)).reshape(rows, columns), distance, pixel)
