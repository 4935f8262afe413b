"""Inverse kinematics: FK(IK) = identity for every ready robot and for random arms, branches, limits, reasons."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from robcal.errors import InvalidInput
from robcal.files.robot_file import read_robot
from robcal.robot.chain import Chain, chain_of, forward, forward_and_jacobian
from robcal.robot.inverse import SINGULAR_CONDITION, conditioning, follow, inverse_kinematics, select
from robcal.robot.kernel import Kernel
from robcal.robot.model import Frame, RobotModel
from robcal.transforms import difference, frame_from_xyzrpy
from tests.robot.chains import kr_like, random_chain

CONFIGS = Path(__file__).resolve().parents[2] / "configs" / "robots"
ROBOTS = sorted(p.stem for p in CONFIGS.glob("*.yaml"))
METHODS = {
    "kr150_class": "spherical wrist",
    "irb120_like": "spherical wrist",
    "ur10": "parallel arm",
    "scara_600": "numeric",
    "palletiser": "numeric",
    "kr150_class_on_track": "spherical wrist on a track",
}
MODELS = {name: read_robot(CONFIGS / f"{name}.yaml") for name in ROBOTS}


def unlimited(chain: Chain) -> Chain:
    return replace(chain, lower=np.full(chain.n_joints, -np.inf), upper=np.full(chain.n_joints, np.inf))


def joint_values(chain: Chain, rng: np.random.Generator, n: int) -> np.ndarray:
    low, high = np.maximum(chain.lower, -np.pi), np.minimum(chain.upper, np.pi)
    return rng.uniform(low, high, (n, chain.n_joints))


def random_wrist_arm(rng: np.random.Generator, kind: str) -> RobotModel:
    """Six axes with arbitrary fixed frames in between whose lines have the wanted structure at zero."""
    axes, points = rng.normal(size=(6, 3)), rng.normal(size=(6, 3))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    if kind == "parallel_arm":
        axes[2], axes[3] = axes[1], -axes[1]
        points[5] = points[4]
    else:
        points[4] = points[5] = points[3]
        if kind == "parallel_23":
            axes[2] = -axes[1]
        if kind == "meeting_12":
            points[1] = points[0]
        if kind == "parallel_12":
            axes[1] = axes[0]
    # frames whose z are these lines; the turn to each line stands in a fixed frame before it
    frames, T = [], np.eye(4)
    for k in range(6):
        line = np.eye(4)
        z = axes[k]
        x = np.cross(z, rng.normal(size=3))
        x /= np.linalg.norm(x)
        line[:3, :3] = np.stack([x, np.cross(z, x), z], axis=1)
        line[:3, 3] = points[k] + rng.normal() * z
        gap = np.linalg.inv(T) @ line
        from robcal.transforms import xyzrpy_from_frame

        six = xyzrpy_from_frame(gap)
        frames.append(Frame(f"to{k + 1}", None, xyz=tuple(six[:3]), rpy=tuple(six[3:])))
        frames.append(Frame(f"axis{k + 1}", "z", sign=int(rng.choice([-1, 1]))))
        T = line
    frames.append(Frame("flange", None, xyz=tuple(rng.normal(size=3)), rpy=tuple(rng.uniform(-1, 1, 3))))
    return RobotModel(kind, tuple(frames))


@given(seed=st.integers(0, 2**20))
@settings(max_examples=30, deadline=None)
def test_chain_agrees_with_the_kernel(seed):
    rng = np.random.default_rng(seed)
    model = random_chain(rng)
    kernel = Kernel(model)
    q = rng.uniform(-2, 2, (3, model.n_joints))
    poses = kernel.poses(q)
    T, J = forward_and_jacobian(chain_of(model), q)
    assert kernel.frames(kernel.theta0, poses) == pytest.approx(T, abs=1e-12)
    assert kernel.joint_jacobian(kernel.theta0, poses) == pytest.approx(J, abs=1e-12)


@pytest.mark.parametrize("name", ROBOTS)
@given(seed=st.integers(0, 2**20))
@settings(max_examples=25, deadline=None)
def test_forward_of_inverse_is_the_identity(name, seed):
    rng = np.random.default_rng(seed)
    chain = chain_of(MODELS[name])
    q = joint_values(chain, rng, 4)
    T = forward(chain, q)
    solutions = inverse_kinematics(chain, T, q)
    assert solutions.method == METHODS[name]
    rows, branches = np.nonzero(np.all(np.isfinite(solutions.q), axis=-1))
    assert np.abs(difference(forward(chain, solutions.q[rows, branches]), T[rows])).max() < 2e-8
    # the configuration the frame came from is among them
    chosen = select(solutions, q)
    assert np.all(chosen.reachable)
    assert chosen.q == pytest.approx(q, abs=1e-5)


@pytest.mark.parametrize("kind", ["parallel_23", "meeting_12", "parallel_12", "parallel_arm"])
@given(seed=st.integers(0, 2**20))
@settings(max_examples=40, deadline=None)
def test_structure_is_found_behind_arbitrary_fixed_frames(kind, seed):
    rng = np.random.default_rng(seed)
    chain = chain_of(random_wrist_arm(rng, kind))
    q = rng.uniform(-np.pi, np.pi, (6, 6))
    T = forward(chain, q)
    solutions = inverse_kinematics(chain, T, q)
    assert solutions.method == ("parallel arm" if kind == "parallel_arm" else "spherical wrist")
    rows, branches = np.nonzero(solutions.within_limits)
    assert np.abs(difference(forward(chain, solutions.q[rows, branches]), T[rows])).max() < 1e-8
    regular = conditioning(chain, q) > 1e-3
    assert select(solutions, q).q[regular] == pytest.approx(q[regular], abs=1e-6)
    assert np.all(solutions.count[regular] % 2 == 0)


@pytest.mark.parametrize(("name", "count"), [("irb120_like", 8), ("ur10", 8), ("scara_600", 2)])
def test_number_of_branches(name, count):
    chain = chain_of(MODELS[name])
    if chain.n_joints == 6:
        chain = unlimited(chain)
    q = np.array([0.3, 0.4, -0.5, 0.4, 0.9, 0.3]) if chain.n_joints == 6 else np.array([0.3, 0.7, 0.1, 0.2])
    if name == "ur10":
        q = np.array([0.3, -1.2, 1.0, 0.4, 0.9, 0.3])
    solutions = inverse_kinematics(chain, forward(chain, q))
    assert solutions.count[0] == count
    distinct = solutions.q[0][solutions.within_limits[0]]
    gaps = np.abs(np.sin(0.5 * (distinct[:, None] - distinct[None]))).max(-1) + np.eye(len(distinct))
    assert gaps.min() > 1e-3


def test_numeric_search_finds_the_branches_of_the_closed_form():
    """A robot just outside the closed form's tolerance has nearly the same branches."""
    model = MODELS["irb120_like"]
    bent = replace(
        model,
        frames=tuple(replace(f, xyz=(f.xyz[0], 0.004, f.xyz[2])) if f.name == "axis5" else f for f in model.frames),
    )
    q = np.array([0.3, 0.4, -0.5, 0.4, 0.9, 0.3])
    closed = inverse_kinematics(unlimited(chain_of(model)), forward(chain_of(model), q), q)
    numeric = inverse_kinematics(unlimited(chain_of(bent)), forward(chain_of(bent), q), q)
    assert numeric.method == "numeric"
    found = numeric.q[0][np.all(np.isfinite(numeric.q[0]), axis=-1)]
    for branch in closed.q[0]:
        assert np.abs(np.sin(0.5 * (found - branch))).max(-1).min() < 0.05


