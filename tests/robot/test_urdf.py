"""URDF in and out: against pinocchio, and as a round trip."""

from xml.etree import ElementTree

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from robcal.errors import InvalidInput
from robcal.robot.chain import chain_of, forward
from robcal.robot.export.urdf import calibrated_frames, urdf_text
from robcal.robot.model import Frame, RobotModel
from robcal.robot.urdf_chain import model_from_urdf
from tests.robot.chains import kr_like, random_chain

pytest.importorskip("yourdfpy")


def _random_urdf(rng: np.random.Generator, joints: int = 6) -> str:
    """Joints about arbitrary axes with arbitrary origins, sliding ones along an axis of the parent."""
    parts = ['<robot name="random"><link name="l0"/>']
    for k in range(joints):
        axis, kind, rpy = rng.normal(size=3), "revolute", rng.uniform(-3, 3, 3)
        choice = rng.integers(4)
        if choice == 0:
            axis = np.eye(3)[rng.integers(3)] * rng.choice([-1, 1])
        if choice == 1:
            kind, rpy, axis = "prismatic", np.zeros(3), np.eye(3)[rng.integers(3)]
        if choice == 2 and k:
            kind = "fixed"
        text = [" ".join(map(repr, map(float, v))) for v in (rng.normal(size=3), rpy, axis, rng.normal(size=3))]
        parts.append(
            f'<link name="l{k + 1}"><inertial><origin xyz="{text[3]}"/><mass value="{rng.uniform(1, 9)}"/>'
            '<inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial>'
            f'<visual><geometry><mesh filename="package://none/l{k}.stl"/></geometry></visual></link>'
            f'<joint name="j{k + 1}" type="{kind}"><parent link="l{k}"/><child link="l{k + 1}"/>'
            f'<origin xyz="{text[0]}" rpy="{text[1]}"/><axis xyz="{text[2]}"/>'
            '<limit lower="-2.5" upper="2.5" effort="1" velocity="1"/></joint>'
        )
    return "".join(parts) + "</robot>"


def _pinocchio_frames(text: str, q: np.ndarray, link: str) -> np.ndarray:
    pin = pytest.importorskip("pinocchio")
    model = pin.buildModelFromXML(text)
    data = model.createData()
    out = []
    for values in q:
        pin.framesForwardKinematics(model, data, values)
        out.append(data.oMf[model.getFrameId(link)].homogeneous)
    return np.array(out)


@pytest.mark.parametrize("seed", range(12))
def test_forward_kinematics_agree_with_pinocchio(seed):
    rng = np.random.default_rng(seed)
    text = _random_urdf(rng)
    model = model_from_urdf(text)
    q = rng.uniform(-2, 2, (5, model.n_joints))
    assert forward(chain_of(model), q) == pytest.approx(_pinocchio_frames(text, q, "l6"), abs=1e-12)


@pytest.mark.parametrize("seed", range(6))
def test_masses_and_their_centres_agree_with_pinocchio(seed):
    """The centre of gravity of everything that moves is that of the description."""
    pin = pytest.importorskip("pinocchio")
    rng = np.random.default_rng(100 + seed)
    text = _random_urdf(rng)
    model = model_from_urdf(text)
    q = rng.uniform(-2, 2, model.n_joints)
    reference = pin.buildModelFromXML(text)
    data = reference.createData()
    expected = pin.centerOfMass(reference, data, q)
    from robcal.robot.chain import frame_positions

    T = frame_positions(chain_of(model), q)[0]
    moving = [(f.mass, T[k] @ [*f.cog, 1.0]) for k, f in enumerate(model.frames) if f.mass]
    total = sum(m for m, _ in moving)
    assert sum(m * p for m, p in moving)[:3] / total == pytest.approx(expected, abs=1e-12)


@given(seed=st.integers(0, 2**20))
@settings(max_examples=25, deadline=None)
def test_robot_survives_the_round_trip(seed):
    rng = np.random.default_rng(seed)
    model = random_chain(rng)
    back = model_from_urdf(urdf_text(model))
    q = rng.uniform(-1, 1, (4, model.n_joints))
    assert forward(chain_of(back), q) == pytest.approx(forward(chain_of(model), q), abs=1e-12)
    assert sum(f.mass for f in back.joints) <= sum(f.mass for f in model.frames) + 1e-9


def test_direct_joints_keep_their_numbers():
    model = kr_like()
    back = model_from_urdf(urdf_text(model))
    for before, after in zip(model.joints, back.joints, strict=True):
        assert (after.name, after.axis, after.sign) == (before.name, before.axis, before.sign)
        assert after.xyz == pytest.approx(before.xyz, abs=1e-15)
        assert after.mass == pytest.approx(before.mass)
        assert after.cog == pytest.approx(before.cog)


