"""Hand-eye calibration against a true camera and board: what it finds, how sure it is, and what it refuses."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from fixtures.hand_eye import Scene, board_points, exchanged, place, scene, turn
from robcal.errors import InvalidInput, NotIdentifiable
from robcal.files.robot_import import read_any_robot
from robcal.handeye.calibration import Options, calibrate
from robcal.handeye.closed_form import solve_many
from robcal.handeye.data import HandEyeData, RobotParameters
from robcal.handeye.problem import Problem
from robcal.handeye.unknowns import Layout, State
from robcal.photogrammetry.core.bodies import Body
from robcal.photogrammetry.core.camera import Camera
from robcal.robot.kernel import Kernel
from robcal.transforms import difference, invert, retract

pytestmark = pytest.mark.unit
ROBOT = Path(__file__).parents[2] / "configs" / "robots" / "irb120_like.yaml"


def data_of(seen: Scene) -> HandEyeData:
    """What is known of a scene: marks and commanded flanges, the true lens as start values."""
    lens = seen.lens
    camera = Camera(lens.width, lens.height, lens.fx, lens.fy, lens.cx, lens.cy, *lens.distortion)
    body = Body("board", np.arange(len(seen.board)), seen.board)
    covariance = np.broadcast_to(seen.sigma_px**2 * np.eye(2), (len(seen.image), 2, 2)).copy()
    return HandEyeData(camera, seen.mounted, seen.commanded, body, seen.image, seen.target, seen.xy, covariance)


def small(seed: int = 5, mounted: str = "hand", n: int = 14, **more: object) -> Scene:
    """A quick scene."""
    return scene(np.random.default_rng(seed), mounted, n, 0.1, (1e-4, 1e-4), **more)  # type: ignore[arg-type]


@pytest.mark.parametrize("mounted", ["hand", "world"])
def test_derivatives_are_those_of_the_residuals(mounted: str) -> None:
    seen = small(mounted=mounted, n=4)
    data = data_of(seen)
    robot = Kernel(read_any_robot(ROBOT))
    # nearly one pose, so that the board stays before the camera; the joints may still all move
    q = np.array([0.1, 0.2, -0.3, 0.4, 0.5, 0.6]) + 0.02 * np.random.default_rng(1).normal(size=(4, 6))
    data = replace(data, robot=RobotParameters.of(robot, robot.poses(q)))
    assert data.robot is not None
    zero = np.zeros(len(data.robot.names))
    data = replace(data, base_T_flange=data.robot.flanges(zero)[0])
    none = np.zeros(4, dtype=np.int64)
    layout = Layout(none, np.array([0, 0, 1, 1]), np.arange(9), np.arange(4), robot=True)
    problem = Problem(data, layout, np.ones(len(data.image), dtype=bool))
    view = place(turn(np.array([0.3, 0.2, 0.5])), np.array([0.0, 0.0, 0.5]))
    Z = (data.carriers()[0] @ seen.X @ view) @ np.array([np.eye(4), place(np.eye(3), np.array([0.01, 0.0, 0.0]))])
    state = State(
        data.camera, seen.X[None], Z, np.full(4, 1e-3), np.full(len(data.robot.names), 1e-4), np.zeros((4, 6))
    )
    r, J, K = problem.rows(state)
    assert np.isfinite(r).all()
    h = 1e-6
    for k in range(J.shape[2]):
        step = np.zeros(J.shape[2])
        step[k] = h
        up, down = (problem.residuals(problem.moved(state, s, state.twist)) for s in (step, -step))
        np.testing.assert_allclose((down - up) / (2 * h), J[:, :, k], rtol=2e-4, atol=1e-4 * np.abs(J).max())
    for k in range(6):
        twist = np.zeros((4, 6))
        twist[:, k] = h
        up, down = (problem.residuals(replace(state, twist=t)) for t in (twist, -twist))
        np.testing.assert_allclose((down - up) / (2 * h), K[:, :, k], rtol=2e-4, atol=1e-6 * np.abs(K).max())


def test_closed_form_has_no_singular_angle() -> None:
    """Half turns, tiny turns and shifts among them: exact data give the exact answer."""
    rng = np.random.default_rng(2)
    X, Z = place(turn(rng.normal(size=3)), rng.normal(size=3)), place(turn(rng.normal(size=3)), rng.normal(size=3))
    half = [place(turn(np.pi * axis), rng.normal(size=3)) for axis in np.eye(3)]
    tiny = [place(turn(1e-3 * rng.normal(size=3)), rng.normal(size=3)) for _ in range(5)]
    shifts = [place(np.eye(3), rng.normal(size=3)) for _ in range(3)]
    for motions in ([np.eye(4), *tiny], [*half, *tiny, *shifts], [np.eye(4), *half, *tiny]):
        A = np.array(motions)
        B = np.linalg.inv(Z) @ A @ X
        X1, Z1 = solve_many(A[None], B[None])
        np.testing.assert_allclose(X1[0], X, atol=1e-5)
        np.testing.assert_allclose(Z1[0], Z, atol=1e-5)


@pytest.mark.parametrize("mounted", ["hand", "world"])
def test_camera_and_board_are_found_within_what_is_stated(mounted: str) -> None:
    seen = small(7, mounted)
    found = calibrate(data_of(seen))
    error = np.concatenate([difference(seen.X, found.X), difference(seen.Z, found.Z)])
    assert np.sum(error * np.linalg.solve(found.covariance, error)) < 32.9  # chi-square (12), 0.1 %
    assert found.used.all()
    assert 0.9 < found.variances.pixel < 1.1
    assert 0.5e-4 < found.variances.place < 2e-4
    assert found.heldout is not None
    assert found.heldout.images == 14


def dots_in_place_of_corners(seen: Scene, radius: float) -> Scene:
    """The scene with the centroids of the images of dots (polygons of 90 corners) in place of projected centres."""
    noise = np.random.default_rng(1).normal(size=seen.xy.shape) * seen.sigma_px
    angle = np.linspace(0, 2 * np.pi, 90, endpoint=False)
    rim = radius * np.column_stack([np.cos(angle), np.sin(angle), np.zeros(90)])
    views = np.array([np.linalg.inv(seen.X) @ np.linalg.inv(F) @ seen.Z for F in seen.actual])[seen.image]
    p = seen.board[seen.target][:, None] + rim
    x, y = np.moveaxis(seen.lens.see(np.einsum("mij,mkj->mki", views[:, :3, :3], p) + views[:, None, :3, 3]), -1, 0)
    x1, y1 = np.roll(x, -1, axis=1), np.roll(y, -1, axis=1)
    cross = x * y1 - x1 * y
    centre = [((a + b) * cross).sum(axis=1) / (3 * cross.sum(axis=1)) for a, b in ((x, x1), (y, y1))]
    return replace(seen, xy=np.column_stack(centre) + noise)


def test_the_centre_of_an_ellipse_is_not_taken_for_the_centre_of_its_dot() -> None:
    quiet = scene(np.random.default_rng(3), "hand", 14, 0.01)
    data = data_of(dots_in_place_of_corners(quiet, 0.008))
    body = replace(data.body, diameters=np.full(len(data.body), 0.016))
    found = calibrate(replace(data, body=body))
    error = np.concatenate([difference(quiet.X, found.X), difference(quiet.Z, found.Z)])
    assert np.sum(error * np.linalg.solve(found.covariance, error)) < 32.9  # chi-square (12), 0.1 %
    assert found.heldout is not None
    assert found.heldout.px < 0.03
    # and without the diameters the marks are far from where they should be
    plain = calibrate(data)
    assert plain.heldout is not None
    assert plain.heldout.px > 5 * found.heldout.px


def test_without_start_values_the_camera_is_calibrated_as_well() -> None:
    seen = small(3)
    blank = replace(data_of(seen), camera=Camera.from_size(1280, 960))
    found = calibrate(blank, Options(start_camera=False))
    assert abs(found.camera.fx - seen.lens.fx) < 5 * found.camera_sigma["fx"]
    error = difference(seen.X, found.X)
    assert np.all(np.abs(error) < 5 * found.sigma[:6])


def test_a_robot_that_is_off_gets_no_tiny_sigmas() -> None:
    seen = scene(np.random.default_rng(4), "hand", 16, 0.1, (2e-3, 3e-3))
    found = calibrate(data_of(seen))
    assert 1.2e-3 < found.variances.place < 3e-3
    assert 2e-4 < found.sigma[0] < 2e-3
    assert np.all(np.abs(difference(seen.X, found.X)) < 4 * found.sigma[:6])


def test_exchanged_images_are_left_out_and_named() -> None:
    found = calibrate(data_of(exchanged(small(6), 4, 9)))
    assert {r.image for r in found.rejected} == {4, 9}
    assert "pose {9}" in next(r.reason for r in found.rejected if r.image == 4)


@pytest.mark.parametrize("size", [1.0, 0.03])
def test_a_board_that_was_pushed_is_told(size: float) -> None:
    push = place(turn(size * np.array([0.0, 0.0, 0.1])), size * np.array([0.05, 0.02, 0.0]))
    seen = small(8, bump=(7, push))
    found = calibrate(data_of(seen))
    assert found.moved is not None
    assert found.moved.kind == "board"
    assert found.moved.image == 7
    error = difference(retract(np.eye(4), found.moved.change), push)
    assert np.all(np.abs(error) < 5 * np.sqrt(np.diag(found.moved.covariance)))
    assert np.all(np.abs(difference(seen.X, found.X)) < 5 * found.sigma[:6])


def test_a_board_printed_too_large_and_bent_is_measured() -> None:
    middle = board_points().mean(axis=0)
    seen = small(9, shape=lambda p: p * 1.004 + 0.3 * (p[:, :1] - middle[0]) ** 2 * np.array([0.0, 0.0, 1.0]))
    found = calibrate(data_of(seen))
    assert abs(found.shape["scale"] - 0.004) < 4 * found.shape_sigma["scale"]
    assert abs(found.shape["bend_xx"] - 0.3) < 0.01


def test_motions_that_cannot_tell_are_refused_with_the_missing_one_named() -> None:
    rng = np.random.default_rng(1)
    seen = small(10)
    with pytest.raises(NotIdentifiable, match="three or more"):
        calibrate(data_of(seen).select([0, 1]))
    F0 = seen.commanded[0]
    spin = np.array(
        [F0 @ place(turn(np.array([0, 0, a])), rng.normal(size=3) * 0.05) for a in np.linspace(-0.6, 0.6, 14)]
    )
    with pytest.raises(NotIdentifiable, match=r"one direction only \(0.00, 0.00, 1.00.*about its [xy] or [xy] axis"):
        calibrate(replace(data_of(seen), base_T_flange=spin))
    shifts = np.array([F0 @ place(np.eye(3), rng.normal(size=3) * 0.05) for _ in range(14)])
    with pytest.raises(NotIdentifiable, match="never turns"):
        calibrate(replace(data_of(seen), base_T_flange=shifts))


def test_the_wrong_mounting_is_named() -> None:
    seen = small(11)
    with pytest.raises(InvalidInput, match="mounted: hand"):
        calibrate(replace(data_of(seen), mounted="world"))


def test_geometry_of_the_robot_is_found_where_the_images_carry_it() -> None:
    robot = read_any_robot(ROBOT)
    true = {"axis2.pitch": 4e-3, "axis3.pitch": -3e-3, "axis4.roll": 5e-3, "axis3.x": 1e-3, "axis5.pitch": 4e-3}
    rng = np.random.default_rng(3)
    n = 30
    nominal, actual = Kernel(robot), Kernel(robot.with_parameters(true))
    q = rng.uniform(-0.7, 0.7, (n, 6)) + np.array([0.0, 0.2, -0.2, 0.0, 0.8, 0.0])
    F, F0 = (k.frames(k.theta0, k.poses(q)) for k in (actual, nominal))
    # the board hangs a little before each camera: every pose sees another part of a large one
    board = board_points(30, 30, 0.05)
    X = place(turn(np.array([0.1, 0.05, 0.3])), np.array([0.05, 0.02, 0.06]))
    views = F @ X
    away = np.mean(views[:, :3, 2], axis=0)
    R = turn(np.cross([0.0, 0.0, 1.0], away / np.linalg.norm(away)))
    Z = place(R, np.mean(views[:, :3, 3], axis=0) + 0.7 * away / np.linalg.norm(away) - R @ board.mean(axis=0))
    lens = small().lens
    p = np.einsum("nij,tj->nti", (invert(views) @ Z)[:, :3, :3], board) + (invert(views) @ Z)[:, None, :3, 3]
    xy = lens.see(p)
    inside = (p[..., 2] > 0.05) & (np.abs(xy - [640, 480]) < [640, 480]).all(axis=-1)
    image, target = np.nonzero(inside)
    camera = Camera(lens.width, lens.height, lens.fx, lens.fy, lens.cx, lens.cy, *lens.distortion)
    marks = xy[inside] + 0.1 * rng.normal(size=(len(image), 2))
    keep = rng.random(len(image)) < min(1.0, 25 * n / len(image))
    data = HandEyeData(
        camera,
        "hand",
        F0,
        Body("board", np.arange(len(board)), board),
        image[keep],
        target[keep],
        marks[keep],
        np.broadcast_to(0.01 * np.eye(2), (int(keep.sum()), 2, 2)).copy(),
        RobotParameters.of(nominal, nominal.poses(q)),
    )
    held = calibrate(data, Options(hold_camera=True))
    found = calibrate(data, Options(hold_camera=True, adjust_robot=True))
    assert found.heldout is not None
    assert held.heldout is not None
    assert found.robot_names
    assert found.heldout.mm < 0.3 * held.heldout.mm
    assert np.all(np.abs(difference(X, found.X)) < 5 * found.sigma[:6])
