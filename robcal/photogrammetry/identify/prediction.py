"""Where a body is expected before a camera, and what its image then is: places, search radii, sizes of the dots."""

from dataclasses import dataclass

import numpy as np

from robcal.photogrammetry.core.bodies import Body, IntArray
from robcal.photogrammetry.core.camera import Camera, project_with_jacobians
from robcal.photogrammetry.core.eccentric_circle import effective_point
from robcal.transforms import Array, skew, transform

_GATE = 5.0
"""Search radius in standard deviations of a predicted place."""
_INSIDE_RING = 1.2
"""Search radius of a dot within a code ring by its radius: parts of the ring lie from two radii on, less if tilted."""
_LEAST_GATE = 3.0
"""px"""


@dataclass(frozen=True)
class Prediction:
    """Where the body is expected before the camera: ``camera_T_body`` (4, 4), ``covariance`` (6, 6) or None and the
    error in the image (px) beyond that covariance."""

    camera_T_body: Array
    covariance: Array | None = None
    error_px: float = 3.0


def predict_dots(
    camera: Camera, pose: Array, covariance: Array | None, body: Body, targets: IntArray, error_px: float
) -> tuple[Array, Array, Array]:
    """Where a pose puts targets in the image.

    Returns
    -------
    Places (n, 2) px, NaN where they cannot be seen; search radii (n,) px; expected semi-axes (n,) px, NaN where the
    diameter is not known.
    """
    X = body.points[targets]
    normals = body.estimated_normals()[targets] @ pose[:3, :3].T
    p = transform(pose, X)
    xy, d_point, _ = project_with_jacobians(camera, effective_point(p, normals, 0.5 * body.diameters[targets]))
    variance = np.full(len(targets), error_px**2)
    if covariance is not None:
        J = d_point @ np.concatenate([np.broadcast_to(pose[:3, :3], (len(X), 3, 3)), -pose[:3, :3] @ skew(X)], axis=-1)
        S = J @ covariance @ np.swapaxes(J, -1, -2)
        variance = variance + np.linalg.eigvalsh(0.5 * (S + np.swapaxes(S, -1, -2)))[..., -1]
    inside = (xy > -20).all(axis=1) & (xy[:, 0] < camera.width + 20) & (xy[:, 1] < camera.height + 20)
    if body.normals is not None:
        facing = np.sum(normals * p, axis=1) < 0
        inside &= facing | ~np.isfinite(normals).all(axis=1)
    xy = np.where(inside[:, None], xy, np.nan)
    with np.errstate(invalid="ignore", divide="ignore"):
        size = camera.fx * 0.5 * body.diameters[targets] / p[:, 2]
    gate = np.where(np.isfinite(variance), _GATE * np.sqrt(np.maximum(variance, 0.01)), 0.0)
    ringed = np.array([code == "ring12" for code in body.codes], dtype=bool)[targets] & np.isfinite(size)
    gate = np.where(ringed, np.minimum(gate, np.maximum(_INSIDE_RING * size, _LEAST_GATE)), gate)
    return xy, gate, size
