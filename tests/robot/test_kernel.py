"""The kernel against differences, an independent library, and its own laws."""

import pickle
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from robcal import transforms as tf
from robcal.errors import InvalidInput
from robcal.robot.kernel import MOST_MAPS, Kernel
from robcal.robot.model import Frame, Payload, RobotModel, Term
from tests.robot.chains import TERMS, kr_like, random_chain, random_theta


def _step(name: str) -> float:
    if "elastic" in name or name.endswith((".k", ".rate")):
        return 1e-8
    return 1e-2 if name.endswith("mass") else 1e-5


@pytest.mark.parametrize("statics", ["one_step", "converged"])
@pytest.mark.parametrize("gravity_frame", ["base", "world"])
@given(seed=st.integers(0, 10_000))
@settings(max_examples=3, deadline=None)
def test_jacobians_agree_with_differences(statics: str, gravity_frame: str, seed: int) -> None:
    rng = np.random.default_rng(seed)
    model = random_chain(rng, int(rng.integers(2, 6)), gravity_frame=gravity_frame, terms=TERMS)
    kernel = Kernel(model, statics).with_references(
        tf.frame_from_xyzrpy(rng.normal(size=6)), tf.frame_from_xyzrpy(rng.normal(size=6))
    )
    n = 3
    poses = kernel.poses(
        rng.uniform(-1, 1, (n, model.n_joints)),
        ["load", None, "load"],
        {"time_s": rng.uniform(0, 3600, n), "approach1": rng.choice([-1, 1], n)},
    )
    theta = kernel.theta0 + random_theta(rng, kernel.names) * np.array(
        [0 if n.startswith(("f0.wave", "base.tilt", "tool.drift")) else 1 for n in kernel.names]
    )
    T, J = kernel.frames_and_jacobian(theta, poses)
    for k, name in enumerate(kernel.names):
        d = np.zeros(len(theta))
        d[k] = _step(name)
        up, down = (tf.difference(T, kernel.frames(theta + s * d, poses)) for s in (1, -1))
        expected = (up - down) / (2 * d[k])
        scale = max(1e-3, float(np.abs(expected).max()))
        np.testing.assert_allclose(J[:, :, k], expected, atol=3e-6 * scale, err_msg=name)
    Jq = kernel.joint_jacobian(theta, poses)
    for k in range(model.n_joints):
        d = np.zeros(model.n_joints)
        d[k] = 1e-6
        up, down = (tf.difference(T, kernel.frames(theta, poses.with_q(poses.q + s * d))) for s in (1, -1))
        np.testing.assert_allclose(Jq[:, :, k], (up - down) / 2e-6, atol=1e-7)


def _pinocchio(model: RobotModel) -> Any:
    pin = pytest.importorskip("pinocchio")
    robot, parent = pin.Model(), 0
    robot.gravity.linear = np.array(model.gravity)
    for f in model.frames:
        placement = pin.SE3(tf.rotation_from_rpy(f.rpy), np.array(f.xyz))
        if f.axis is None:
            joint, first, second = None, placement, pin.SE3.Identity()
        else:
            axis = {"x": 0, "y": 1, "z": 2}[f.axis]
            rpy = np.array(f.rpy)
            if f.prismatic:
                joint = pin.JointModelPrismaticUnaligned(f.sign * np.eye(3)[axis])
                first, second = pin.SE3(np.eye(3), np.array(f.xyz)), pin.SE3(tf.rotation_from_rpy(f.rpy), np.zeros(3))
            else:
                # R = Rz Ry Rx with q added to one angle: what stands left of it, the turn, what stands right of it
                left, right = rpy.copy(), rpy.copy()
                left[: axis + 1] = 0.0
                right[axis:] = 0.0
                own = np.zeros(3)
                own[axis] = rpy[axis]
                joint = pin.JointModelRevoluteUnaligned(f.sign * np.eye(3)[axis])
                first = pin.SE3(tf.rotation_from_rpy(left) @ tf.rotation_from_rpy(own), np.array(f.xyz))
                second = pin.SE3(tf.rotation_from_rpy(right), np.zeros(3))
        if joint is None:
            carried = carried * first  # noqa: F821 - the first frame of a random chain carries a joint
        else:
            placement = first if parent == 0 else carried * first
            parent = robot.addJoint(parent, joint, placement, f.name)
            carried = second
        body = carried * pin.SE3(np.eye(3), np.array(f.cog))
        robot.appendBodyToJoint(parent, pin.Inertia(f.mass, np.zeros(3), np.zeros((3, 3))), body)
    for payload in model.payloads.values():
        robot.appendBodyToJoint(
            parent,
            pin.Inertia(payload.mass, np.zeros(3), np.zeros((3, 3))),
            carried * pin.SE3(np.eye(3), np.array(payload.cog)),
        )
    return pin, robot, parent, carried


