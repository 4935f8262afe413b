"""Start values from a plane body of unknown coordinates: focal length and tilt from homographies between images.

With the plane ``n p = 1`` in the reference camera, plane coordinates are mapped to its pixels by ``K [e1 e2 n]``, so
image j sees them through ``M_j = K^-1 H_j K [e1 e2 n]``; metric plane coordinates require the first two columns of
every M_j to be orthogonal and of equal length. Three unknowns (focal length, two of the normal) are searched on a grid
and refined. Source: Triggs (1998), "Autocalibration from planar scenes"; Zhang (2000) for the constraints.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from scipy import optimize

from robcal.photogrammetry.core.camera import Camera
from robcal.photogrammetry.core.network import ImageMarks, IntArray
from robcal.transforms import Array


@dataclass(frozen=True)
class PlanarStart:
    """A candidate: focal length in px and plane coordinates (t, 3), z = 0, NaN where a target was not reached."""

    focal: float
    points: Array
    cost: float


def plane_share(marks: ImageMarks, reference: int, targets: int, size: float) -> float:
    """Share of marks that homographies from the reference explain to half a per cent of the image: 1 for a plane."""
    shares = []
    lookup = np.full((targets, 2), np.nan)
    own = marks.image == reference
    lookup[marks.target[own]] = marks.xy[own]
    for image in np.unique(marks.image):
        rows = np.flatnonzero((marks.image == image) & np.isfinite(lookup[marks.target, 0]))
        if image == reference or len(rows) < 6:
            continue
        _, mask = cv2.findHomography(lookup[marks.target[rows]], marks.xy[rows], cv2.RANSAC, 0.005 * size)
        # four points always fit
        shares.append(0.0 if mask is None else (float(mask.sum()) - 4.0) / (len(rows) - 4.0))
    return float(np.median(shares)) if shares else 1.0


def homographies(marks: ImageMarks, reference: int, targets: int, tolerance: float) -> list[tuple[int, Array]]:
    """(image, H) with ``xy_image ~ H xy_reference`` for images that share at least five targets with the reference."""
    lookup = np.full((targets, 2), np.nan)
    own = marks.image == reference
    lookup[marks.target[own]] = marks.xy[own]
    out = []
    for image in np.unique(marks.image):
        rows = np.flatnonzero(marks.image == image)
        rows = rows[np.isfinite(lookup[marks.target[rows], 0])]
        if image == reference or len(rows) < 5:
            continue
        H, mask = cv2.findHomography(lookup[marks.target[rows]], marks.xy[rows], cv2.RANSAC, tolerance)
        if H is not None and mask is not None and mask.sum() >= max(5, 0.6 * len(rows)):
            out.append((int(image), H))
    # a few dozen views tell all there is to tell; spread over the list
    return out if len(out) <= 30 else [out[i] for i in np.linspace(0, len(out) - 1, 30).astype(int)]


def _misfit(H: Array, focal: Array, normal: Array, centre: Array) -> Array:
    """Violations (..., j, 2) of the metric constraints; focal (...), normal (..., 3), H (j, 3, 3)."""
    helper = np.where(np.abs(normal[..., :1]) < 0.7, [1.0, 0.0, 0.0], [0.0, 1.0, 0.0])
    e1 = np.cross(normal, helper)
    e1 /= np.linalg.norm(e1, axis=-1, keepdims=True)
    e2 = np.cross(normal, e1)
    K = np.zeros((*focal.shape, 3, 3))
    K[..., 0, 0] = K[..., 1, 1] = focal
    K[..., 2, 2] = 1.0
    K[..., :2, 2] = centre
    M = np.linalg.inv(K)[..., None, :, :] @ H @ K[..., None, :, :]
    a = np.einsum("...jik,...k->...ji", M, e1)
    b = np.einsum("...jik,...k->...ji", M, e2)
    aa, bb, ab = np.sum(a * a, axis=-1), np.sum(b * b, axis=-1), np.sum(a * b, axis=-1)
    return np.stack([2.0 * ab / (aa + bb), (aa - bb) / (aa + bb)], axis=-1)


def planar_starts(
    marks: ImageMarks, reference: int, targets: int, camera: Camera, focal_known: bool, most: int = 3
) -> list[PlanarStart]:
    """Candidates, best first; empty if fewer than two (focal known) or three other images share enough targets."""
    size = max(camera.width, camera.height)
    pairs = homographies(marks, reference, targets, 0.01 * size)
    if len(pairs) < (1 if focal_known else 2):
        return []
    H = np.array([h for _, h in pairs])
    centre = np.array([camera.cx, camera.cy])
    focals = np.array([camera.fx]) if focal_known else size * np.geomspace(0.4, 6.0, 24)
    normals = _directions(400)
    misfit = _misfit(H, np.repeat(focals, len(normals)), np.tile(normals, (len(focals), 1)), centre)
    cost = np.sum(np.minimum(np.sum(misfit**2, axis=-1), 0.1), axis=-1)
    starts: list[tuple[float, float, Array]] = []
    for flat in np.argsort(cost)[:60]:
        f, n = float(focals[flat // len(normals)]), normals[flat % len(normals)]
        if any(abs(np.log(f / g)) < 0.3 and n @ m > 0.97 for _, g, m in starts):
            continue
        starts.append((float(cost[flat]), f, n))
        if len(starts) == 10:
            break
    found = []
    for _, f, n in starts:
        value, focal, normal = _refine(H, f, n, centre, focal_known)
        if 0.2 * size < focal < 20.0 * size and normal[2] > 0.05:
            points = _plane_points(marks, reference, pairs, targets, focal, normal, centre)
            found.append(PlanarStart(focal, points, value))
    found.sort(key=lambda s: s.cost)
    distinct: list[PlanarStart] = []
    for start in found:
        if all(abs(np.log(start.focal / s.focal)) > 0.02 or start.cost > 1.5 * s.cost for s in distinct):
            distinct.append(start)
    return distinct[:most]


def _refine(H: Array, focal: float, normal: Array, centre: Array, focal_known: bool) -> tuple[float, float, Array]:
    x0 = np.array([0.0, normal[0] / normal[2], normal[1] / normal[2]])

    def unpack(x: Array) -> tuple[float, Array]:
        n = np.array([x[-2], x[-1], 1.0])
        return focal * float(np.exp(np.clip(x[0] if len(x) == 3 else 0.0, -2, 2))), n / np.linalg.norm(n)

    def fun(x: Array) -> Array:
        f, n = unpack(x)
        return _misfit(H, np.array(f), n, centre).ravel()

    result = optimize.least_squares(fun, x0[1:] if focal_known else x0, loss="soft_l1", f_scale=0.02, max_nfev=60)
    f, n = unpack(result.x)
    return float(result.cost), f, n


def _directions(count: int) -> Array:
    """Unit vectors spread over the half sphere in front of the camera (Fibonacci lattice), at most 81 degrees off."""
    i = np.arange(count) + 0.5
    z = 1.0 - i / count * (1.0 - 0.15)
    phi = np.pi * (1.0 + 5.0**0.5) * i
    s = np.sqrt(1.0 - z**2)
    return np.stack([s * np.cos(phi), s * np.sin(phi), z], axis=1)


def _plane_points(
    marks: ImageMarks,
    reference: int,
    pairs: list[tuple[int, Array]],
    targets: int,
    focal: float,
    normal: Array,
    centre: Array,
) -> Array:
    """Targets on the plane by way of the reference image, medians over images; scaled to a spread of about 1."""
    sums: list[list[Array]] = [[] for _ in range(targets)]
    for image, H in [(reference, np.eye(3)), *pairs]:
        rows = np.flatnonzero(marks.image == image)
        back = np.column_stack([marks.xy[rows], np.ones(len(rows))]) @ np.linalg.inv(H).T
        with np.errstate(divide="ignore", invalid="ignore"):
            pixels = back[:, :2] / back[:, 2:]
        rays = np.column_stack([(pixels - centre) / focal, np.ones(len(rows))])
        along = rays @ normal
        for target, ray, s in zip(marks.target[rows], rays, along, strict=True):
            if s > 1e-3:
                sums[target].append(ray / s)
    points = np.full((targets, 3), np.nan)
    for target, candidates in enumerate(sums):
        if candidates:
            points[target] = np.median(candidates, axis=0)
    helper = np.array([1.0, 0.0, 0.0]) if abs(normal[0]) < 0.7 else np.array([0.0, 1.0, 0.0])
    e1 = np.cross(helper, normal)
    e1 /= np.linalg.norm(e1)
    flat = np.stack([points @ e1, points @ np.cross(normal, e1), np.zeros(targets)], axis=1)
    flat[~np.isfinite(points).all(axis=1)] = np.nan
    middle = np.nanmedian(flat, axis=0)
    spread = np.nanmedian(np.linalg.norm(flat - middle, axis=1))
    return (flat - middle) / max(float(spread), 1e-12)


def best_references(marks: ImageMarks, images: int, targets: int, most: int = 3) -> IntArray:
    """Images that share the most targets with the most others."""
    seen = np.zeros((images, targets))
    seen[marks.image, marks.target] = 1.0
    common = seen @ seen.T
    np.fill_diagonal(common, 0.0)
    score = np.sum(np.where(common >= 5, np.minimum(common, 20.0), 0.0), axis=1)
    order = np.argsort(-score)
    return order[score[order] > 0][:most].astype(np.int64)