def test_rounded_exports_still_take_the_closed_form():
    """A tenth of a millimetre off the structure (a CAD export) is refined away on the true chain."""
    model = MODELS["irb120_like"]
    rounded = replace(
        model,
        frames=tuple(replace(f, xyz=(f.xyz[0], 1e-4, f.xyz[2])) if f.name == "axis5" else f for f in model.frames),
    )
    chain = chain_of(rounded)
    q = np.array([[0.3, 0.4, -0.5, 0.4, 0.9, 0.3], [-1.0, -0.2, 0.3, 2.0, -1.0, 0.0]])
    solutions = inverse_kinematics(chain, forward(chain, q), q)
    assert solutions.method == "spherical wrist"
    assert select(solutions, q).q == pytest.approx(q, abs=1e-9)


def test_whole_turns_keep_near_the_start_and_inside_the_limits():
    chain = chain_of(MODELS["irb120_like"])  # axis 6: +-400 degrees
    q = np.array([0.1, 0.2, 0.1, 0.3, 0.5, 0.2])
    T = forward(chain, q)
    for start, expected in ((6.5, 0.2 + 2 * np.pi), (-6.0, 0.2 - 2 * np.pi), (0.0, 0.2), (40.0, 0.2 + 2 * np.pi)):
        near = q.copy()
        near[5] = start
        assert select(inverse_kinematics(chain, T, near)).q[0, 5] == pytest.approx(expected, abs=1e-9)