@given(seed=st.integers(0, 10_000))
@settings(max_examples=10, deadline=None)
def test_frames_and_moments_agree_with_pinocchio(seed: int) -> None:
    rng = np.random.default_rng(seed)
    model = random_chain(rng, int(rng.integers(1, 8)))
    kernel = Kernel(model)
    q = rng.uniform(-2, 2, (4, model.n_joints))
    poses = kernel.poses(q, "load")
    T, variables = kernel.frames(kernel.theta0, poses), kernel.variables(kernel.theta0, poses)
    pin, robot, last, carried = _pinocchio(model)
    data = robot.createData()
    for row in range(len(q)):
        torque = pin.computeGeneralizedGravity(robot, data, q[row])  # what the joints must hold: minus the load's
        pin.forwardKinematics(robot, data, q[row])
        np.testing.assert_allclose(T[row], (data.oMi[last] * carried).homogeneous, atol=1e-12)
        ours = [variables[f"torque{k + 1}"][row] for k in range(model.n_joints)]
        np.testing.assert_allclose(ours, -np.asarray(torque), atol=1e-9)


def test_recursion_of_the_thesis_gives_the_same_moments() -> None:
    """Section 3.4 of the thesis, written as it stands, against the summed form used by the kernel."""
    rng = np.random.default_rng(3)
    model = kr_like()
    kernel = Kernel(model)
    poses = kernel.poses(rng.uniform(-1, 1, (1, 6)), "dumbbell")
    variables = kernel.variables(kernel.theta0, poses)
    base_R, local = [np.eye(3)], []
    q = iter(poses.q[0])
    for f in model.frames:
        rpy = np.array(f.rpy)
        if f.axis:
            rpy["xyz".index(f.axis)] += next(q)
        local.append((tf.rotation_from_rpy(rpy), np.array(f.xyz)))
        base_R.append(base_R[-1] @ local[-1][0])
    g = np.array(model.gravity)
    load = model.payloads["dumbbell"]
    masses = [f.mass for f in model.frames]
    cogs = [np.array(f.cog) for f in model.frames]
    masses[-1], cogs[-1] = load.mass, np.array(load.cog)
    f_sum, m = masses[-1], np.cross(cogs[-1] * masses[-1], base_R[-1].T @ g)
    for i in reversed(range(len(model.frames) - 1)):
        R_next, t_next = local[i + 1]
        down = base_R[i + 1].T @ g
        m = np.cross(cogs[i] * masses[i], down) + np.cross(t_next * f_sum, down) + R_next @ m
        f_sum += masses[i]
        f = model.frames[i]
        k = "xyz".index(str(f.axis))
        # the joint's line in its own frame (only one angle of these frames is not zero)
        assert m[k] == pytest.approx(variables[f"torque{i + 1}"][0], rel=1e-12, abs=1e-9)


