"""Parallelograms and four-bars against a witness that closes circles and minimises energy."""

import shutil
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
import yaml

from fixtures.loops import LoopedRobot, circles_meet, palletiser, random_angles, true_palletiser
from robcal.calibration.identifiability import choose_candidates
from robcal.calibration.identification import identify
from robcal.calibration.observations import FrameObservations
from robcal.errors import InvalidInput
from robcal.files.poses_table import read_poses
from robcal.files.robot_file import read_robot, robot_text, write_robot
from robcal.robot.chain import chain_of, forward, forward_and_jacobian
from robcal.robot.compensation import compensate
from robcal.robot.export.urdf import urdf_text
from robcal.robot.kernel import Kernel
from robcal.robot.loops import FourBar, closing, rocker_angle, rocker_slope
from robcal.robot.model import Payload, RobotModel
from robcal.transforms import difference
from tests.robot.export.test_c_export import Compiled

pytestmark = pytest.mark.unit
KINDS = ("parallelogram", "fourbar")


def nominal(kind: str, folder: Path) -> RobotModel:
    path = folder / "robot.yaml"
    path.write_text(yaml.safe_dump(palletiser(kind == "fourbar")))
    return read_robot(path)


def calibrated(truth: LoopedRobot, model: RobotModel) -> RobotModel:
    """The model with the parameters of the truth."""
    elastic = {model.joints[k - 1].elastic_name: v for k, v in truth.compliance.items()}
    return replace(
        model.with_parameters({**truth.deviations, **elastic}),
        payloads={"load": Payload(*truth.payload)},
        world_T_base=truth.world_T_base,
        flange_T_tool=truth.flange_T_tool,
    )


@pytest.mark.parametrize("assembly", ["open", "crossed"])
def test_rocker_is_where_circles_meet(assembly):
    bar = FourBar(0, (0.3, 1.1, 0.38, 1.15), 0.0, assembly)
    phi = np.linspace(0.0, 2.0 * np.pi, 200)
    phi = phi[np.abs(closing(bar.lengths, phi)) < 1.0]
    expected = circles_meet(np.array(bar.lengths), phi, assembly == "open")
    assert np.exp(1j * rocker_angle(bar, phi)) == pytest.approx(np.exp(1j * expected), abs=1e-12)
    h = 1e-6
    slope = np.angle(np.exp(1j * (rocker_angle(bar, phi + h) - rocker_angle(bar, phi - h)))) / (2 * h)
    inner = np.abs(closing(bar.lengths, phi)) < 0.999
    assert rocker_slope(bar, phi)[inner] == pytest.approx(slope[inner], abs=1e-6)


@pytest.mark.parametrize("kind", KINDS)
def test_nominal_chain_and_its_jacobian(kind, tmp_path):
    model = nominal(kind, tmp_path)
    chain = chain_of(model)
    q = random_angles(palletiser(kind == "fourbar"), 20, np.random.default_rng(1))
    T, J = forward_and_jacobian(chain, q)
    assert pytest.approx(LoopedRobot(palletiser(kind == "fourbar")).world_T_tool(q), abs=1e-12) == T
    h = 1e-6
    for k in range(4):
        step = h * np.eye(4)[k]
        numeric = (difference(T, forward(chain, q + step)) - difference(T, forward(chain, q - step))) / (2 * h)
        assert J[:, :, k] == pytest.approx(numeric, abs=1e-8)


@pytest.mark.parametrize(("kind", "within"), [("parallelogram", 1e-10), ("fourbar", 4e-6)])
def test_loaded_robot_is_the_witness_of_least_energy(kind, within, tmp_path):
    """A four-bar's moment is taken at the undeflected angle, which costs micrometres."""
    truth = true_palletiser(1, kind == "fourbar")
    kernel = Kernel(calibrated(truth, nominal(kind, tmp_path)), "converged")
    q = random_angles(truth.description, 20, np.random.default_rng(2))
    found = kernel.frames(kernel.theta0, kernel.poses(q, "load"))
    assert np.max(np.abs(difference(truth.world_T_tool(q), found))) < within
    slack = replace(truth, compliance={})
    assert np.max(np.abs(difference(slack.world_T_tool(q), found))[:, :3]) > 1e-3


@pytest.mark.parametrize("kind", KINDS)
def test_exact_derivatives(kind, tmp_path):
    truth = true_palletiser(1, kind == "fourbar")
    kernel = Kernel(calibrated(truth, nominal(kind, tmp_path)))
    q = random_angles(truth.description, 4, np.random.default_rng(3))
    poses = kernel.poses(q, "load")
    T, J, _ = kernel.evaluate(kernel.theta0, poses)
    for k, name in enumerate(kernel.names):
        h = 1e-8 if ".elastic_" in name else 1e-6
        step = h * np.eye(len(kernel.names))[k]
        ends = [difference(T, kernel.frames(kernel.theta0 + s * step, poses)) for s in (1, -1)]
        numeric = (ends[0] - ends[1]) / (2 * h)
        assert np.max(np.abs(J[:, :, k] - numeric)) < 2e-7 * max(1.0, np.max(np.abs(numeric))), name
    Jq = kernel.joint_jacobian(kernel.theta0, poses)
    for k in range(4):
        step = 1e-6 * np.eye(4)[k]
        ends = [difference(T, kernel.frames(kernel.theta0, poses.with_q(q + s * step))) for s in (1, -1)]
        assert Jq[:, :, k] == pytest.approx((ends[0] - ends[1]) / 2e-6, abs=1e-8)