def test_singular_wrist_keeps_the_free_joint():
    chain = chain_of(MODELS["irb120_like"])
    q = np.array([0.3, 0.4, -0.5, 0.7, 0.0, -0.3])
    assert conditioning(chain, q)[0] < SINGULAR_CONDITION
    chosen = select(inverse_kinematics(chain, forward(chain, q), q))
    assert chosen.q[0] == pytest.approx(q, abs=1e-9)
    other = q.copy()
    other[3] = -0.4
    chosen = select(inverse_kinematics(chain, forward(chain, q), other))
    assert chosen.q[0, 3] == pytest.approx(-0.4, abs=1e-9)
    assert forward(chain, chosen.q) == pytest.approx(forward(chain, q), abs=1e-12)


def test_stretched_arm_still_has_its_solution():
    chain = chain_of(MODELS["ur10"])
    q = np.array([0.3, -1.0, 0.0, 0.4, 0.9, 0.3])
    assert select(inverse_kinematics(chain, forward(chain, q), q)).q[0] == pytest.approx(q, abs=1e-4)


def test_unreachable_frame_is_told_with_its_distance():
    chain = chain_of(MODELS["irb120_like"])
    T = frame_from_xyzrpy([2.0, 0.0, 0.29, 0.0, 0.0, 0.0])
    chosen = select(inverse_kinematics(chain, T))
    assert not chosen.reachable[0]
    assert np.all(np.isnan(chosen.q))
    assert "no nearer than" in str(chosen.reason[0])
    with pytest.raises(InvalidInput, match="frame 1 is not reachable: outside the workspace"):
        chosen.require()


def test_limit_that_forbids_a_frame_is_named():
    model = MODELS["irb120_like"]
    chain = chain_of(model)
    q = np.array([2.0, 0.4, 0.3, 0.4, 0.9, 0.3])
    tight = replace(chain, lower=np.full(6, -1.5), upper=np.full(6, 1.5))
    reason = str(select(inverse_kinematics(tight, forward(chain, q))).reason[0])
    assert "axis1" in reason
    assert "upper limit" in reason or "lower limit" in reason


def test_path_is_followed_without_jumps():
    chain = chain_of(MODELS["kr150_class"])
    steps = np.linspace(0, 1, 60)[:, None]
    path = np.array([0.2, -1.2, 1.4, -2.9, 0.8, 3.0]) + steps * np.array([0.5, 0.3, -0.2, -1.0, 0.2, 1.5])
    chosen = follow(inverse_kinematics(chain, forward(chain, path), path[0]), path[0])
    assert chosen.q == pytest.approx(path, abs=1e-9)


def test_track_stays_where_it_is_and_moves_only_when_it_must():
    chain = chain_of(MODELS["kr150_class_on_track"])
    q = np.array([1.5, 0.2, -1.2, 1.4, -0.9, 0.8, 1.0])
    T = forward(chain, q)
    assert select(inverse_kinematics(chain, T, q)).q[0] == pytest.approx(q, abs=1e-9)
    near = q.copy()
    near[0] = 5.0  # from there the arm does not reach
    chosen = select(inverse_kinematics(chain, T, near))
    assert chosen.reachable[0]
    assert 1.5 < chosen.q[0, 0] < 5.0
    assert forward(chain, chosen.q)[0] == pytest.approx(T[0], abs=1e-9)


@pytest.mark.parametrize(
    ("frames", "words"),
    [
        (np.full((4, 4), np.nan), "frame 1 holds numbers that are not finite"),
        (np.diag([2.0, 1.0, 1.0, 1.0]), "no rotation matrix"),
        (np.eye(3), "4x4"),
    ],
)
def test_bad_frames_are_refused(frames, words):
    with pytest.raises(InvalidInput, match=words):
        inverse_kinematics(kr_like(), frames)


def test_start_of_wrong_length_is_refused():
    with pytest.raises(InvalidInput, match="6 joint values"):
        inverse_kinematics(kr_like(), np.eye(4), np.zeros(5))
