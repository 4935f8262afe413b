"""Simulated survey networks for the tests; dots are projected as polygons, not by the library's formulas."""

from dataclasses import dataclass
from types import SimpleNamespace

import numpy as np

from robcal.photogrammetry.core.camera import Camera, project
from robcal.photogrammetry.core.network import ImageMarks
from robcal.photogrammetry.survey.survey import SurveyImage
from robcal.transforms import Array, frame, transform


@dataclass(frozen=True)
class Truth:
    """A simulated network and its error-free content."""

    camera: Camera
    camera_T_body: Array
    points: Array
    normals: Array
    diameter: float
    marks: ImageMarks
    sigma: float


def plate_points(rng: np.random.Generator, count: int, width: float = 1.0, height: float = 0.8) -> Array:
    """Points of a nearly plane plate, irregular enough to be told apart."""
    side = int(np.ceil(np.sqrt(count)))
    grid = np.stack(np.meshgrid(np.linspace(-0.5, 0.5, side), np.linspace(-0.5, 0.5, side)), -1).reshape(-1, 2)
    grid = grid[np.sort(rng.permutation(len(grid))[:count])] * [width, height]
    grid += rng.uniform(-0.15, 0.15, grid.shape) * width / side
    return np.column_stack([grid, rng.normal(0.0, 0.001, count)])


def sphere_points(rng: np.random.Generator, count: int, radius: float = 0.2) -> Array:
    """Points spread over a sphere (Fibonacci lattice, jittered)."""
    i = np.arange(count) + 0.5
    z = 1.0 - 2.0 * i / count
    phi = np.pi * (1.0 + 5.0**0.5) * i
    s = np.sqrt(1.0 - z**2)
    v = np.stack([s * np.cos(phi), s * np.sin(phi), z], axis=1) + rng.normal(0, 0.03, (count, 3))
    return radius * v / np.linalg.norm(v, axis=1, keepdims=True)


