"""Where the measured centre of a circular target lies: not in the image of the circle's centre.

Two effects, both exact to second order of the dot's image size, and a third on curved bodies:

- perspective: the centre of the projected ellipse is the pole of the line at infinity with respect to the dual conic
  (Hartley and Zisserman, Multiple View Geometry, 2nd ed., 8.3), see :mod:`robcal.photogrammetry.core.eccentricity`;
- distortion changes across the dot: the area centroid of an ellipse with second moments ``S`` under a smooth map ``g``
  with Jacobian ``G`` and second derivatives ``H`` is ``g + H:S/2 + G S grad(ln det G)``. A least-squares ellipse
  through the contour has the same centre to this order;
- a dot on a sphere ends in a plane below its centre (16 um at 5 mm on a radius of 200 mm): it is that circle which is
  seen, see :func:`rim_offset`.

Centre of the image of a circular target: not the image of its centre.

A circle with centre c, radius r and unit normal n (camera frame) has the dual conic ``c c' - r^2 (I - n n')``; the
centre of its image is the pole of the line at infinity, hence the image of the point ``c - r^2 (e3 - n n_z) / c_z``
(exact for a pinhole; the change of distortion across the dot is neglected).
Source of dual conics: Hartley and Zisserman, Multiple View Geometry, 2nd ed., sections 2.2.3 and 8.3.
"""

from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from robcal.photogrammetry.core.camera import Camera, project, project_with_jacobians
from robcal.transforms import Array


def effective_point(p_camera: ArrayLike, normal_camera: ArrayLike, radius: ArrayLike) -> Array:
    """Points (..., 3) m whose image is the centre of the ellipse; NaN normals or radii mean no correction."""
    p = np.asarray(p_camera, dtype=float)
    n = np.asarray(normal_camera, dtype=float)
    r = np.asarray(radius, dtype=float)[..., None]
    shift = -(r**2) * (np.array([0.0, 0.0, 1.0]) - n * n[..., 2:3]) / p[..., 2:3]
    return p + np.where(np.isfinite(shift), shift, 0.0)


IntArray = NDArray[np.int64]

_STEP = 1e-4
"""Half the interval of the central differences over ideal image coordinates (radians, so about 0.2 px)."""

_RADIAL = np.cos(np.radians(8.0))


def centre_shift(camera: Camera, p_camera: ArrayLike, normal_camera: ArrayLike, radius: ArrayLike) -> Array:
    """Offset (m, 2) in px of the measured centre from the image of the circle's centre.

    Parameters
    ----------
    p_camera : (m, 3) m, centres in the camera frame.
    normal_camera : (m, 3) unit normals in the camera frame; sign irrelevant, NaN: no correction.
    radius : (m,) m; zero or NaN: no correction.
    """
    p, n = np.asarray(p_camera, dtype=float), np.asarray(normal_camera, dtype=float)
    r = np.asarray(radius, dtype=float)
    out = np.zeros((len(p), 2))
    rows = np.flatnonzero(np.isfinite(n).all(axis=1) & (np.nan_to_num(r) > 0) & (p[:, 2] > 0))
    if len(rows) == 0 or camera.fx <= 0:
        return out
    p, n, r = p[rows], n[rows], r[rows]
    effective = effective_point(p, n, r)
    centre = effective[:, :2] / effective[:, 2:]
    # semi-axes matrix of the ideal ellipse from the dual conic C*: S = m m' - C*[:2, :2] / C*[2, 2]
    dual = p[:, :2, None] * p[:, None, :2] - (r**2)[:, None, None] * (np.eye(2) - n[:, :2, None] * n[:, None, :2])
    last = p[:, 2] ** 2 - r**2 * (1.0 - n[:, 2] ** 2)
    shape = centre[:, :, None] * centre[:, None, :] - dual / last[:, None, None]
    moments = 0.25 * shape
    jacobian = _ideal_jacobian(camera, centre)
    second = np.empty((len(p), 2, 2, 2))  # [..., i, j, k]: derivative of G_ij by coordinate k
    for k in range(2):
        step = np.zeros(2)
        step[k] = _STEP
        ahead, behind = _ideal_jacobian(camera, centre + step), _ideal_jacobian(camera, centre - step)
        second[..., k] = (ahead - behind) / (2.0 * _STEP)
    # grad ln det G = trace(G^-1 dG/du_k)
    log_slope = np.einsum("mji,mijk->mk", np.linalg.inv(jacobian), second)
    curvature = 0.5 * np.einsum("mijk,mjk->mi", second, moments)
    curvature += np.einsum("mij,mjk,mk->mi", jacobian, moments, log_slope)
    shift = project(camera, effective) - project(camera, p) + curvature
    out[rows] = np.where(np.isfinite(shift), shift, 0.0)
    return out


