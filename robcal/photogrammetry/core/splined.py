"""A smooth empirical lens: Brown's model and, on the image, two cubic B-spline surfaces that shift what it predicts.

After mrcal's splined models (Kogan 2020), which put splines in place of a polynomial; here they lie on top of one, so
that the nine numbers keep their meaning and surveys and stations adjust them beneath given splines. With ``u`` the
pixel of Brown's lens the image is ``u + S(u)``. Beyond the image the shift is that of its edge.
"""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from robcal.errors import InvalidInput
from robcal.photogrammetry.core.camera import Camera, normalise, project, project_with_jacobians
from robcal.transforms import Array

LEAST_NODES = 4


@dataclass(frozen=True)
class SplinedCamera(Camera):
    """Brown's lens with a shift of splines; ``nodes`` (rows, columns, 2) px, control points over the image.

    The outermost control points lie one spacing beyond the image. Two such cameras compare equal by their nine numbers.
    """

    nodes: Array = field(default_factory=lambda: np.zeros((LEAST_NODES, LEAST_NODES, 2)), compare=False, repr=False)

    def __post_init__(self) -> None:
        if self.nodes.ndim != 3 or self.nodes.shape[2] != 2 or min(self.nodes.shape[:2]) < LEAST_NODES:
            raise InvalidInput(
                f"splines of a lens need {LEAST_NODES} x {LEAST_NODES} control points or more, each (x, y)"
            )

    @property
    def distortion(self) -> Array:
        """Refused: there are no coefficients of OpenCV that do what the splines do.

        Raises
        ------
        InvalidInput : always.
        """
        raise InvalidInput("no other program has a splined lens: use its own camera file, or calibrate without splines")

    @property
    def brown(self) -> Camera:
        """The lens without its splines."""
        return Camera(self.width, self.height, *self.vector.tolist())


def basis(t: Array) -> tuple[Array, Array]:
    """Weights (..., 4) of a uniform cubic B-spline at ``t`` in [0, 1) of its interval, and their derivatives by t."""
    s = 1.0 - t
    weights = [s**3, 3 * t**3 - 6 * t**2 + 4.0, 3 * s**3 - 6 * s**2 + 4.0, t**3]
    slopes = [-3 * s**2, 9 * t**2 - 12 * t, -9 * s**2 + 12 * s, 3 * t**2]
    return np.stack(weights, axis=-1) / 6.0, np.stack(slopes, axis=-1) / 6.0


def places(u: Array, size: tuple[int, int], shape: tuple[int, int]) -> tuple[NDArray[np.int64], Array, Array, Array]:
    """First control points (..., 2) x, y of pixels (..., 2), their places in the interval, scale (2,), and what counts.

    ``size`` : (width, height) of the image; ``shape`` : (rows, columns) of control points.
    """
    intervals = np.array([shape[1], shape[0]]) - 3.0
    scale = intervals / (np.array(size) - 1.0)
    t = u * scale
    inside = np.clip(t, 0.0, intervals - 1e-9)
    first = np.floor(np.where(np.isfinite(inside), inside, 0.0)).astype(np.int64)
    return first, inside - first, scale, (t == inside).astype(float)


def shift(camera: SplinedCamera, u: Array) -> tuple[Array, Array]:
    """Shifts (..., 2) px at pixels (..., 2) of Brown's lens, and derivatives (..., 2, 2)."""
    rows, columns = camera.nodes.shape[:2]
    first, t, scale, free = places(u, (camera.width, camera.height), (rows, columns))
    (wx, sx), (wy, sy) = basis(t[..., 0]), basis(t[..., 1])
    at = np.arange(4)
    C = camera.nodes[(first[..., 1, None] + at)[..., :, None], (first[..., 0, None] + at)[..., None, :]]
    value = np.einsum("...i,...j,...ijk->...k", wy, wx, C)
    by_x = np.einsum("...i,...j,...ijk->...k", wy, sx, C) * (scale[0] * free[..., 0])[..., None]
    by_y = np.einsum("...i,...j,...ijk->...k", sy, wx, C) * (scale[1] * free[..., 1])[..., None]
    return value, np.stack([by_x, by_y], axis=-1)


@project.register
def _project(camera: SplinedCamera, p_camera: ArrayLike) -> Array:
    u = project(camera.brown, p_camera)
    return np.asarray(u + shift(camera, u)[0])


@project_with_jacobians.register
def _with_jacobians(camera: SplinedCamera, p_camera: ArrayLike) -> tuple[Array, Array, Array]:
    u, d_point, d_in = project_with_jacobians(camera.brown, p_camera)
    moved, by_u = shift(camera, u)
    whole = np.eye(2) + by_u
    return u + moved, whole @ d_point, whole @ d_in


@normalise.register
def _normalise(camera: SplinedCamera, xy: ArrayLike, iterations: int = 50) -> Array:
    """Ideal coordinates; the splines are taken off by fixed-point steps, which their gentle slopes allow."""
    pixels = np.asarray(xy, dtype=float)
    u = pixels.copy()
    for _ in range(iterations):
        step = pixels - shift(camera, u)[0] - u
        u = u + step
        if np.all(~np.isfinite(step) | (np.abs(step) < 1e-11)):
            break
    bad = np.linalg.norm(u + shift(camera, u)[0] - pixels, axis=-1) > 1e-8
    return normalise(camera.brown, np.where(bad[..., None], np.nan, u), iterations)
