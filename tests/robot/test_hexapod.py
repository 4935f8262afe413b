"""Stewart platforms against a witness with a root finder of its own, from the file to the identified robot."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml

from fixtures.hexapods import TARGETS, drive, hexapod, random_platforms, true_hexapod
from fixtures.rigid import move
from robcal.calibration.identification import identify
from robcal.calibration.observations import FrameObservations, Observations, PointObservations
from robcal.errors import InvalidInput
from robcal.files.poses_table import read_poses
from robcal.files.robot_file import read_robot, robot_text, write_robot
from robcal.robot.chain import chain_of
from robcal.robot.compensation import CompensationSettings, compensate
from robcal.robot.hexapod import legs_of, nominal_frames
from robcal.robot.kernel import Kernel
from robcal.robot.model import RobotModel, Term
from robcal.transforms import difference, frame_from_xyzrpy, retract

pytestmark = pytest.mark.unit


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> RobotModel:
    path = tmp_path_factory.mktemp("hexapod") / "robot.yaml"
    path.write_text(yaml.safe_dump(hexapod()))
    return read_robot(path)


def with_truth(model: RobotModel, seed: int) -> RobotModel:
    """The model with all 42 numbers, base and tool of the truth."""
    truth, legs = true_hexapod(seed), legs_of(model)
    values = {}
    for i, f in enumerate(model.frames):
        values |= {f"{f.name}.base_{k}": v for k, v in zip("xyz", truth.base[i] - legs.base[i], strict=True)}
        values |= {
            f"{f.name}.platform_{k}": v for k, v in zip("xyz", truth.platform[i] - legs.platform[i], strict=True)
        }
        values[f"{f.name}.offset"] = truth.offset[i]
    return replace(model.with_parameters(values), world_T_base=truth.world_T_base, flange_T_tool=truth.flange_T_tool)


def test_inverse_and_forward_are_the_witness(model):
    platforms = random_platforms(40, np.random.default_rng(1))
    legs = legs_of(model)
    lengths = legs.lengths(platforms)
    assert lengths == pytest.approx(true_hexapod(0, exact=True).lengths(platforms), abs=1e-14)
    T, found = legs.forward(lengths)
    assert np.all(found)
    assert pytest.approx(platforms, abs=1e-9) == T
    assert not legs.forward(np.array([[0.6, 1.25, 0.6, 1.25, 0.6, 1.25], [0.1] * 6]))[1][1]
    with pytest.raises(InvalidInput, match="row 2: no position of the platform"):
        nominal_frames(model, np.vstack([lengths[:1], [[0.1] * 6]]))


def test_kernel_gives_true_tools_and_exact_derivatives(model):
    driven = drive(true_hexapod(3), 12, np.random.default_rng(2))
    kernel = Kernel(with_truth(model, 3))
    poses = kernel.poses(driven.lengths)
    theta = kernel.theta0.copy()
    assert np.max(np.abs(difference(driven.world_T_tool, kernel.frames(theta, poses)))) < 1e-9
    theta[[kernel.index["base.yaw"], kernel.index["tool.x"]]] = 2e-3
    T, J, _ = kernel.evaluate(theta, poses)
    for k, name in enumerate(kernel.names):
        step = 1e-6 * np.eye(len(theta))[k]
        ends = [difference(T, kernel.frames(theta + s * step, poses)) for s in (1, -1)]
        assert np.max(np.abs(J[:, :, k] - (ends[0] - ends[1]) / 2e-6)) < 1e-7, name
    Jq = kernel.joint_jacobian(theta, poses)
    step = 1e-6 * np.eye(6)[4]
    ends = [difference(T, kernel.frames(theta, poses.with_q(poses.q + s * step))) for s in (1, -1)]
    assert np.max(np.abs(Jq[:, :, 4] - (ends[0] - ends[1]) / 2e-6)) < 1e-7


def test_a_term_lengthens_its_leg(model):
    term = Term("leg2_scale", "leg2", "q", "ppm*q2", {"ppm": 1e-3})
    kernel = Kernel(model.with_terms([term]))
    plain = Kernel(model)
    lengths = legs_of(model).lengths(random_platforms(3, np.random.default_rng(3)))
    longer = lengths * (1.0 + 1e-3 * np.eye(6)[1])
    found = kernel.frames(kernel.theta0, kernel.poses(lengths))
    assert pytest.approx(plain.frames(plain.theta0, plain.poses(longer)), abs=1e-12) == found
    with pytest.raises(InvalidInput, match="act on the lengths of its legs"):
        model.with_terms([Term("bad", "leg2", "yaw", "1")])


@pytest.mark.parametrize("kind", [pytest.param("frames", marks=pytest.mark.slow), "points"])
def test_forty_two_parameters_are_identified_and_the_rest_is_named(model, kind):
    n, kept = 100, 40
    driven = drive(true_hexapod(5), n + kept, np.random.default_rng(5))
    rng = np.random.default_rng(6)
    observations: Observations
    if kind == "frames":
        sigma = np.array([3e-5] * 3 + [1.2e-4] * 3)
        seen = retract(driven.world_T_tool[:n], rng.normal(0.0, sigma, (n, 6)))
        observations = FrameObservations(np.arange(n), seen, np.tile(np.diag(sigma**2), (n, 1, 1)))
    else:
        p = move(driven.world_T_tool[:n], TARGETS) + rng.normal(0.0, 3e-5, (n, 4, 3))
        on_tool = np.tile(TARGETS, (n, 1))
        covariance = np.tile(9e-10 * np.eye(3), (4 * n, 1, 1))
        pose = np.repeat(np.arange(n), 4)
        observations = PointObservations(pose, on_tool, p.reshape(-1, 3), covariance, np.tile(np.arange(4), n))
    kernel = Kernel(model)
    found = identify(model, kernel.poses(driven.lengths[:n]), [observations], kernel=kernel)
    assert len(found.names) == 42
    assert 0.9 < found.sigma0 < 1.1
    # twelve of the 54 numbers of legs, base and tool only move its frames
    assert len(found.eliminated) == 12
    assert all(e.tied_to for e in found.eliminated.values())
    T, covariance = found.predict(found.kernel.poses(driven.lengths[n:]))
    missed = difference(T, driven.world_T_tool[n:])[:, :3]
    rms = np.sqrt(np.mean(np.sum(missed**2, axis=1)))
    predicted = np.sqrt(np.mean(np.trace(covariance[:, :3, :3], axis1=1, axis2=2)))
    assert rms < 3e-5
    assert 0.6 < rms / predicted < 1.6


def test_commands_bring_the_true_platform_there(model):
    truth, rng = true_hexapod(7), np.random.default_rng(7)
    wanted = random_platforms(20, rng)
    robot = with_truth(model, 7)
    world = truth.world_T_base @ wanted @ truth.flange_T_tool
    found = compensate(robot, world).require()
    there = truth.base_T_platform(found.q, wanted)
    assert np.max(np.abs(difference(wanted, there))) < 1e-9
    assert np.all(found.converged)
    assert np.max(np.abs(found.before[:, :3])) > 1e-4
    target = compensate(robot, wanted @ truth.flange_T_tool, frame="base")
    assert target.q == pytest.approx(found.q, abs=1e-12)
    assert nominal_frames(model, found.q) @ truth.flange_T_tool == pytest.approx(target.F_star, abs=1e-9)
    assert compensate(robot, world, settings=CompensationSettings("none")).q == pytest.approx(
        legs_of(model).lengths(wanted), abs=1e-12
    )
    far = compensate(robot, world[:1] @ frame_from_xyzrpy([0.0, 0.0, 2.0, 0.0, 0.0, 0.0]))
    assert not far.reachable[0]
    assert "above its upper limit" in str(far.reason[0])


def test_file_survives_writing(model, tmp_path):
    full = with_truth(model, 1)
    write_robot(tmp_path / "r.yaml", full)
    back = read_robot(tmp_path / "r.yaml")
    assert robot_text(back) == robot_text(full)
    assert back.parameters == full.parameters
    assert back.home == pytest.approx(full.home, abs=1e-12)
    with pytest.raises(InvalidInput, match="Stewart platform: this works for chains"):
        chain_of(back)


FAULTS = [
    ({"base_mm": hexapod()["base_mm"][:5]}, "base_mm"),
    ({"leg_mm": [1250, 600]}, "is no range of lengths"),
    ({"leg_mm": [600, 650], "home": {"xyz_mm": [0, 0, 900]}}, "at home leg 1 would be"),
    ({"platform_mm": [[0, 0, 0]] * 6}, "all six points are the same"),
    ({"platform_mm": [[0.5 * x, 0.5 * y, 0] for x, y, _ in hexapod()["base_mm"]]}, "do not hold the platform"),
    ({"parameters": {"leg7.offset": 1e-3}}, "there is no 'leg7': did you mean"),
    ({"parameters": {"leg1.base_w": 1e-3}}, "unknown kind 'base_w'"),
    ({"offset_mm": [0] * 6}, "did you mean 'offsets_mm'"),
]


@pytest.mark.parametrize(("change", "told"), FAULTS, ids=[told for _, told in FAULTS])
def test_bad_files_are_refused_in_a_sentence(change, told, tmp_path: Path):
    path = tmp_path / "robot.yaml"
    path.write_text(yaml.safe_dump({**hexapod(), **change}))
    with pytest.raises(InvalidInput, match=r"robot\.yaml, line") as caught:
        read_robot(path)
    assert told in str(caught.value)


POSES = "pose,l1_mm,l2_mm,l3_mm,l4_mm,l5_mm,l6_mm\na,900,900,900,900,900,900\n"


@pytest.mark.parametrize(
    ("text", "told"),
    [
        (POSES + "b,100,900,900,900,900,900\n", r"row 3: no position of the platform has these leg lengths \(100\.000"),
        (POSES.replace("l6_mm", "q6_mm"), "joint column 'q6_mm' must be 'l6_mm': state the leg's length in mm"),
        (POSES.replace("l6_mm", "l6_mm,l7_mm").replace("900\n", "900,900\n"), "column 'l7_mm' has no joint"),
    ],
)
def test_bad_poses_are_refused_in_a_sentence(model, text, told, tmp_path: Path):
    (tmp_path / "poses.csv").write_text(text)
    with pytest.raises(InvalidInput, match=told):
        read_poses(tmp_path / "poses.csv", model, ())