def _ideal_jacobian(camera: Camera, ideal: Array) -> Array:
    """Derivatives (m, 2, 2) of pixels by ideal image coordinates (m, 2)."""
    ray = np.concatenate([ideal, np.ones_like(ideal[:, :1])], axis=1)
    return project_with_jacobians(camera, ray)[1][:, :, :2]


def body_normals(points: ArrayLike, neighbours: int = 6) -> Array:
    """Unit normals (t, 3) of targets on a body from the body's own shape, see :func:`shape_normals`."""
    return shape_normals(points, neighbours)[0]


def shape_normals(points: ArrayLike, neighbours: int = 6) -> tuple[Array, Array]:
    """Unit normals (t, 3) from the body's own shape, and how loose (t,) rad they are.

    Their sign is away from the centroid where the body is curved. Normals of the plane or sphere that most targets lie
    on are not loose; those of a neighbourhood by the angle of its thickness over its width.

    Where most targets lie on a plane or sphere, these and targets a little above it (a scale bar on a plate) get the
    plane's normal or radial ones; all others those of planes through the nearest neighbours, or NaN where the
    neighbourhood is no plane (thicker than a quarter of its width).

    Weakness: targets on small facets with few neighbours get NaN; then no eccentricity is modelled for them.
    """
    p = np.asarray(points, dtype=float)
    t = len(p)
    normals, loose = np.full((t, 3), np.nan), np.zeros(t)
    if t < 4:
        if t == 3:
            across = np.cross(p[1] - p[0], p[2] - p[0])
            length = np.linalg.norm(across)
            if length > 0:
                normals[:] = across / length
        return normals, loose
    centred = p - p.mean(axis=0)
    width = float(np.median(np.linalg.norm(p - np.median(p, axis=0), axis=1)))
    shape = _dominant_shape(p, 0.02 * width)
    done = np.zeros(t, dtype=bool)
    if shape is not None:
        centre, normal = shape
        if normal is not None:
            height = (p - centre) @ normal
            done = np.abs(height) < 0.15 * width
            normals[done] = normal
        else:
            away = p - centre
            distance = np.linalg.norm(away, axis=1)
            done = np.abs(distance - np.median(distance)) < 0.05 * min(width, float(np.median(distance)))
            normals[done] = away[done] / distance[done, None]
        if done.all():
            return normals, loose
    count = min(neighbours, t - 1)
    distance = np.linalg.norm(p[:, None] - p[None], axis=2)
    nearest = np.argsort(distance, axis=1)[:, : count + 1]
    local = p[nearest] - p[nearest].mean(axis=1, keepdims=True)
    _, values, axes = np.linalg.svd(local, full_matrices=False)
    flat = (values[:, 2] < 0.25 * values[:, 1]) & ~done
    normals[flat] = axes[flat, 2]
    loose[flat] = np.arctan2(values[flat, 2], values[flat, 1])
    inward = (np.einsum("ti,ti->t", normals, centred) < 0) & ~done
    normals[inward] *= -1.0
    return normals, loose