def cube_points(rng: np.random.Generator, count: int, half: float = 0.15) -> tuple[Array, Array]:
    """Points and outer normals of dots on the six faces of a cube, as many on each."""
    points, normals = [], []
    for k in range(count):
        axis, side = k % 3, 1.0 if (k // 3) % 2 else -1.0
        p = rng.uniform(-0.8 * half, 0.8 * half, 3)
        p[axis] = side * half
        points.append(p)
        normals.append(side * np.eye(3)[axis])
    return np.array(points), np.array(normals)


def disc_outline(camera: Camera, p_camera: Array, normal: Array, radius: float, corners: int = 720) -> Array:
    """Image (corners, 2) of the edge of a disc: brute force."""
    helper = np.array([1.0, 0.0, 0.0]) if abs(normal[0]) < 0.7 else np.array([0.0, 1.0, 0.0])
    e1 = np.cross(normal, helper)
    e1 /= np.linalg.norm(e1)
    e2 = np.cross(normal, e1)
    angle = np.linspace(0.0, 2.0 * np.pi, corners, endpoint=False)[:, None]
    return project(camera, p_camera + radius * (np.cos(angle) * e1 + np.sin(angle) * e2))


def polygon_axes(outline: Array) -> tuple[Array, float]:
    """Semi-axes (2,), major first, and angle of the major one of the ellipse through an outline (corners, 2)."""
    x, y = (outline - outline.mean(axis=0)).T
    # conic through the outline: a x^2 + b xy + c y^2 + d x + e y = 1
    a, b, c, d, e = np.linalg.lstsq(np.column_stack([x * x, x * y, y * y, x, y]), np.ones(len(x)), rcond=None)[0]
    form = np.array([[a, b / 2], [b / 2, c]])
    centre = np.linalg.solve(form, [-d / 2, -e / 2])
    values, vectors = np.linalg.eigh(form / (1.0 + centre @ form @ centre))
    return 1.0 / np.sqrt(values), float(np.arctan2(vectors[1, 0], vectors[0, 0]))


def polygon_centre(camera: Camera, p_camera: Array, normal: Array, radius: float, corners: int = 720) -> Array:
    """Area centroid (2,) of the image of a disc, from its outline as a polygon: brute force."""
    outline = disc_outline(camera, p_camera, normal, radius, corners)
    origin = outline.mean(axis=0)
    a, b = outline - origin, np.roll(outline - origin, -1, axis=0)
    cross = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
    return origin + ((a + b) * cross[:, None]).sum(axis=0) / (3.0 * cross.sum())


def make_network(
    rng: np.random.Generator,
    body: str = "plate",
    *,
    images: int = 16,
    targets: int = 30,
    focal_factor: float = 1.3,
    sigma: float = 0.05,
    diameter: float = 0.0,
    distortion: tuple[float, ...] = (-0.12, 0.08, 2e-4, -3e-4, -0.01),
    size: tuple[int, int] = (2400, 1800),
    tilt: tuple[float, float] = (0.1, 0.8),
    rolled: bool = True,
) -> Truth:
    """Cameras rolled and all around a plate, a sphere or a cube, marks with independent normal noise."""
    width, height = size
    f = focal_factor * width
    camera = Camera(width, height, f, f * 1.0004, width / 2 + 12.0, height / 2 - 8.0, *distortion)
    if body == "plate":
        points, normals = plate_points(rng, targets), np.tile([0.0, 0.0, 1.0], (targets, 1))
    elif body == "cube":
        points, normals = cube_points(rng, targets)
    else:
        points = sphere_points(rng, targets)
        normals = points / 0.2
    reach = float(np.max(np.linalg.norm(points, axis=1)))
    poses = []
    for _ in range(images):
        if body == "plate":
            azimuth, t = rng.uniform(0, 2 * np.pi), rng.uniform(*tilt)
            view = np.array([np.cos(azimuth) * np.sin(t), np.sin(azimuth) * np.sin(t), np.cos(t)])
        else:
            view = rng.normal(size=3)
            view /= np.linalg.norm(view)
        z = -view
        up = rng.normal(size=3) if rolled else np.array([0.0, 1.0, 0.01])
        x = np.cross(up, z)
        x /= np.linalg.norm(x)
        R = np.stack([x, np.cross(z, x), z])
        aim = rng.normal(0.0, 0.03 * reach, 3)
        poses.append(frame(R, -R @ (aim + view * reach * 2.3 * focal_factor * rng.uniform(0.95, 1.25))))
    T = np.array(poses)
    image, target = (a.ravel() for a in np.meshgrid(np.arange(images), np.arange(targets), indexing="ij"))
    p = transform(T[image], points[target])
    n = np.einsum("mij,mj->mi", T[image, :3, :3], normals[target])
    xy = project(camera, p)
    seen = np.all((xy > 12) & (xy < [width - 12, height - 12]), axis=1)
    if body != "plate":
        seen &= np.einsum("mi,mi->m", n, p) / np.linalg.norm(p, axis=1) < -0.3
    image, target, xy, p, n = image[seen], target[seen], xy[seen], p[seen], n[seen]
    if diameter:
        # a dot on a sphere ends in a plane below its centre
        depth = 0.2 - np.sqrt(0.2**2 - diameter**2 / 4) if body == "sphere" else 0.0
        xy = np.array([polygon_centre(camera, a - depth * b, b, diameter / 2) for a, b in zip(p, n, strict=True)])
    covariance = np.tile(np.eye(2) * sigma**2, (len(image), 1, 1))
    marks = ImageMarks(image, target, xy + rng.normal(0.0, sigma, xy.shape), covariance)
    return Truth(camera, T, points, normals, diameter, marks, sigma)


def detections(
    truth: Truth, coded: int, rng: np.random.Generator, *, clutter: int = 0, ids: Array | None = None
) -> list[SurveyImage]:
    """Images whose first ``coded`` targets carry codes (``ids``, default 100 + row), the others none."""
    marks, out = truth.marks, []
    for j in range(len(truth.camera_T_body)):
        rows = rng.permutation(np.flatnonzero(marks.image == j))
        code = np.where(marks.target[rows] < coded, 100 + marks.target[rows], -1)
        if ids is not None:
            code = np.where(marks.target[rows] < coded, np.asarray(ids)[marks.target[rows]], -1)
        extra = rng.uniform([20, 20], [truth.camera.width - 20, truth.camera.height - 20], (clutter, 2))
        xy = np.concatenate([marks.xy[rows], extra])
        m = len(xy)
        depth = transform(truth.camera_T_body[j], truth.points[marks.target[rows]])[:, 2]
        major = 0.5 * (truth.diameter or 0.008) * truth.camera.fx / depth
        axes = np.concatenate([major, rng.uniform(2.0, 20.0, clutter)])
        axes, angle = np.column_stack([axes, 0.9 * axes]), np.full(m, np.nan)
        if truth.diameter:
            for k, row in enumerate(rows):
                T, at = truth.camera_T_body[j], marks.target[row]
                p, n = transform(T, truth.points[at]), T[:3, :3] @ truth.normals[at]
                axes[k], angle[k] = polygon_axes(disc_outline(truth.camera, p, n, truth.diameter / 2, 60))
                axes[k] *= 1.0 + rng.normal(0.0, 0.003, 2)
        found = SimpleNamespace(
            xy=xy,
            covariance=np.tile(np.eye(2) * truth.sigma**2, (m, 1, 1)),
            semi_axes=axes,
            angle=angle,
            kind=np.zeros(m, dtype=np.int64),
            code=np.concatenate([code, np.full(clutter, -1)]).astype(np.int64),
            message="",
        )
        out.append(SurveyImage(f"img{j:03d}.png", detections=found))  # type: ignore[arg-type]
    return out


def aligned_error(points: Array, truth: Array, *, scale: bool) -> Array:
    """Errors (t, 3) in the frame of ``points`` after a least-squares similarity of truth onto points."""
    a, b = points - points.mean(axis=0), truth - truth.mean(axis=0)
    U, _, Vt = np.linalg.svd(a.T @ b)
    R = U @ np.diag([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))]) @ Vt
    moved = b @ R.T
    factor = float(np.sum(a * moved) / np.sum(moved**2)) if scale else 1.0
    return a - factor * moved
