"""Centre of the image of a circular target: not the image of its centre.

A circle with centre c, radius r and unit normal n (camera frame) has the dual conic ``c c' - r^2 (I - n n')``; the
centre of its image is the pole of the line at infinity, hence the image of the point ``c - r^2 (e3 - n n_z) / c_z``
(exact for a pinhole; the change of distortion across the dot is neglected).
Source of dual conics: Hartley and Zisserman, Multiple View Geometry, 2nd ed., sections 2.2.3 and 8.3.
"""

import numpy as np
from numpy.typing import ArrayLike

from robcal.transforms import Array


def effective_point(p_camera: ArrayLike, normal_camera: ArrayLike, radius: ArrayLike) -> Array:
    """Points (..., 3) m whose image is the centre of the ellipse; NaN normals or radii mean no correction."""
    p = np.asarray(p_camera, dtype=float)
    n = np.asarray(normal_camera, dtype=float)
    r = np.asarray(radius, dtype=float)[..., None]
    shift = -(r**2) * (np.array([0.0, 0.0, 1.0]) - n * n[..., 2:3]) / p[..., 2:3]
    return p + np.where(np.isfinite(shift), shift, 0.0)
