"""Size and direction of round targets from the ellipses that they show: no file needs to state either.

A disc of radius r with unit normal n fills the points ``p + r v``, ``v`` a unit disc across n; its image is, to first
order of its size, the ellipse with the matrix ``S = B A B'``, where ``A = r^2 (I - n n')`` and B is the derivative of
the pixels by the body's coordinates. S is linear in the six elements of A, so A follows from the ellipses of all images
by least squares; its eigenvalues are r^2, r^2 and 0, the vector of the last one is the normal.

Weaknesses: images from one direction only leave A undetermined; the accuracy of the detected axes counts (half a
percent where dots are well exposed), which is ample for the eccentricity of a projected centre.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from robcal.columns import Columns
from robcal.photogrammetry.core.camera import Camera, project_with_jacobians
from robcal.photogrammetry.core.eccentricity import shape_normals
from robcal.transforms import Array, transform

IntArray = NDArray[np.int64]

_ROUND = 0.5
"""A disc's two large eigenvalues may differ by this factor, and the third be this far from zero, else it is none."""
_GROSS = 4.0
"""Ellipses that deviate from the disc by this many robust sigmas are left out once (half hidden, run into a
neighbour)."""


_METRIC = 1.25
"""Where dots look as large as stated within this factor, the network is in metres already."""
_FLAT = np.radians(5.0)
"""Normals from the body's shape are believed unless the ellipses contradict them by more than this."""


@dataclass(frozen=True)
class Discs(Columns):
    """Discs of t targets; NaN where the ellipses do not determine it.

    Attributes
    ----------
    diameter : (t,) m, in the scale of the points given. normal : (t, 3) unit, towards the cameras that saw it.
    sigma : (t,) rad, standard deviation of the normal's direction, from how well the ellipses agree.
    images : (t,) ellipses used.
    """

    diameter: Array
    normal: Array
    sigma: Array
    images: IntArray


def discs_from_ellipses(
    camera: Camera,
    camera_T_body: ArrayLike,
    points: ArrayLike,
    image: IntArray,
    target: IntArray,
    semi_axes: ArrayLike,
    angle: ArrayLike,
) -> Discs:
    """Discs of all targets.

    Parameters
    ----------
    camera_T_body : (n, 4, 4); points : (t, 3) m; image, target : (m,) rows of both.
    semi_axes : (m, 2) px, major first, NaN where unknown; angle : (m,) rad of the major axis from +x towards +y.
    """
    T, p_body = np.asarray(camera_T_body, dtype=float), np.asarray(points, dtype=float)
    axes, turn = np.asarray(semi_axes, dtype=float), np.asarray(angle, dtype=float)
    t = len(p_body)
    out = Discs(np.full(t, np.nan), np.full((t, 3), np.nan), np.full(t, np.nan), np.zeros(t, dtype=np.int64))
    p = transform(T[image], p_body[target])
    usable = np.isfinite(axes).all(axis=1) & (axes > 0).all(axis=1) & np.isfinite(turn) & (p[:, 2] > 0)
    rows = np.flatnonzero(usable)
    if len(rows) == 0:
        return out
    R = T[image[rows], :3, :3]
    B = project_with_jacobians(camera, p[rows])[1] @ R
    c, s = np.cos(turn[rows]), np.sin(turn[rows])
    u = np.stack([np.stack([c, s], axis=1), np.stack([-s, c], axis=1)], axis=1)
    S = np.einsum("mk,mki,mkj->mij", axes[rows] ** 2, u, u)
    major = axes[rows, 0] ** 2
    design = np.stack([_columns(B, i, j) for i, j in ((0, 0), (0, 1), (1, 1))], axis=1) / major[:, None, None]
    seen = np.stack([S[:, 0, 0], S[:, 0, 1], S[:, 1, 1]], axis=1) / major[:, None]
    centre = -np.einsum("mij,mi->mj", R, T[image[rows], :3, 3])  # the camera's, in body coordinates
    order = np.argsort(target[rows], kind="stable")
    cuts = np.flatnonzero(np.diff(target[rows][order])) + 1
    for mine in np.split(order, cuts):
        k = int(target[rows[mine[0]]])
        found = _fit(design[mine], seen[mine], centre[mine] - p_body[k])
        if found is not None:
            out.diameter[k], out.normal[k], out.sigma[k], out.images[k] = found
    return out


def size_ratio(seen: Discs, stated: ArrayLike) -> float | None:
    """How many times as large dots look as their diameters (t,) m are stated; None where nothing can be compared."""
    given = np.asarray(stated, dtype=float)
    both = np.isfinite(seen.diameter) & (np.nan_to_num(given) > 0)
    return float(np.median(seen.diameter[both] / given[both])) if both.any() else None


