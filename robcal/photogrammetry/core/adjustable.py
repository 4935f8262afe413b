"""Any lens as a camera of nine numbers, which surveys and stations adjust; its other coefficients stay as they are.

A rational lens keeps k4 to k6 and its thin prism terms, a fisheye its k4 (and has no p1, p2). What such a camera does
not have among the nine is held, see :func:`adjustable_names`.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from robcal.photogrammetry.core.camera import INTRINSIC_NAMES, Camera, normalise, project, project_with_jacobians
from robcal.transforms import Array


@dataclass(frozen=True)
class AdjustableCamera(Camera):
    """A camera of another lens by the nine numbers of Brown's; ``lens`` has all others."""

    lens: Camera | None = None

    @property
    def whole(self) -> Camera:
        """The lens with the present numbers."""
        if self.lens is None:
            return Camera(self.width, self.height, *self.vector.tolist())
        shared = {name: getattr(self, name) for name in adjustable_names(self)}
        return replace(self.lens, **shared)


def adjustable(camera: Camera) -> Camera:
    """The camera as one of nine numbers; Brown's and splined ones are such already."""
    if camera.names == INTRINSIC_NAMES:
        return camera
    shared = {name: getattr(camera, name) for name in INTRINSIC_NAMES if name in camera.names}
    return AdjustableCamera(camera.width, camera.height, **shared, lens=camera)


def plain(camera: Camera) -> Camera:
    """The camera of its own lens, as files have it."""
    return camera.whole if isinstance(camera, AdjustableCamera) else camera


def adjustable_names(camera: Camera) -> tuple[str, ...]:
    """Those of the nine numbers that the lens has."""
    if isinstance(camera, AdjustableCamera) and camera.lens is not None:
        return tuple(name for name in INTRINSIC_NAMES if name in camera.lens.names)
    return INTRINSIC_NAMES


@project.register
def _project(camera: AdjustableCamera, p_camera: ArrayLike) -> Array:
    return project(camera.whole, p_camera)


@project_with_jacobians.register
def _with_jacobians(camera: AdjustableCamera, p_camera: ArrayLike) -> tuple[Array, Array, Array]:
    whole = camera.whole
    xy, d_point, by_all = project_with_jacobians(whole, p_camera)
    d_in = np.zeros((*by_all.shape[:-1], len(INTRINSIC_NAMES)))
    for name in adjustable_names(camera):
        d_in[..., INTRINSIC_NAMES.index(name)] = by_all[..., whole.names.index(name)]
    return xy, d_point, d_in


@normalise.register
def _normalise(camera: AdjustableCamera, xy: ArrayLike, iterations: int = 50) -> Array:
    return normalise(camera.whole, xy, iterations)