def rim_offset(points: ArrayLike, radii: ArrayLike, normals: ArrayLike | None = None) -> Array:
    """From the centre of each dot to the centre of its rim (t, 3): not zero where most targets lie on a sphere.

    ``radii`` (t,) m of the dots; ``normals`` (t, 3): targets that do not face away from the sphere's centre are not
    pasted onto it, but sit on facets.
    """
    p, r = np.asarray(points, dtype=float), np.nan_to_num(np.asarray(radii, dtype=float))
    offset = np.zeros_like(p)
    if len(p) < 8 or not np.any(r > 0):
        return offset
    width = float(np.median(np.linalg.norm(p - np.median(p, axis=0), axis=1)))
    shape = _dominant_shape(p, 0.02 * width)
    if shape is None or shape[1] is not None:
        return offset
    away = p - shape[0]
    distance = np.linalg.norm(away, axis=1)
    radius = float(np.median(distance))
    on = (np.abs(distance - radius) < 0.02 * min(width, radius)) & (r < 0.5 * radius)
    radial = away / distance[:, None]
    if normals is not None:
        on &= np.abs(np.einsum("ti,ti->t", np.nan_to_num(np.asarray(normals, dtype=float)), radial)) > _RADIAL
    depth = radius - np.sqrt(radius**2 - np.where(on, r, 0.0) ** 2)
    return np.asarray(-depth[:, None] * radial)


def _dominant_shape(points: Array, tolerance: float) -> tuple[Array, Array | None] | None:
    """(centre, normal) of a plane or (centre, None) of a sphere that holds 70 % of points (t, 3); None if neither.

    ``tolerance`` (m): within which a plane or, where that is less than a fiftieth of its radius, a sphere holds a
    point: targets of different heights on a plate are not on a huge sphere.
    """
    t = len(points)
    needed = 0.7 * t
    triples = _triples(t)
    a, b, c = (points[triples[:, k]] for k in range(3))
    normal = np.cross(b - a, c - a)
    length = np.linalg.norm(normal, axis=1)
    normal = normal[length > 0] / length[length > 0, None]
    a = a[length > 0]
    inside = np.abs(np.einsum("ki,tki->kt", normal, points[:, None] - a)) < tolerance
    if len(inside) and inside.sum(axis=1).max() >= needed:
        chosen = points[inside[np.argmax(inside.sum(axis=1))]]
        centre = chosen.mean(axis=0)
        return centre, np.linalg.svd(chosen - centre, full_matrices=False)[2][2]
    if t < 8:
        return None
    chosen = points
    for _ in range(4):
        centre, radius, _ = fit_sphere(chosen)
        residual = np.abs(np.linalg.norm(points - centre, axis=1) - radius)
        near = min(0.02 * radius, tolerance)
        close = residual < max(near, float(np.quantile(residual, 0.7)))
        if np.count_nonzero(close) < 6:
            return None
        chosen = points[close]
    held = np.count_nonzero(residual < near)
    return (centre, None) if held >= needed else None


@lru_cache(maxsize=64)
def _triples(count: int) -> IntArray:
    """Sixty random triples of ``count`` points, always the same."""
    rng = np.random.default_rng(0)
    return np.array([rng.choice(count, 3, replace=False) for _ in range(60)])


def fit_sphere(points: ArrayLike) -> tuple[Array, float, float]:
    """Centre (3,), radius and RMS distance of points (n, 3) from the algebraic best sphere (n >= 4).

    Weakness: flat point sets give a huge sphere; test for a plane first.
    """
    p = np.asarray(points, dtype=float)
    mean = p.mean(axis=0)
    centred = p - mean
    design = np.column_stack([2.0 * centred, np.ones(len(p))])
    solution = np.linalg.lstsq(design, np.sum(centred**2, axis=1), rcond=None)[0]
    radius = float(np.sqrt(max(solution[3] + solution[:3] @ solution[:3], 0.0)))
    misfit = np.linalg.norm(centred - solution[:3], axis=1) - radius
    return mean + solution[:3], radius, float(np.sqrt(np.mean(misfit**2)))
