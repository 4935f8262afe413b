"""Simulated stations for the tests: cameras that watch a plate in many poses, with their own projection."""

from dataclasses import dataclass, replace

import numpy as np

from robcal.photogrammetry.core.bodies import Body
from robcal.photogrammetry.core.camera import Camera, project
from robcal.photogrammetry.station.network import StationMarks
from robcal.transforms import Array, exp_so3, frame, invert, transform

SIZE = (2448, 2048)
PLATE = np.array([[0, 0, 0], [0.25, 0.02, 0], [0.22, 0.3, 0], [-0.03, 0.26, 0], [0.1, 0.12, 0]])


@dataclass
class Station:
    """Truth and marks; ``marks`` may be changed by a test."""

    body: Body
    true_points: Array
    cameras: dict[str, Camera]
    world_T_camera: dict[str, Array]
    world_T_body: Array
    marks: dict[str, StationMarks]

    @property
    def sizes(self) -> dict[str, tuple[int, int]]:
        return dict.fromkeys(self.cameras, SIZE)

    @property
    def rough(self) -> dict[str, Camera]:
        """Start values as from a data sheet: no distortion, centred, focal length 3 % off."""
        return {name: Camera(*SIZE, 3500.0, 3500.0, 1223.5, 1023.5) for name in self.cameras}

    def change(self, name: str, **columns: Array) -> None:
        self.marks[name] = replace(self.marks[name], **columns)


def look_at(position: Array, target: Array, roll: float = 0.0) -> Array:
    z = np.asarray(target, dtype=float) - position
    z /= np.linalg.norm(z)
    x = np.cross([0.0, 0.0, -1.0], z)
    x /= np.linalg.norm(x)
    return frame(np.column_stack([x, np.cross(z, x), z]) @ exp_so3([0, 0, roll]), position)


def simulate(
    seed: int = 0,
    poses: int = 40,
    cameras: int = 2,
    points: Array | int = PLATE,
    sigma: float = 0.02,
    body_sigma: float = 5e-6,
    missing: float = 0.0,
    flat: bool = True,
) -> Station:
    """A station whose first camera is the world; noise ``sigma`` px, body coordinates known to ``body_sigma`` m."""
    rng = np.random.default_rng(seed)
    if isinstance(points, int):
        depth = np.zeros(points) if flat else rng.uniform(-0.08, 0.08, points)
        points = np.column_stack([rng.uniform(-0.25, 0.25, (points, 2)), depth])
    t = len(points)
    given = points + rng.normal(size=points.shape) * body_sigma
    covariance = np.eye(3 * t) * body_sigma**2 if body_sigma > 0 else None
    body = Body("plate", 11 * np.arange(1, t + 1), given, covariance)
    centre = np.array([0.3, 3.0, 1.0])
    places = np.array([[0, 0, 1.0], [1.6, 0.1, 1.2], [-1.5, 0.2, 1.1]])[:cameras]
    frames = [look_at(p, centre, 0.05 * i) for i, p in enumerate(places)]
    names = ["left", "right", "middle"][:cameras]
    lenses = [
        Camera(*SIZE, 3600.0 + 20 * i, 3600.0 + 20 * i, 1220.0 + 5 * i, 1030.0, -0.08, 0.05, 2e-4, -1e-4, 0.0)
        for i in range(cameras)
    ]
    first = invert(frames[0])
    bodies = []
    for _ in range(poses):
        p = centre + rng.uniform(-1, 1, 3) * [0.6, 0.6, 0.45]
        turn = exp_so3([*rng.uniform(-0.6, 0.6, 2), rng.uniform(-3, 3)]) @ np.diag([1.0, -1.0, -1.0])
        bodies.append(first @ frame(look_at(p, [0, 0, 1.0])[:3, :3] @ turn, p))
    world_T_body = np.array(bodies)
    marks = {}
    for name, lens, place in zip(names, lenses, frames, strict=True):
        xy = project(lens, transform((invert(first @ place) @ world_T_body)[:, None], points))
        inside = np.isfinite(xy).all(-1) & (xy > 5).all(-1) & (xy < np.array(SIZE) - 5).all(-1)
        inside &= rng.uniform(size=inside.shape) >= missing
        pose, target = np.nonzero(inside)
        noisy = xy[inside] + rng.normal(size=(len(pose), 2)) * sigma
        marks[name] = StationMarks(pose, body.ids[target], noisy, np.tile(np.eye(2) * sigma**2, (len(pose), 1, 1)))
    return Station(
        body,
        points,
        dict(zip(names, lenses, strict=True)),
        {n: first @ f for n, f in zip(names, frames, strict=True)},
        world_T_body,
        marks,
    )


def nees(error: Array, covariance: Array) -> Array:
    """Normalised estimation error squared per degree of freedom, one per row."""
    return np.einsum("ni,nij,nj->n", error, np.linalg.inv(covariance), error) / error.shape[1]