def test_one_step_and_converged_statics_differ_by_the_square_of_the_deflection() -> None:
    model = kr_like(parameters={"axis2.elastic_pitch": 1e-6, "axis3.elastic_pitch": 1e-6})
    rng = np.random.default_rng(0)
    one, many, none = Kernel(model), Kernel(model, "converged"), Kernel(kr_like())
    poses = one.poses(rng.uniform(-1, 1, (50, 6)), "dumbbell")
    T1, T2, T0 = (k.frames(k.theta0, poses) for k in (one, many, none))
    first = np.linalg.norm(tf.difference(T1, T0)[:, :3], axis=1).max()
    second = np.linalg.norm(tf.difference(T2, T1)[:, :3], axis=1).max()
    assert 1e-4 < first < 3e-2
    assert 0 < second < 0.02 * first


def test_a_weight_bends_downwards() -> None:
    arm = RobotModel("arm", (Frame("a", "y"), Frame("tip", None, xyz=(1.0, 0, 0), mass=100.0)))
    kernel = Kernel(arm.with_parameters({"a.elastic_pitch": 1e-6}))
    T = kernel.frames(kernel.theta0, kernel.poses([[0.0]]))[0]
    assert T[2, 3] == pytest.approx(-980.665e-6, rel=1e-3)


def test_scan_basis_is_the_derivative_by_terms() -> None:
    rng = np.random.default_rng(1)
    model = kr_like(parameters={"axis2.elastic_pitch": 1e-6}, gravity_frame="world")
    with_term = model.with_terms([Term("t", "axis3", "q", "c", {"c": 0.0}), Term("u", "base", "roll", "c", {"c": 0.0})])
    kernel, other = Kernel(model), Kernel(with_term)
    q = rng.uniform(-1, 1, (5, 6))
    basis = kernel.scan_basis(kernel.theta0, kernel.poses(q, "dumbbell"))
    _, J = other.frames_and_jacobian(other.theta0, other.poses(q, "dumbbell"))
    for name, parameter in (("axis3.q", "t.c"), ("base.roll", "u.c"), ("axis3.pitch", "t.c"), ("tool.x", "tool.x")):
        np.testing.assert_allclose(basis.J[:, :, basis.names.index(name)], J[:, :, other.index[parameter]], atol=1e-12)


def test_columns_pickle_and_empty() -> None:
    kernel = Kernel(kr_like())
    poses = kernel.poses(np.zeros((2, 6)))
    T, J = kernel.frames_and_jacobian(kernel.theta0, poses, [0, 7])
    assert J.shape == (2, 6, 2)
    again = pickle.loads(pickle.dumps(kernel))
    np.testing.assert_array_equal(again.frames(again.theta0, poses), T)
    assert kernel.frames(kernel.theta0, poses.subset([])).shape == (0, 4, 4)


def test_bad_input_is_named() -> None:
    kernel = Kernel(kr_like())
    with pytest.raises(InvalidInput, match="6 joints"):
        kernel.poses(np.zeros((2, 5)))
    with pytest.raises(InvalidInput, match="unknown payload 'anvil'"):
        kernel.poses(np.zeros((2, 6)), ["anvil", None])
    with pytest.raises(InvalidInput, match="pose 1"):
        kernel.poses(np.array([[0.0] * 6, [np.nan] + [0.0] * 5]))
    with pytest.raises(InvalidInput, match="no joint"):
        RobotModel("stick", (Frame("a"),))
    warm = Kernel(kr_like(terms=(Term("t", "axis1", "z", "k*temp_x_c", {"k": 0.0}),)))
    with pytest.raises(InvalidInput, match="temp_x_c"):
        warm.frames(warm.theta0, warm.poses(np.zeros((1, 6))))
    with pytest.raises(InvalidInput, match="statics"):
        Kernel(kr_like(), "sometimes")
    assert Payload(1.0).cog == (0.0, 0.0, 0.0)


def test_evaluations_over_many_numbers_of_poses_keep_memory_bounded() -> None:
    kernel = Kernel(kr_like())
    q = np.random.default_rng(5).uniform(-1, 1, (MOST_MAPS + 8, kernel.model.n_joints))
    whole = kernel.frames(kernel.theta0, kernel.poses(q))
    for n in range(1, len(q) + 1):
        assert np.array_equal(kernel.frames(kernel.theta0, kernel.poses(q[:n])), whole[:n])
    assert len(kernel._maps) == MOST_MAPS