def modelled_discs(seen: Discs, stated: ArrayLike, points: ArrayLike) -> tuple[Array, Array | None]:
    """Diameters (t,) and normals (t, 3) to model the eccentricity with; normals None: those of the body's shape.

    Stated diameters (t,) m, 0 where unknown, hold; the others are measured by the ellipses and by how much the stated
    ones look too large. Points (t, 3) in a scale of their own, far from metres, get diameters in that scale. Where no
    diameter is stated at all none is made up: whether dots are large enough to matter is then left to the diagnosis.
    Normals from the body's shape are replaced where it has none, where they are looser than the ellipses (targets of
    different heights), and where the ellipses contradict them.
    """
    given = np.nan_to_num(np.asarray(stated, dtype=float))
    ratio = size_ratio(seen, given)
    if ratio is None:
        return given, None
    metric = 1.0 / _METRIC < ratio < _METRIC
    diameters = given if metric else given * ratio
    measured = np.nan_to_num(seen.diameter / ratio if metric else seen.diameter)
    diameters = np.where(given > 0, diameters, measured)
    normals, loose = shape_normals(points)
    cosine = np.abs(np.einsum("ti,ti->t", normals, seen.normal))
    known = np.isfinite(seen.sigma) & (seen.sigma < _FLAT)
    apart = np.arccos(np.clip(np.nan_to_num(cosine, nan=-1.0), 0.0, 1.0)) > np.maximum(_FLAT, 5.0 * seen.sigma)
    better = known & (apart | (seen.sigma < loose) | ~np.isfinite(normals).all(axis=1))
    if not better.any():
        return diameters, None
    return diameters, np.where(better[:, None], seen.normal, normals)


def facing_normals(modelled: ArrayLike, seen: Discs) -> Array:
    """Outer normals (t, 3): the modelled ones turned to the cameras, those of the ellipses where none is modelled.

    NaN where the ellipses do not determine which way a target faces.
    """
    normals = np.asarray(modelled, dtype=float)
    normals = np.where(np.isfinite(normals).all(axis=1)[:, None], normals, seen.normal)
    sign = np.where(np.einsum("ti,ti->t", normals, np.nan_to_num(seen.normal)) < 0, -1.0, 1.0)
    determined = np.isfinite(seen.sigma) & (seen.sigma < _FLAT)
    return np.where(determined[:, None], sign[:, None] * normals, np.nan)


def _columns(B: Array, i: int, j: int) -> Array:
    """Derivatives (m, 6) of ``(B A B')_ij`` by A's elements xx, yy, zz, xy, xz, yz."""
    a, b = B[:, i], B[:, j]
    mixed = [a[:, k] * b[:, q] + a[:, q] * b[:, k] for k, q in ((0, 1), (0, 2), (1, 2))]
    return np.column_stack([a * b, *mixed])


def _fit(design: Array, seen: Array, towards: Array) -> tuple[float, Array, float, int] | None:
    """Diameter, normal, its sigma and the number of ellipses (q); None where they make no disc."""
    for attempt in range(2):
        q = len(seen)
        if q < 3:
            return None
        X, y = design.reshape(-1, 6), seen.ravel()
        scale = np.sqrt(np.mean(X**2, axis=0))
        if not np.all(scale > 0):
            return None
        inverse = np.linalg.pinv(X / scale, rcond=1e-3) / scale[:, None]
        a = inverse @ y
        residual = np.linalg.norm((y - X @ a).reshape(-1, 3), axis=1)
        keep = residual < _GROSS * max(1.4826 * float(np.median(residual)), 1e-6)
        if attempt or keep.all():
            break
        design, seen, towards = design[keep], seen[keep], towards[keep]
    values, vectors = np.linalg.eigh(_symmetric(a))
    if values[1] < _ROUND * values[2] or abs(values[0]) > _ROUND * values[2]:
        return None
    normal = vectors[:, 0]
    square = 0.5 * float(values[1] + values[2])
    variance = float(np.sum((y - X @ a) ** 2)) / max(3 * q - 6, 1)
    # the normal turns by v_k' dA n / r^2 towards each of the other two vectors
    lever = np.stack([_bilinear(vectors[:, k], normal) for k in (1, 2)]) @ inverse / square
    sigma = float(np.sqrt(variance * np.sum(lever**2)))
    if normal @ towards.mean(axis=0) < 0:
        normal = -normal
    return 2.0 * float(np.sqrt(square)), normal, sigma, q


def _symmetric(a: Array) -> Array:
    xx, yy, zz, xy, xz, yz = a
    return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])


def _bilinear(u: Array, v: Array) -> Array:
    """Coefficients (6,) of ``u' A v`` in A's elements."""
    mixed = [u[k] * v[q] + u[q] * v[k] for k, q in ((0, 1), (0, 2), (1, 2))]
    return np.array([*(u * v), *mixed])
