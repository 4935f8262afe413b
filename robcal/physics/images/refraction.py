"""Refraction in front of a camera: a window of glass, or a boundary to another medium."""

from collections.abc import Iterator

import numpy as np

from robcal.photogrammetry.core.camera import project_with_jacobians
from robcal.physics.cause import Array
from robcal.physics.images.cause import ImageCause, only
from robcal.physics.images.data import ImageData
from robcal.physics.refraction import REFRACTION

GLASS = 1.52
TILTS = (0.0, 0.3, 0.6)
"""Angles (rad) between the camera's axis and the normals of the windows that are tried."""
AZIMUTHS = 8
THICKEST = 0.15


def refraction_causes(data: ImageData, c: int, name: str, rows: Array) -> Iterator[ImageCause]:
    """Windows and boundaries in front of one camera.

    Weakness: what lens distortion and the camera's place can take over does not show; thickness and index of a window
    cannot be told apart, so the thickness is that of common glass.
    """
    _, by_point, _ = project_with_jacobians(data.cameras[c], data.p_camera)
    normals = [
        np.array([np.sin(tilt) * np.cos(turn), np.sin(tilt) * np.sin(turn), np.cos(tilt)])
        for tilt in TILTS
        for turn in (np.arange(AZIMUTHS) * 2 * np.pi / AZIMUTHS if tilt else (0.0,))
    ]
    for normal in normals:
        shift = -normal * _window_shift(data.p_camera, normal)[:, None]
        yield ImageCause(
            REFRACTION,
            name,
            None,
            only(rows, by_point @ shift[:, :, None]),
            np.array([1e-2]),
            lambda v, c: {"index": GLASS, "thickness_mm": 1e3 * float(v[0])},
            "Camera {where} looks through a window that acts like {thickness_mm:.1f} mm of glass",
            weight=0.5 / len(normals),
            bends=True,
            plausible=lambda v: 0.0 < float(v[0]) < THICKEST,
        )
    body_axes = data.camera_R_body.swapaxes(1, 2)
    directions = [np.broadcast_to([0.0, 0.0, 1.0], data.p_camera.shape), *(body_axes[:, k] for k in range(3))]
    for direction in directions:
        # behind a flat boundary depths along its normal shrink by 1 - 1/index (near the normal); what shows beside
        # focal length and distance is the shrinking of depth differences
        depth = np.einsum("mi,mi->m", direction, data.p_camera)
        depth = depth - np.mean(depth[rows])
        yield ImageCause(
            REFRACTION,
            name,
            None,
            only(rows, -by_point @ (direction * depth[:, None])[:, :, None]),
            np.array([0.2]),
            lambda v, c: {"index": float(1.0 / max(1.0 - v[0], 1e-3))},
            "Camera {where} looks through a boundary of media (apparent index {index:.3f})",
            weight=0.25 / len(directions),
            bends=True,
            plausible=lambda v: 0.03 < abs(float(v[0])) < 0.6,
        )


def _window_shift(p_camera: Array, normal: Array) -> Array:
    """By how much points (m, 3) come nearer along the normal per thickness of a plane-parallel plate of glass.

    ``1 - cos(a) / sqrt(n^2 - sin^2(a))`` with a the angle of incidence (Luhmann et al., Close-Range Photogrammetry).
    """
    cosine = p_camera @ normal / np.linalg.norm(p_camera, axis=1)
    return np.asarray(1.0 - np.abs(cosine) / np.sqrt(GLASS**2 - (1.0 - cosine**2)))
