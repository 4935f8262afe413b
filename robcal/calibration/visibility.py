"""What the cameras of a station would see of the measuring body at a pose, and how well they would measure it.

A target counts as seen by a camera if it lies in the image, faces the camera within the largest angle of incidence,
appears large enough, and no link of the robot stands in the line of sight. From the image points that remain, the
information on the body's frame follows by the derivatives of the projection (collinearity equations).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from robcal.calibration.collision import PlacedCapsules, segment_distance
from robcal.errors import InvalidInput
from robcal.photogrammetry.core.bodies import Body
from robcal.photogrammetry.core.camera import Camera, project, project_with_jacobians
from robcal.transforms import Array, invert, skew, transform

_SIGHT_MARGIN = 0.02


@dataclass(frozen=True)
class Viewpoint:
    """A camera of the station: interior orientation and where it stands (4, 4)."""

    name: str
    camera: Camera
    world_T_camera: Array


@dataclass(frozen=True)
class VisibilityRules:
    """When a pose can be measured.

    Attributes
    ----------
    cameras : so many cameras must see so many ``targets`` each (the same or not).
    incidence : rad; largest angle between a target's normal and the line to the camera.
    margin_px : distance from the image border.
    diameter_px : smallest diameter of a dot's image (major axis), where its diameter is known.
    facing : (3,) side of a flat body that carries the targets, body coordinates (used where no normals are known).
    """

    cameras: int = 2
    targets: int = 3
    incidence: float = np.deg2rad(60.0)
    margin_px: float = 15.0
    diameter_px: float = 5.0
    facing: tuple[float, float, float] = (0.0, 0.0, 1.0)


def target_normals(body: Body, facing: Sequence[float] = (0.0, 0.0, 1.0)) -> Array:
    """Outward normals (t, 3); of a flat body on the side of ``facing``; unknown ones are ``facing`` itself."""
    front = np.asarray(facing, dtype=float)
    front = front / np.linalg.norm(front)
    normals = body.estimated_normals()
    if body.normals is None and body.is_plane():
        normals = np.where((normals @ front)[:, None] < 0, -normals, normals)
    return np.where(np.isfinite(normals), normals, front)


def seen_targets(
    world_T_body: Array,
    body: Body,
    viewpoints: Sequence[Viewpoint],
    rules: VisibilityRules,
    occluders: PlacedCapsules | None = None,
    world_T_base: Array | None = None,
) -> NDArray[np.bool_]:
    """Which targets each camera sees at each pose, (n, cameras, t).

    Parameters
    ----------
    world_T_body : (n, 4, 4) frames of the body.
    occluders : the robot's capsules at these poses in base coordinates; what the flange carries is left out.

    Raises
    ------
    InvalidInput : no cameras, or a body without coordinates.
    """
    if not viewpoints:
        raise InvalidInput("no camera with known position is given: visibility cannot be judged")
    known = body.known
    if not np.any(known):
        raise InvalidInput(f"body {body.name} has no target with coordinates: survey it first")
    points = np.where(known[:, None], body.points, 0.0)
    p_world = transform(world_T_body[:, None], points[None])
    normals = np.einsum("nij,tj->nti", world_T_body[:, :3, :3], target_normals(body, rules.facing))
    diameters = np.where(np.isfinite(body.diameters), body.diameters, np.inf)
    out = np.zeros((len(world_T_body), len(viewpoints), len(body)), bool)
    for k, view in enumerate(viewpoints):
        camera = view.camera
        p_camera = transform(invert(view.world_T_camera), p_world)
        with np.errstate(invalid="ignore", divide="ignore"):
            xy = project(camera, p_camera)
            inside = (p_camera[..., 2] > 0) & np.all(xy >= rules.margin_px, axis=-1)
            inside &= (xy[..., 0] <= camera.width - 1 - rules.margin_px) & (
                xy[..., 1] <= camera.height - 1 - rules.margin_px
            )
            large = camera.fx * diameters / p_camera[..., 2] >= rules.diameter_px
        ray = view.world_T_camera[:3, 3] - p_world
        ray /= np.linalg.norm(ray, axis=-1, keepdims=True)
        facing = np.sum(ray * normals, axis=-1) >= np.cos(rules.incidence)
        out[:, k] = inside & large & facing & known
    if occluders is not None:
        eyes = np.array([view.world_T_camera[:3, 3] for view in viewpoints])
        out &= ~_hidden(p_world, eyes, occluders, np.eye(4) if world_T_base is None else world_T_base)
    return out


def measurable(seen: NDArray[np.bool_], rules: VisibilityRules) -> NDArray[np.bool_]:
    """Poses (n,) at which enough cameras see enough targets."""
    return np.sum(np.sum(seen, axis=2) >= rules.targets, axis=1) >= rules.cameras


def frame_information(
    world_T_body: Array, body: Body, viewpoints: Sequence[Viewpoint], seen: NDArray[np.bool_], sigma_px: float
) -> Array:
    """Information (n, 6, 6) on the right twist of the body's frame from the image points seen."""
    points = np.where(body.known[:, None], body.points, 0.0)
    p_world = transform(world_T_body[:, None], points[None])
    n, t = p_world.shape[:2]
    # p_world of a twist (rho, omega) on the right of the frame: R (rho - [p] omega)
    by_twist = np.concatenate([np.broadcast_to(np.eye(3), (t, 3, 3)), -skew(points)], axis=2)
    by_twist = np.einsum("nij,tjk->ntik", world_T_body[:, :3, :3], by_twist)
    out = np.zeros((n, 6, 6))
    for k, view in enumerate(viewpoints):
        camera_T_world = invert(view.world_T_camera)
        p_camera = transform(camera_T_world, p_world)
        # points that are not seen may lie behind the camera: any point in front stands for them, with no weight
        p_camera = np.where(seen[:, k, :, None], p_camera, np.array([0.0, 0.0, 1.0]))
        _, by_point, _ = project_with_jacobians(view.camera, p_camera)
        J = by_point @ (camera_T_world[:3, :3] @ by_twist)
        J = J * seen[:, k, :, None, None]
        out += np.einsum("ntpi,ntpj->nij", J, J) / sigma_px**2
    return out


def _hidden(p_world: Array, eyes: Array, occluders: PlacedCapsules, world_T_base: Array) -> NDArray[np.bool_]:
    """Lines of sight (n, cameras, t) that a link crosses."""
    n, t = p_world.shape[:2]
    hidden = np.zeros((n, len(eyes), t), bool)
    if not len(occluders.radius):
        return hidden
    carried = int(occluders.link.max())
    start, end = transform(world_T_base, occluders.start), transform(world_T_base, occluders.end)
    for c in range(len(occluders.radius)):
        if occluders.link[c] == carried and carried > 0:
            continue  # what carries the body touches the lines' ends; its back side is the incidence's business
        for k, eye in enumerate(eyes):
            near_target = p_world + _SIGHT_MARGIN * (eye - p_world)
            gap = segment_distance(np.broadcast_to(eye, p_world.shape), near_target, start[:, c, None], end[:, c, None])
            hidden[:, k] |= gap < occluders.radius[c]
    return hidden