def test_torque_of_a_motor_holds_all_that_it_turns(tmp_path):
    """A forearm held by a parallelogram loads its own motor alone: lifting the upper arm does not turn it."""
    model = calibrated(replace(true_palletiser(1, False), deviations={}), nominal("parallelogram", tmp_path))
    kernel = Kernel(model)
    q = random_angles(palletiser(False), 3, np.random.default_rng(4))
    found = kernel.variables(kernel.theta0, kernel.poses(q, "load"))
    forearm = sum(f.mass for f in model.frames[2:]) + 80.0
    upper = 120.0 * (0.02 * np.cos(q[:, 1]) + 0.5 * np.sin(q[:, 1])) + forearm * 1.15 * np.sin(q[:, 1])
    assert found["torque2"] == pytest.approx(9.80665 * upper, rel=2e-2)
    assert np.max(np.abs(found["torque2"] - found["axis2_mpitch"])) > 500.0


@pytest.mark.parametrize("kind", [pytest.param("parallelogram", marks=pytest.mark.slow), "fourbar"])
def test_identified_to_the_noise_with_its_loop(kind, tmp_path):
    truth = true_palletiser(5, kind == "fourbar")
    rng = np.random.default_rng(6)
    q = random_angles(truth.description, 150, rng)
    model = replace(nominal(kind, tmp_path), payloads={"load": Payload(*truth.payload)})
    kernel = Kernel(model)
    poses = kernel.poses(q[:100], "load")
    noise = np.repeat([3e-5, 1e-4], 3)
    from robcal.transforms import retract

    measured = retract(truth.world_T_tool(q), rng.normal(0.0, noise, (150, 6)))
    observations = FrameObservations(np.arange(100), measured[:100], np.tile(np.diag(noise**2), (100, 1, 1)))
    found = identify(model, poses, [observations], kernel=kernel)
    assert 0.9 < found.sigma0 < 1.1
    there = Kernel(found.model)
    missed = difference(truth.world_T_tool(q[100:]), there.frames(there.theta0, there.poses(q[100:], "load")))
    assert np.sqrt(np.mean(np.sum(missed[:, :3] ** 2, axis=1))) < 4e-5
    loop = {name for name in found.names if name.startswith("elbow.") and name.rsplit(".")[-1] in ("crank", "coupler")}
    assert len(loop) == (2 if kind == "fourbar" else 0)
    if kind == "fourbar":  # the scale of a four-bar does not show: its last length stays as constructed
        assert "elbow.ground" in found.eliminated
        assert "elbow.elastic_crank" in choose_candidates(model, "standard").own_axis


@pytest.mark.parametrize("kind", KINDS)
def test_commands_bring_the_real_tool_there_in_python_and_in_c(kind, tmp_path):
    truth = true_palletiser(2, kind == "fourbar")
    model = calibrated(truth, nominal(kind, tmp_path))
    kernel = Kernel(model)
    q = random_angles(truth.description, 12, np.random.default_rng(7))
    T = kernel.frames(kernel.theta0, kernel.poses(q, "load"))
    found = compensate(kernel, T, payload="load", near=q + 0.1).require()
    assert np.max(np.abs(found.remaining[:, :3])) < 1e-9
    if kind == "parallelogram" or shutil.which("gcc") is None:  # the four-bar's robot has a parallel rod as well
        return
    code = Compiled(model, tmp_path)
    conditions = code.conditions((truth.payload[0], *truth.payload[1]))
    for i in range(12):
        assert code.forward(q[i], conditions) == pytest.approx(T[i], abs=1e-12)
        status, command = code.command("exact", T[i], conditions, q[i] + 0.02)
        assert status == 0
        assert command == pytest.approx(q[i], abs=1e-6)


