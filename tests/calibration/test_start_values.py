"""Base and tool without a guess, from every kind of observation, exact for exact data."""

import numpy as np
import pytest

from robcal import transforms as tf
from robcal.calibration.identification import start_state
from robcal.calibration.observations import (
    DistanceObservations,
    FrameObservations,
    PixelObservations,
    PointObservations,
    SensorPointObservations,
    Stack,
)
from robcal.calibration.problem import Evaluator
from robcal.calibration.start_values import candidates, hand_eye
from robcal.errors import NotIdentifiable
from robcal.photogrammetry.core.camera import Camera, project
from robcal.robot.kernel import Kernel, PoseInputs
from robcal.robot.model import Frame, RobotModel
from robcal.transforms import Array
from tests.robot.chains import kr_like


def _setup(seed: int = 0, n: int = 40) -> tuple[np.random.Generator, Kernel, PoseInputs, Array, Array, Array]:
    rng = np.random.default_rng(seed)
    kernel = Kernel(kr_like())
    poses = kernel.poses(rng.uniform(-1, 1, (n, 6)))
    W = tf.frame_from_xyzrpy([*rng.normal(0, 2, 3), *rng.uniform(-3, 3, 3)])
    F = tf.frame_from_xyzrpy([*rng.normal(0, 0.2, 3), *rng.uniform(-1.5, 1.5, 3)])
    return rng, kernel, poses, W, F, kernel.with_references(W, F).frames(kernel.theta0, poses)


@pytest.mark.parametrize("seed", range(5))
def test_frames(seed: int) -> None:
    _, kernel, poses, W, F, M = _setup(seed)
    (pair, ratio) = hand_eye(kernel.frames(kernel.theta0, poses), M)
    np.testing.assert_allclose(pair[0], W, atol=1e-9)
    np.testing.assert_allclose(pair[1], F, atol=1e-9)
    assert ratio < 0.95


def test_gross_errors_do_not_spoil_it() -> None:
    rng, kernel, poses, W, _, M = _setup()
    M = M.copy()
    M[:3, :3, 3] += 1.0
    (pair,) = candidates(kernel.frames(kernel.theta0, poses), [FrameObservations.isotropic(M, 1e-4, 1e-4)])
    np.testing.assert_allclose(pair[0], W, atol=1e-6)
    assert rng is not None


@pytest.mark.parametrize(("n", "targets"), [(40, 1), (9, 1), (30, 2), (30, 3)])
def test_points(n: int, targets: int) -> None:
    """One target a pose, in turn."""
    rng, kernel, poses, W, F, M = _setup(1, n)
    body = rng.normal(0, 0.2, (targets, 3))
    which = np.arange(n) % targets
    p = tf.transform(M, body[which])
    observed = PointObservations(np.arange(n), body[which], p, np.broadcast_to(1e-8 * np.eye(3), (n, 3, 3)), which)
    stack = Stack([observed], n)
    state = start_state(Evaluator(kernel, poses, stack), [observed])
    T = kernel.with_references(state.world_T_base, state.flange_T_tool).frames(kernel.theta0, poses)
    assert np.abs(stack.evaluate(T).r).max() < 1e-6
    np.testing.assert_allclose(state.world_T_base, W, atol=1e-5)
    assert F.shape == (4, 4)


def test_distances_sensor_and_pixels() -> None:
    rng, kernel, poses, W, F, M = _setup(2, 60)
    n = len(poses)
    distance = DistanceObservations(np.arange(n), np.linalg.norm(M[:, :3, 3], axis=1), np.full(n, 1e-4))
    world = rng.normal(0, 0.3, (n, 3)) + M[:, :3, 3].mean(axis=0)
    in_sensor = tf.transform(tf.invert(M), world)
    sensor = SensorPointObservations(np.arange(n), in_sensor, world, np.broadcast_to(1e-8 * np.eye(3), (n, 3, 3)))
    camera = Camera.from_size(2000, 2000)
    c_T_w = np.stack([tf.invert(tf.frame_from_xyzrpy([*(W @ [8.0, s, 1.0, 1.0])[:3], 0, 0, 0])) for s in (-3, 3)])
    # cameras that look at the base: z axis towards it
    looking = []
    for c in c_T_w:
        centre = tf.invert(c)[:3, 3]
        z = (W[:3, 3] - centre) / np.linalg.norm(W[:3, 3] - centre)
        x = np.cross([0, 0, 1.0], z)
        x /= np.linalg.norm(x)
        looking.append(tf.invert(tf.frame(np.column_stack([x, np.cross(z, x), z]), centre)))
    body = rng.normal(0, 0.2, (5, 3))
    rows = [(i, c, k) for i in range(n) for c in range(2) for k in range(5)]
    pose, cam, target = (np.array(v) for v in zip(*rows, strict=True))
    p_camera = tf.transform(np.stack(looking)[cam], tf.transform(M[pose], body[target]))
    xy = project(camera, p_camera)
    pixels = PixelObservations(
        pose,
        cam,
        body[target],
        xy,
        np.broadcast_to(0.01 * np.eye(2), (len(pose), 2, 2)),
        (camera, camera),
        np.stack(looking),
    )
    for observed in (distance, sensor, pixels):
        stack = Stack([observed], n)
        state = start_state(Evaluator(kernel, poses, stack), [observed])
        T = kernel.with_references(state.world_T_base, state.flange_T_tool).frames(kernel.theta0, poses)
        limit = 1e-3 if observed is pixels else 1e-6
        assert np.abs(stack.evaluate(T).r).max() < limit, type(observed).__name__
    assert F.shape == (4, 4)


def test_scara_whose_turns_share_one_axis() -> None:
    """The rotations alone leave the base's turn open; the translations settle it."""
    scara = RobotModel(
        "scara",
        (
            Frame("a", "z", xyz=(0, 0, 0.3)),
            Frame("b", "z", xyz=(0.4, 0, 0)),
            Frame("c", "z", prismatic=True, xyz=(0.3, 0, 0)),
            Frame("d", "z"),
        ),
    )
    rng = np.random.default_rng(0)
    kernel = Kernel(scara)
    poses = kernel.poses(rng.uniform([-2, -2, -0.2, -3], [2, 2, 0.0, 3], (30, 4)))
    W, F = tf.frame_from_xyzrpy([1, 2, 3, 0.2, 0.1, 2.0]), tf.frame_from_xyzrpy([0.05, 0.02, 0.1, 0.3, 0.2, 0.1])
    M = kernel.with_references(W, F).frames(kernel.theta0, poses)
    observed = FrameObservations.isotropic(M, 1e-4, 1e-4)
    stack = Stack([observed], 30)
    state = start_state(Evaluator(kernel, poses, stack), [observed])
    T = kernel.with_references(state.world_T_base, state.flange_T_tool).frames(kernel.theta0, poses)
    np.testing.assert_allclose(T, M, atol=1e-6)


def test_nothing_to_construct_from_is_said() -> None:
    _, kernel, poses, _, _, M = _setup(0, 3)
    observed = PointObservations(
        np.arange(2), np.zeros((2, 3)), M[:2, :3, 3], np.broadcast_to(np.eye(3), (2, 3, 3)), np.zeros(2)
    )
    with pytest.raises(NotIdentifiable, match="start values"):
        start_state(Evaluator(kernel, poses, Stack([observed], 3)), [observed])