@pytest.mark.parametrize("seed", range(4))
def test_template_gets_the_calibrated_geometry_and_keeps_its_meshes(seed):
    rng = np.random.default_rng(seed)
    text = _random_urdf(rng)
    nominal = model_from_urdf(text)
    kinds = ("x", "y", "z", "roll", "pitch", "yaw")
    real = nominal.with_parameters({f"{f.name}.{k}": 1e-3 * rng.normal() for f in nominal.frames[:-1] for k in kinds})
    written = urdf_text(real, template=text)
    assert written.count("<mesh") == text.count("<mesh")
    q = rng.uniform(-2, 2, (3, nominal.n_joints))
    expected = forward(chain_of(RobotModel("real", calibrated_frames(real))), q)
    assert forward(chain_of(model_from_urdf(written)), q) == pytest.approx(expected, abs=1e-10)
    assert np.max(np.abs(expected - forward(chain_of(nominal), q))) > 1e-4


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("frames: []", "no URDF"),
        ("<robot name='r'><link name='a'></robot>", "cannot be read"),
        ("<!DOCTYPE x [<!ENTITY a 'b'>]><robot name='r'/>", "entities"),
        ("<robot name='r'><link name='a'/></robot>", "no joints"),
        (
            "<robot name='r'><link name='a'/><link name='b'/><joint name='j' type='floating'><parent link='a'/>"
            "<child link='b'/></joint></robot>",
            "floating",
        ),
    ],
)
def test_bad_descriptions_are_refused(text, words):
    with pytest.raises(InvalidInput, match=words):
        model_from_urdf(text)


def test_template_of_another_robot_is_refused():
    other = RobotModel("other", (Frame("only", "z"), Frame("flange")))
    with pytest.raises(InvalidInput, match="read from"):
        urdf_text(other, template=urdf_text(kr_like()))


def _link_text(name: str, mass: float) -> str:
    return (
        f'<link name="{name}"><inertial><origin xyz="0 0 0.1"/><mass value="{mass}"/>'
        '<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>'
    )


def _joint_text(
    name: str, kind: str, parent: str, child: str, more: str = "", xyz: str = "0 0 0.3", axis: str = "0 1 0"
) -> str:
    return (
        f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/><origin xyz="{xyz}"/>'
        f'<axis xyz="{axis}"/><limit lower="-3" upper="3" effort="1" velocity="1"/>{more}</joint>'
    )


_ARM = "".join(
    _link_text(f"l{k}", 10.0)
    + _joint_text(f"j{k}", "revolute", f"l{k - 1}" if k > 1 else "base", f"l{k}", axis=f"0 {k % 2} {1 - k % 2}")
    for k in (1, 2, 3)
)
_TOOL = _joint_text("flange", "fixed", "l3", "tool0")


@pytest.mark.parametrize(
    ("fingers", "tip"),
    [
        ({"f1": "", "f2": '<mimic joint="f1"/>'}, None),
        ({"drive": "", "left": '<mimic joint="drive"/>', "right": '<mimic joint="drive" multiplier="-1"/>'}, None),
        ({"f1": "", "f2": ""}, "tool0"),
    ],
)
def test_the_fingers_of_a_gripper_are_no_joints_of_the_arm(fingers, tip):
    hand = "".join(
        _link_text(f"g_{name}", 0.1) + _joint_text(name, "prismatic", "tool0", f"g_{name}", more)
        for name, more in fingers.items()
    )
    text = f'<robot name="r"><link name="base"/>{_ARM}<link name="tool0"/>{_TOOL}{hand}</robot>'
    model = model_from_urdf(text, tip=tip)
    assert [f.name for f in model.joints] == ["j1", "j2", "j3"]
    assert sum(f.mass for f in model.frames) == pytest.approx(30.0 + 0.1 * len(fingers))
    if tip is not None:
        with pytest.raises(InvalidInput, match=r"gripper, the link before \(tool0\)"):
            model_from_urdf(text)


def test_masses_on_side_branches_move_with_their_link():
    camera = _link_text("cam", 5.0) + _joint_text("mount", "fixed", "l2", "cam", xyz="0.2 0 0")
    model = model_from_urdf(f'<robot name="r"><link name="base"/>{_ARM}<link name="tool0"/>{_TOOL}{camera}</robot>')
    second = model.joints[1]
    assert second.mass == pytest.approx(15.0)
    assert second.cog == pytest.approx((1.0 / 15.0, 0.0, 0.1))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (('lower="-3" upper="3"', 'lower="-180" upper="180"'), "j1.*degrees"),
        (('xyz="0 0 0.3"', 'xyz="0 0 0.3" rpy="0 90 0"'), "j1.*degrees"),
        (('name="j2"', 'name="${prefix}j2"'), "xacro"),
        (('<link name="l2">', '<link name="l2"><xacro:mass m="3"/>'), "xacro"),
        (('<link name="l2">', '<link name="$(arg arm)l2">'), "xacro"),
    ],
)
def test_degrees_and_unexpanded_macros_are_named(change, words):
    text = f'<robot name="r" xmlns:xacro="http://www.ros.org/wiki/xacro"><link name="base"/>{_ARM}</robot>'
    assert model_from_urdf(text).n_joints == 3
    with pytest.raises(InvalidInput, match=words):
        model_from_urdf(text.replace(*change))


@pytest.mark.parametrize("seed", range(4))
def test_exported_robots_move_in_simulators(seed):
    """Limits that allow motion, and inertias of real bodies, of links with and without known masses."""
    pin = pytest.importorskip("pinocchio")
    model = random_chain(np.random.default_rng(seed))
    text = urdf_text(model)
    for joint in ElementTree.fromstring(text).iter("joint"):
        if (limit := joint.find("limit")) is not None:
            assert float(limit.get("effort", 0)) > 0
            assert float(limit.get("velocity", 0)) > 0
    physical = pin.buildModelFromXML(text)
    for inertia in physical.inertias[1:]:
        moments = np.linalg.eigvalsh(inertia.inertia)
        assert moments[0] > 0
        assert moments[0] + moments[1] >= moments[2] * (1 - 1e-12)
    M = pin.crba(physical, physical.createData(), pin.neutral(physical))
    assert np.linalg.eigvalsh(np.triu(M) + np.triu(M, 1).T)[0] > 0
