"""Poses that would sharpen a hand-eye calibration most: views of the board that the robot can reach, chosen greedily.

What an image would tell of camera and board is known before it is taken; the next pose is the one after which the
volume of the camera's uncertainty is smallest (D-optimality of a part of the unknowns, Atkinson, Donev, Tobias 2007).
"""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from robcal.errors import InvalidInput
from robcal.handeye.data import BoolArray, HandEyeData, Mounted
from robcal.handeye.problem import Problem
from robcal.handeye.unknowns import Layout, State, Variances
from robcal.photogrammetry.core.bodies import Body
from robcal.photogrammetry.core.camera import Camera, project
from robcal.robot.inverse import inverse_kinematics
from robcal.robot.model import RobotModel
from robcal.transforms import Array, exp_so3, frame, invert, transform

CONE = np.radians(50.0)
"""Largest angle between the board's normal and the line of sight."""
SHARE = (0.35, 0.9)
"""Part of the image's height that the board's longest side takes, from the farthest view to the nearest."""
SEEN = 0.7
"""Least share of the board's targets that a view must show."""
LOOSE = np.array([0.1] * 3 + [0.2] * 3)
"""Standard deviations (m, rad) of guessed frames before the first image."""


@dataclass(frozen=True)
class ViewRequest:
    """What is wanted.

    Attributes
    ----------
    model : the robot; camera, body, mounted, X, Z : as in :class:`robcal.handeye.result.HandEye`, guesses will do.
    count : number of poses; candidates : views that are tried; distance : (nearest, farthest) m, None for the image.
    information : (12, 12) of X and Z from images that there are; None before the first.
    variances : noise of marks (px) and scatter of the robot (m, rad). free : which configurations (n, N) are free of
        collisions; None if all are.
    """

    model: RobotModel
    camera: Camera
    body: Body
    mounted: Mounted
    X: Array
    Z: Array
    count: int = 20
    candidates: int = 600
    distance: tuple[float, float] | None = None
    information: Array | None = None
    variances: Variances = field(default_factory=lambda: Variances(0.1, 1e-4, 2e-4))
    free: Callable[[Array], BoolArray] | None = None
    seed: int = 0


@dataclass(frozen=True)
class ViewPlan:
    """``q`` (n, N) rad or m in the order in which they were chosen; standard deviations (12,) of X and Z with them."""

    q: Array
    sigma: Array
    tried: int = 0
    reachable: int = field(default=0)


def propose_views(request: ViewRequest) -> ViewPlan:
    """Choose poses.

    Raises
    ------
    InvalidInput : no view of the board can be reached.
    """
    views = _views(request)
    A = request.Z @ invert(views) @ invert(request.X)
    flange = A if request.mounted == "hand" else invert(A)
    q, of = _reached(request, flange)
    if not len(q):
        raise InvalidInput(
            f"none of {len(views)} views of board '{request.body.name}' can be reached without collision: check the "
            "frames of camera and board, and the distances"
        )
    information = _information(request, flange[of], views[of])
    total = np.diag(np.tile(LOOSE, 2) ** -2.0) + (0.0 if request.information is None else request.information)
    chosen: list[int] = []
    for _ in range(min(request.count, len(q))):
        volume = np.linalg.slogdet(np.linalg.inv(total + information)[:, :6, :6])[1]
        volume[chosen] = np.inf
        best = int(np.argmin(volume))
        chosen.append(best)
        total = total + information[best]
    sigma = np.sqrt(np.diag(np.linalg.inv(total)))
    return ViewPlan(q[chosen], sigma, len(views), len(q))


def information_of(data: HandEyeData, X: Array, Z: Array, variances: Variances) -> Array:
    """(n, 12, 12) what each image tells of camera and board, lens and robot held."""
    none = np.zeros(data.n, dtype=np.int64)
    layout = Layout(none, none, none[:0], none[:0])
    problem = Problem(data, layout, np.ones(len(data.image), dtype=bool))
    state = State(data.camera, X[None], Z[None], np.zeros(4), np.zeros(0), np.zeros((data.n, 6)))
    system = problem.system(state)
    scale = 1.0 / np.sqrt(np.maximum(np.diagonal(system.V, axis1=1, axis2=2), 1e-300))
    unit = system.V * scale[:, :, None] * scale[:, None, :]
    noise = np.linalg.pinv(unit, rcond=1e-10, hermitian=True) * scale[:, :, None] * scale[:, None, :]
    H = noise @ np.swapaxes(system.G, 1, 2)
    C = variances.pixel**2 * noise + np.diag(variances.twist**2 + 1e-14)
    return np.asarray(np.swapaxes(H, 1, 2) @ np.linalg.solve(C, H))


def _views(request: ViewRequest) -> Array:
    """Random views (k, 4, 4) ``camera_T_board`` from within a cone about the board's front, with most of it in view."""
    rng = np.random.default_rng(request.seed)
    points = request.body.points[request.body.known]
    centre, size = points.mean(axis=0), float(np.ptp(points, axis=0).max())
    camera = request.camera
    near, far = request.distance or tuple(camera.fy * size / (share * camera.height) for share in SHARE[::-1])
    k = request.candidates
    azimuth, tilt = rng.uniform(0.0, 2.0 * np.pi, k), CONE * np.sqrt(rng.random(k))
    spin = exp_so3(np.column_stack([np.zeros(k), np.zeros(k), rng.uniform(-np.pi, np.pi, k)]))
    lean = exp_so3(np.column_stack([tilt * np.cos(azimuth), tilt * np.sin(azimuth), np.zeros(k)]))
    R = spin @ lean
    depth = np.exp(rng.uniform(np.log(near), np.log(far), k))
    room = 0.5 * depth[:, None] * np.array([camera.width / camera.fx, camera.height / camera.fy]) - 0.4 * size
    aside = rng.uniform(-1.0, 1.0, (k, 2)) * np.maximum(room, 0.0)
    views = frame(R, np.column_stack([aside, depth]) - R @ centre)
    xy = project(camera, transform(views[:, None], points))
    edge = np.array([camera.width - 1.0, camera.height - 1.0])
    inside = np.mean(np.all((xy > 0.0) & (xy < edge), axis=-1), axis=1)
    return np.asarray(views[inside >= SEEN])


def _reached(request: ViewRequest, flange: Array) -> tuple[Array, np.ndarray]:
    """Configurations (m, N) that reach flanges (k, 4, 4) within the limits and free of collisions, and which ones."""
    solutions = inverse_kinematics(request.model, flange)
    row, branch = np.nonzero(np.isfinite(solutions.q).all(axis=-1) & solutions.within_limits)
    first = np.unique(row, return_index=True)[1]
    row, branch = row[first], branch[first]
    q = solutions.q[row, branch]
    if request.free is not None and len(q):
        good = request.free(q)
        q, row = q[good], row[good]
    return q, row


def _information(request: ViewRequest, flange: Array, views: Array) -> Array:
    points = request.body.points[request.body.known]
    xy = project(request.camera, transform(views[:, None], points))
    edge = np.array([request.camera.width - 1.0, request.camera.height - 1.0])
    image, target = np.nonzero(np.all((xy > 0.0) & (xy < edge), axis=-1))
    data = HandEyeData(
        request.camera,
        request.mounted,
        flange,
        request.body,
        image,
        np.flatnonzero(request.body.known)[target],
        xy[image, target],
        np.broadcast_to(np.eye(2), (len(image), 2, 2)),
    )
    return information_of(data, request.X, request.Z, request.variances)