def test_urdf_mimics_a_parallelogram_and_refuses_a_four_bar(tmp_path):
    """The written joints, turned by hand, give the calibrated geometry."""
    model = nominal("parallelogram", tmp_path)
    model = model.with_parameters({"axis2.pitch": 2e-3, "elbow.pitch": -1e-3, "axis4.yaw": 1e-3, "level.x": 4e-4})
    root = ElementTree.fromstring(urdf_text(model))
    q = dict(zip([f.name for f in model.joints], [0.3, 0.2, -0.4, 0.5], strict=True))
    T = np.eye(4)
    for joint in root.iter("joint"):
        if joint.find("parent") is None:
            continue
        origin, axis, mimic = joint.find("origin"), joint.find("axis"), joint.find("mimic")
        assert origin is not None
        T = T @ _urdf_frame(origin)
        if axis is None:
            continue
        angle = q.get(joint.get("name") or "", 0.0)
        if mimic is not None:
            angle = q[str(mimic.get("joint"))] * float(mimic.get("multiplier", 1)) + float(mimic.get("offset", 0))
        turn = np.eye(4)
        turn[:3, :3] = _about(np.array(str(axis.get("xyz")).split(), dtype=float), angle)
        T = T @ turn
    kernel = Kernel(model)
    expected = kernel.frames(kernel.theta0, kernel.poses([list(q.values())]))[0]
    assert pytest.approx(expected, abs=1e-12) == T
    with pytest.raises(InvalidInput, match="four-bar of frame 'elbow'"):
        urdf_text(nominal("fourbar", tmp_path))


def _about(axis: np.ndarray, angle: float) -> np.ndarray:
    K = np.cross(np.eye(3), axis)
    return np.eye(3) + np.sin(angle) * K + (1 - np.cos(angle)) * K @ K


def _urdf_frame(origin: ElementTree.Element) -> np.ndarray:
    T = np.eye(4)
    r, p, y = (float(v) for v in str(origin.get("rpy")).split())
    T[:3, :3] = _about(np.array([0, 0, 1.0]), y) @ _about(np.array([0, 1.0, 0]), p) @ _about(np.array([1.0, 0, 0]), r)
    T[:3, 3] = [float(v) for v in str(origin.get("xyz")).split()]
    return T


@pytest.mark.parametrize("kind", KINDS)
def test_file_survives_writing(kind, tmp_path):
    model = nominal(kind, tmp_path)
    if kind == "fourbar":
        model = model.with_parameters({"elbow.crank": 1e-4, "elbow.elastic_crank": 1e-6})
    write_robot(tmp_path / "back.yaml", model)
    back = read_robot(tmp_path / "back.yaml")
    assert robot_text(back) == robot_text(model)
    assert [f.name for f in back.joints] == ["axis1", "axis2", "elbow", "axis4"]
    assert back.frames[3].passive


BAR = {"driven_by": "q3", "lengths_mm": [300.0, 1100.0, 380.0, 1150.0]}
FAULTS = [
    (
        "level",
        {"angle": {"q7": 1.0}},
        "frame 'level': there is no joint 'q7' before it: the joints before it are q1, q2",
    ),
    ("level", {"angle": {"elbow": 1.0}}, "there is no joint 'elbow'"),
    ("level", {"angle": {}}, "names no joint"),
    ("level", {"angle": {"q2": 0.0}}, "coefficient of q2 is zero"),
    ("level", {"angle": {"q2": 1.0}, "axis": None}, "give it an axis"),
    ("level", {"angle": {"q2": 1.0}, "range_deg": [-1, 1]}, "range_deg is for joints"),
    ("level", {"angle": {"q2": 1.0}, "fourbar": BAR}, "not by both"),
    ("elbow", {"angle": {"q2": -1.0, "q3": 0.5}}, "its coefficient must be 1 or -1"),
    ("level", {"angle": None, "fourbar": {**BAR, "driven_by": "q9"}}, "there is no joint 'q9'"),
    (
        "level",
        {"angle": None, "fourbar": {**BAR, "lengths_mm": [300, 200, 100, 700]}},
        "ground of 700 mm is as long as",
    ),
    ("level", {"angle": None, "fourbar": {**BAR, "lengths_mm": [300, 200, 0, 700]}}, "must be positive"),
    ("level", {"angle": None, "fourbar": {**BAR, "lenghts_mm": [1, 1, 1, 1]}}, "did you mean 'lengths_mm'"),
]


@pytest.mark.parametrize(("name", "change", "told"), FAULTS, ids=[told for _, _, told in FAULTS])
def test_impossible_loops_are_refused_in_a_sentence(name, change, told, tmp_path):
    description = palletiser(False)
    frame = next(f for f in description["frames"] if f["name"] == name)
    frame.update(change)
    path = tmp_path / "robot.yaml"
    path.write_text(yaml.safe_dump({**description, "frames": description["frames"]}))
    with pytest.raises(InvalidInput, match=r"robot\.yaml, line") as caught:
        read_robot(path)
    assert told in str(caught.value)


def test_a_pose_at_which_the_loop_stays_open_is_named(tmp_path):
    description = palletiser()
    description["frames"][2]["fourbar"]["lengths_mm"][1] = 1000.0
    (tmp_path / "robot.yaml").write_text(yaml.safe_dump(description))
    robot = read_robot(tmp_path / "robot.yaml")
    path = tmp_path / "poses.csv"
    path.write_text("pose,q1_deg,q2_deg,q3_deg,q4_deg\na,0,0,0,0\nb,0,0,85,0\n")
    told = r"poses.csv, row 3: the four-bar of frame 'elbow' does not close at q3_deg = 85"
    with pytest.raises(InvalidInput, match=told):
        read_poses(path, robot, ())
