"""Compensation: the real tool comes where it is wanted, to first order in one step and exactly by iteration."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from robcal.errors import InvalidInput
from robcal.files.robot_file import read_robot
from robcal.robot.chain import chain_of, forward
from robcal.robot.compensation import CompensationSettings, cell_frames, compensate
from robcal.robot.inverse import inverse_kinematics, select
from robcal.robot.kernel import Kernel
from robcal.robot.model import Payload, RobotModel, Term
from robcal.transforms import difference, frame_from_xyzrpy, invert, retract

CONFIGS = Path(__file__).resolve().parents[2] / "configs" / "robots"
ROBOTS = sorted(p.stem for p in CONFIGS.glob("*.yaml"))
ONE_STEP = CompensationSettings(method="first_order")
NOMINAL = CompensationSettings(method="none")


def real_robot(name: str, rng: np.random.Generator, scale: float = 1.0) -> RobotModel:
    nominal = read_robot(CONFIGS / f"{name}.yaml")
    values = {f"{f.name}.{k}": scale * 4e-4 * rng.normal() for f in nominal.frames for k in ("x", "y", "z")}
    values |= {f"{f.name}.{k}": scale * 6e-4 * rng.normal() for f in nominal.frames for k in ("roll", "pitch", "yaw")}
    values |= {
        f"{f.name}.elastic_{f.joint_kind}": scale * c
        for f, c in zip(nominal.joints, np.geomspace(3e-7, 3e-6, nominal.n_joints), strict=True)
        if not f.prismatic
    }
    values |= {"base.yaw": 1e-3 * scale, "tool.x": 1e-3 * scale}
    mass = 0.1 * sum(f.mass for f in nominal.frames)
    return replace(
        nominal.with_parameters(values),
        payloads={"load": Payload(mass, (0.02, 0.0, 0.15))},
        world_T_base=frame_from_xyzrpy([2.0, -1.0, 0.1, 0.0, 0.0, 0.7]),
        flange_T_tool=frame_from_xyzrpy([0.05, 0.0, 0.25, 0.0, 0.0, 0.0]),
    )


def regular_poses(model: RobotModel, n: int, rng: np.random.Generator) -> np.ndarray:
    """Configurations away from limits, stretched elbows and aligned wrists."""
    chain = chain_of(model)
    low, high = np.maximum(chain.lower, -2.8), np.minimum(chain.upper, 2.8)
    q = low + (high - low) * rng.uniform(0.1, 0.9, (n, chain.n_joints))
    from robcal.robot.inverse import conditioning

    return q[conditioning(chain, q) > 0.03]


@pytest.mark.parametrize("name", ROBOTS)
def test_iteration_is_exact_and_one_step_nearly(name):
    rng = np.random.default_rng(1)
    model = real_robot(name, rng)
    kernel = Kernel(model)
    q = regular_poses(model, 60, rng)
    world_T_base, flange_T_tool = cell_frames(kernel)
    wanted = world_T_base @ forward(chain_of(model), q) @ flange_T_tool
    none = compensate(kernel, wanted, payload="load", near=q, settings=NOMINAL)
    one = compensate(kernel, wanted, payload="load", near=q, settings=ONE_STEP)
    exact = compensate(kernel, wanted, payload="load", near=q)
    position = [np.linalg.norm(c.remaining[:, :3], axis=1) for c in (none, one, exact)]
    assert np.all(exact.reachable)
    assert np.all(exact.converged)
    assert none.q == pytest.approx(q, abs=1e-6)
    assert np.median(position[0]) > 5e-4
    assert np.median(position[1]) < 0.05 * np.median(position[0])
    assert position[2].max() < 1e-9
    assert exact.before == pytest.approx(none.remaining, abs=1e-9)
    # what is said to remain is what remains
    real = kernel.frames(kernel.theta0, kernel.poses(exact.q, "load"))
    assert difference(wanted, real) == pytest.approx(exact.remaining, abs=1e-12)
    if model.n_joints >= 6:
        assert np.abs(exact.remaining[:, 3:]).max() < 1e-9


def test_one_step_is_exact_for_a_constant_frame_on_one_side():
    """Thesis section 3.6: real = nominal times one frame on the right; the nominal base and tool know nothing of it."""
    nominal = read_robot(CONFIGS / "irb120_like.yaml")
    real = nominal.with_parameters({"flange.x": 3e-3, "flange.pitch": 0.01, "flange.yaw": -0.02})
    q = np.array([[0.3, 0.4, -0.5, 0.4, 0.9, 0.3], [-1.0, 0.2, 0.3, -1.4, -0.8, 2.0]])
    answer = compensate(real, forward(chain_of(nominal), q), near=q, settings=ONE_STEP)
    assert np.abs(answer.before).max() > 1e-3
    assert np.abs(answer.remaining).max() < 1e-12


def test_first_order_is_the_formula_of_the_thesis():
    rng = np.random.default_rng(3)
    model = real_robot("irb120_like", rng)
    kernel, chain = Kernel(model), chain_of(model)
    q = regular_poses(model, 10, rng)
    W, L = cell_frames(kernel)
    F = forward(chain, q)
    Fh = invert(W) @ kernel.frames(kernel.theta0, kernel.poses(q, "load")) @ invert(L)
    F_star = F @ invert(Fh) @ F
    answer = compensate(kernel, W @ F @ L, payload="load", near=q, settings=ONE_STEP)
    assert answer.F_star == pytest.approx(W @ F_star @ L, abs=1e-10)
    assert answer.q == pytest.approx(select(inverse_kinematics(chain, F_star, q)).q, abs=1e-9)


def test_error_of_one_step_is_second_order():
    position = []
    for scale in (1.0, 0.1):
        rng = np.random.default_rng(4)
        model = real_robot("ur10", rng, scale)
        q = regular_poses(model, 40, rng)
        W, L = cell_frames(Kernel(model))
        answer = compensate(model, W @ forward(chain_of(model), q) @ L, payload="load", near=q, settings=ONE_STEP)
        position.append(np.median(np.linalg.norm(answer.remaining[:, :3], axis=1)))
    assert 30 < position[0] / position[1] < 300


def test_base_and_world_frames_give_the_same_command():
    rng = np.random.default_rng(5)
    model = real_robot("kr150_class", rng)
    W, L = cell_frames(Kernel(model))
    q = regular_poses(model, 10, rng)
    in_base = forward(chain_of(model), q) @ L
    a = compensate(model, in_base, payload="load", near=q, frame="base")
    b = compensate(model, W @ in_base, payload="load", near=q)
    assert a.q == pytest.approx(b.q, abs=1e-9)
    assert W @ a.F_star == pytest.approx(b.F_star, abs=1e-9)


def test_payload_and_covariates_of_each_pose_count():
    rng = np.random.default_rng(6)
    model = real_robot("kr150_class", rng)
    drift = Term("axis1.drift", "axis1", "x", "k*(temp_arm_c - 20)", {"k": 1e-5}, {"k": "m/K"}, {"k": 1e-5})
    model = replace(model, terms=(drift,))
    q = np.tile(regular_poses(model, 10, rng)[:1], (3, 1))
    W, L = cell_frames(Kernel(model))
    wanted = W @ forward(chain_of(model), q) @ L
    answer = compensate(model, wanted, payload=["load", None, "load"], covariates={"temp_arm_c": [20, 20, 60]}, near=q)
    assert np.abs(answer.remaining).max() < 1e-9
    assert np.abs(answer.q[0] - answer.q[1]).max() > 1e-4
    assert np.abs(answer.q[0] - answer.q[2]).max() > 1e-5


def test_target_only_the_real_robot_reaches_is_reached():
    """Fully stretched, the nominal robot is a little too short for where the real one is."""
    nominal = read_robot(CONFIGS / "irb120_like.yaml")
    real = nominal.with_parameters({"axis3.z": 1e-3})
    kernel = Kernel(real)
    q = np.array([[0.3, 0.4, -np.arctan2(302, 70) + 0.004, 0.4, 0.9, 0.3]])
    wanted = kernel.frames(kernel.theta0, kernel.poses(q))
    assert not compensate(kernel, wanted, near=q, settings=ONE_STEP).reachable[0]
    answer = compensate(kernel, wanted, near=q)
    assert answer.reachable[0]
    assert np.abs(answer.remaining).max() < 1e-9


def test_correction_does_not_change_the_configuration():
    """Where the near branch of the corrected target ends, the command must not flip to another one."""
    rng = np.random.default_rng(9)
    model = real_robot("ur10", rng)
    W, L = cell_frames(Kernel(model))
    q = rng.uniform(-2.8, 2.8, (400, 6))
    wanted = W @ forward(chain_of(model), q) @ L
    for settings in (ONE_STEP, None):
        answer = compensate(model, wanted, payload="load", near=q, settings=settings)
        moved = np.abs(answer.q - q)[answer.reachable].max(axis=1)
        assert np.mean(answer.reachable) > 0.9
        assert moved.max() < 1.0


def test_unreachable_frames_are_marked_and_the_others_done():
    model = real_robot("irb120_like", np.random.default_rng(7))
    W, L = cell_frames(Kernel(model))
    q = np.array([[0.3, 0.4, -0.5, 0.4, 0.9, 0.3]] * 2)
    wanted = W @ forward(chain_of(model), q) @ L
    wanted[1] = retract(wanted[1], [0, 0, 5.0, 0, 0, 0])
    answer = compensate(model, wanted, payload="load", near=q)
    assert answer.reachable.tolist() == [True, False]
    assert answer.reason[0] is None
    assert "outside the workspace" in str(answer.reason[1])
    assert np.all(np.isnan(answer.q[1]))
    with pytest.raises(InvalidInput, match="frame 2"):
        answer.require()


def test_bad_requests_are_refused():
    model = real_robot("irb120_like", np.random.default_rng(8))
    with pytest.raises(InvalidInput, match="unknown payload 'anvil'"):
        compensate(model, np.eye(4), payload="anvil")
    with pytest.raises(InvalidInput, match="not finite"):
        compensate(model, np.full((4, 4), np.inf))
    with pytest.raises(InvalidInput, match="iteration"):
        compensate(model, np.eye(4), settings=CompensationSettings(iterations=0))
