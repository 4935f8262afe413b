"""Poses that cannot separate base and tool: named with the remedy, and what can be estimated is estimated."""

import re
from dataclasses import replace

import numpy as np
import pytest

from robcal import transforms as tf
from robcal.calibration.identification import IdentifiedRobot, identify
from robcal.calibration.observations import FrameObservations, Observations, PointObservations
from robcal.errors import NotIdentifiable
from robcal.robot.chain import chain_of, forward
from robcal.robot.inverse import inverse_kinematics, select
from robcal.robot.kernel import Kernel
from robcal.robot.model import RobotModel
from tests.robot.chains import kr_like

MODEL = kr_like()
CHAIN = chain_of(MODEL)
MIDDLE = np.radians([10.0, -20.0, 100.0, 15.0, -40.0, 20.0])
WORLD_T_BASE = tf.frame_from_xyzrpy([3.0, 1.0, 0.5, 0.1, -0.2, 2.0])
FLANGE_T_TOOL = tf.frame_from_xyzrpy([0.1, 0.05, 0.3, 0.5, 0.2, -1.0])
SIGMA = 5e-5
BODY = {"points of one target": [[0.0, 0.0, 0.0]], "points": [[0.0, 0.0, 0.0], [0.2, 0.0, 0.0], [0.0, 0.2, 0.1]]}


def translated(spread: tuple[float, float, float], wobble: float = 0.0) -> np.ndarray:
    """Poses with the flange's orientation constant but for ``wobble`` (rad)."""
    rng = np.random.default_rng(1)
    T = np.repeat(forward(CHAIN, MIDDLE[None]), 40, axis=0)
    T[:, :3, 3] += rng.uniform(-1, 1, (40, 3)) * spread
    T[:, :3, :3] = T[:, :3, :3] @ tf.exp_so3(wobble * rng.normal(size=(40, 3)))
    q = select(inverse_kinematics(CHAIN, T, np.repeat(MIDDLE[None], 40, axis=0))).q
    return q[np.all(np.isfinite(q), axis=1)]


def one_joint(k: int) -> np.ndarray:
    return MIDDLE + np.outer(np.linspace(-1, 1, 20), np.eye(6)[k])


SETS = {
    "constant": translated((0.3, 0.3, 0.3)),
    "nearly constant": translated((0.3, 0.3, 0.3), 1e-4),
    "planar": translated((0.3, 0.3, 0.0)),
    "joint 1": one_joint(0),
    "joint 4": one_joint(3),
}


def measured(q: np.ndarray, kind: str) -> tuple[Kernel, list[Observations], np.ndarray]:
    """A robot with small deviations, measured with noise; its true frames (n, 4, 4) besides."""
    rng, n = np.random.default_rng(2), len(q)
    kernel = Kernel(MODEL)
    theta = kernel.theta(
        {f"{f.name}.{k}": 3e-4 * rng.normal() for f in MODEL.frames for k in ("x", "y", "z", "roll", "pitch", "yaw")}
    )
    T = kernel.with_references(WORLD_T_BASE, FLANGE_T_TOOL).frames(theta, kernel.poses(q))
    if kind == "frames":
        return kernel, [FrameObservations.isotropic(tf.retract(T, SIGMA * rng.normal(size=(n, 6))), SIGMA, SIGMA)], T
    body = np.array(BODY[kind])
    pose, target = np.repeat(np.arange(n), len(body)), np.tile(np.arange(len(body)), n)
    p = tf.transform(T[pose], body[target]) + SIGMA * rng.normal(size=(len(pose), 3))
    C = np.broadcast_to(SIGMA**2 * np.eye(3), (len(pose), 3, 3))
    return kernel, [PointObservations(pose=pose, p_tool=body[target], p_world=p, covariance=C, target=target)], T


def identified(q: np.ndarray, kind: str, model: RobotModel = MODEL) -> tuple[IdentifiedRobot, np.ndarray]:
    """The identified robot and the error (n,) of its tool's place at the same poses."""
    kernel, observations, T = measured(q, kind)
    found = identify(model, Kernel(model).poses(q), observations)
    there = Kernel(found.model).frames(Kernel(found.model).theta0, kernel.poses(q))
    return found, np.linalg.norm(there[:, :3, 3] - T[:, :3, 3], axis=1)


@pytest.mark.parametrize("kind", ["frames", *BODY])
@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("constant", "orientation is constant"),
        ("nearly constant", "orientation is constant"),
        ("planar", "orientation is constant"),
        ("joint 1", "only joint .*1 moves"),
        ("joint 4", "only joint .*4 moves"),
    ],
)
def test_deficient_sets_are_named_and_bounded(name, words, kind):
    found, error = identified(SETS[name], kind)
    assert found.summary.converged
    assert 0.7 < found.sigma0 < 1.4
    assert error.max() < 6 * SIGMA
    assert np.linalg.norm(found.model.world_T_base[:3, 3] - WORLD_T_BASE[:3, 3]) < 0.8
    assert np.linalg.norm(found.model.flange_T_tool[:3, 3]) < 0.6
    assert re.search(r"tool\.[xyz]|uncertain by \d\d mm", found.deficiency)
    for word in ("base and tool cannot be separated", "30 deg", "flange_T_tool"):
        assert word in found.deficiency
    assert re.search(words, found.deficiency)


@pytest.mark.parametrize("kind", ["frames", *BODY])
@pytest.mark.parametrize("name", ["constant", "planar"])
def test_a_stated_tool_is_held_and_gives_the_base(name, kind):
    found, error = identified(SETS[name], kind, replace(MODEL, flange_T_tool=FLANGE_T_TOOL))
    assert error.max() < 6 * SIGMA
    assert np.linalg.norm(found.model.world_T_base[:3, 3] - WORLD_T_BASE[:3, 3]) < 0.02
    assert found.model.flange_T_tool[:3, 3] == pytest.approx(FLANGE_T_TOOL[:3, 3], abs=1e-4)


@pytest.mark.parametrize("kind", ["frames", *BODY])
def test_a_good_set_is_not_blamed(kind):
    found, _ = identified(np.random.default_rng(3).uniform(-1, 1, (40, 6)), kind)
    assert found.deficiency == ""


@pytest.mark.parametrize("kind", ["frames", *BODY])
def test_two_poses_are_refused_with_what_is_missing(kind):
    with pytest.raises(NotIdentifiable, match=r"at least 3 poses|measure more poses"):
        identified(np.random.default_rng(3).uniform(-1, 1, (2, 6)), kind)
