"""Tool, objects, base and points against a true robot of the fixtures; what touches cannot tell is refused."""

import numpy as np
import pytest

from fixtures.random_robots import description
from fixtures.rigid import frame_from_six, move
from fixtures.touching import spread_postures, touching
from fixtures.true_robot import TrueRobot
from robcal.calibration.calibrated import CalibratedRobot
from robcal.cell.adjustment import student_factor
from robcal.cell.carried import FLANGE, CarriedFrames, PlacedFrame, carried_frames
from robcal.cell.frames import base_from_frames, object_from_corners, object_from_points, pivot, tool_from_touches
from robcal.cell.points import measure_points
from robcal.errors import DegenerateGeometry, NotIdentifiable
from robcal.files.robot_file import read_robot
from robcal.files.yaml_io import yaml_text

pytestmark = pytest.mark.unit
MIDDLE = np.radians([20.0, 10.0, 60.0, 20.0, 50.0, 10.0])
TOOL = frame_from_six([0.08, -0.03, 0.25, 0.3, -0.4, 0.6])
OBJECT = frame_from_six([1.2, 0.1, 0.6, 0.1, -0.2, 0.3])
NOMINAL = np.array([[0, 0, 0], [0.4, 0, 0], [0.4, 0.3, 0], [0, 0.3, 0.0], [0.2, 0, -0.1], [0, 0.15, -0.1]])
DEVIATIONS = {"axis2.pitch": 1e-3, "axis3.x": 5e-4, "axis2.elastic_pitch": 5e-7}


@pytest.fixture(scope="module")
def calibrated(tmp_path_factory: pytest.TempPathFactory) -> CalibratedRobot:
    path = tmp_path_factory.mktemp("robot") / "robot.yaml"
    path.write_text(yaml_text({"format": "robcal/robot-1", **description("kr150"), "parameters": DEVIATIONS}))
    names = tuple(DEVIATIONS)
    covariance = np.diag([2e-5, 3e-5, 1e-8]) ** 2
    return CalibratedRobot(model=read_robot(path), names=names, covariance=covariance, statics="converged")


@pytest.fixture(scope="module")
def true() -> TrueRobot:
    return TrueRobot(description("kr150"), DEVIATIONS)


def carried(robot: CalibratedRobot, q: np.ndarray, tool: PlacedFrame | None) -> CarriedFrames:
    return carried_frames(robot, robot.kernel.poses(q), tool)


def touch(true: TrueRobot, places: np.ndarray, seed: int, wrist: float = 0.5, tool: np.ndarray = TOOL) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return touching(true.replaced(flange_T_tool=tool), spread_postures(rng, len(places), MIDDLE, wrist), places)


def test_tool_with_its_orientation(calibrated: CalibratedRobot, true: TrueRobot) -> None:
    tip = OBJECT[:3, 3]
    corners = [("tip", [0, 0, 0])] * 4 + [("x", [0.1, 0, 0]), ("xy", [0.03, 0.09, 0])]
    own = [TOOL @ frame_from_six([*offset, 0, 0, 0]) for _, offset in corners]
    q = np.concatenate([touch(true, tip[None], i, tool=T) for i, T in enumerate(own)])
    found = tool_from_touches(carried(calibrated, q, FLANGE), [name for name, _ in corners])
    np.testing.assert_allclose(found.placed.T, TOOL, atol=2e-8)
    np.testing.assert_allclose(found.place, tip, atol=2e-8)
    alone = tool_from_touches(carried(calibrated, q[:4], FLANGE), ["tip"] * 4)
    np.testing.assert_allclose(alone.placed.T[:3, 3], TOOL[:3, 3], atol=2e-8)
    assert alone.held == ("roll", "pitch", "yaw")
    assert not np.any(alone.placed.covariance[3:])


def test_objects(calibrated: CalibratedRobot, true: TrueRobot) -> None:
    q = touch(true, move(OBJECT, NOMINAL), 1)
    tip = carried(calibrated, q, PlacedFrame(TOOL))
    corners = object_from_corners(tip.subset(np.array([0, 1, 2])), ["origin", "x", "xy"])
    np.testing.assert_allclose(corners.placed.T, OBJECT, atol=1e-7)
    whole = object_from_points(tip, NOMINAL, np.ones((6, 3), dtype=bool))
    np.testing.assert_allclose(whole.placed.T, OBJECT, atol=1e-7)
    held = np.array([[0, 0, 1], [0, 0, 1], [0, 0, 1], [1, 0, 0], [0, 1, 0], [1, 0, 0]], dtype=bool)
    aligned = object_from_points(tip, NOMINAL, held)
    np.testing.assert_allclose(aligned.placed.T, OBJECT, atol=1e-7)
    assert aligned.adjusted.redundancy == 0
    assert np.all(np.diag(aligned.placed.covariance) > np.diag(whole.placed.covariance))


def test_measured_points_carry_the_robot(calibrated: CalibratedRobot, true: TrueRobot) -> None:
    at = move(OBJECT, NOMINAL)
    q = np.concatenate([touch(true, at, 1), touch(true, at, 2)])
    found = measure_points(carried(calibrated, q, PlacedFrame(TOOL)), list("abcdef") * 2)
    np.testing.assert_allclose(found.places, at, atol=1e-8)
    assert found.estimated
    sigma = np.sqrt(np.diagonal(found.covariance, axis1=1, axis2=2))
    assert np.all((sigma.max(axis=1) > 1e-5) & (sigma.max(axis=1) < 1e-3))


def test_base_and_probe(calibrated: CalibratedRobot, true: TrueRobot) -> None:
    rng = np.random.default_rng(3)
    base = frame_from_six([1.0, 2.0, -1.0, 0.1, 0.2, 3.0])
    q = spread_postures(rng, 5, MIDDLE) + rng.uniform(-0.3, 0.3, (5, 6))
    T = base @ true.replaced(flange_T_tool=TOOL).world_T_tool(q)
    C = np.broadcast_to(1e-8 * np.eye(6), (5, 6, 6))
    found, misses = base_from_frames(carried(calibrated, q, PlacedFrame(TOOL)), T, C, True)
    np.testing.assert_allclose(found.placed.T, base, atol=1e-7)
    assert np.abs(misses).max() < 1e-7
    turns = frame_from_six(np.concatenate([np.zeros((5, 3)), rng.uniform(-0.5, 0.5, (5, 3))], axis=1))
    turns[:, :3, 3] = -turns[:, :3, :3] @ [0.01, 0.02, 0.2]
    np.testing.assert_allclose(pivot(turns, None).placed.T[:3, 3], [0.01, 0.02, 0.2], atol=1e-9)


def test_parallel_orientations_and_points_in_a_line(calibrated: CalibratedRobot, true: TrueRobot) -> None:
    tip = np.tile(OBJECT[:3, 3], (4, 1))
    flange = carried(calibrated, touch(true, tip, 1, wrist=0.001), FLANGE)
    with pytest.raises(DegenerateGeometry, match=r"parallel orientations.*turn the tool by 30 deg"):
        tool_from_touches(flange, ["tip"] * 4)
    turned = np.repeat(np.eye(4)[None], 4, axis=0)
    turned[:, :3, :3] = frame_from_six([[0, 0, 0, 0, 0, a] for a in (0, 0.5, 1, 1.5)])[:, :3, :3]
    with pytest.raises(DegenerateGeometry, match=r"one line, \[0\.00, 0\.00, 1\.00\]"):
        pivot(turned, None)
    with pytest.raises(NotIdentifiable, match="2 times: it takes three or more"):
        tool_from_touches(flange.subset(np.arange(2)), ["tip"] * 2)
    line = np.array([[0, 0, 0], [0.2, 0, 0], [0.4, 0, 0], [0.5, 0, 0]])
    q = touch(true, move(OBJECT, line), 1)
    on_line = carried(calibrated, q, PlacedFrame(TOOL))
    with pytest.raises(DegenerateGeometry, match="one line: nothing holds the object's turn"):
        object_from_points(on_line, line, np.ones((4, 3), dtype=bool))
    with pytest.raises(DegenerateGeometry, match="origin, x and xy lie in one line"):
        object_from_corners(on_line.subset(np.arange(3)), ["origin", "x", "xy"])
    tip = carried(calibrated, touch(true, move(OBJECT, NOMINAL), 1), PlacedFrame(TOOL))
    held = np.zeros((6, 3), dtype=bool)
    held[:, 1:] = True
    with pytest.raises(DegenerateGeometry, match=r"shift along \[1\.00, 0\.00, 0\.00\]"):
        object_from_points(tip, NOMINAL, held)


def test_a_wrong_flange_tool_is_found(calibrated: CalibratedRobot, true: TrueRobot) -> None:
    rng = np.random.default_rng(4)
    at = move(OBJECT, NOMINAL) + 5e-5 * rng.standard_normal((6, 3))
    wrong = TOOL @ frame_from_six([0.0, 0.002, 0.0, 0, 0, 0])
    q = touch(true, np.concatenate([at, at]), 1)
    found = object_from_points(
        carried(calibrated, q, PlacedFrame(wrong)), np.tile(NOMINAL, (2, 1)), np.ones((12, 3), dtype=bool)
    )
    assert found.adjusted.shift is not None
    np.testing.assert_allclose(found.adjusted.shift, [0, -0.002, 0], atol=2e-4)
    right = object_from_points(
        carried(calibrated, q, PlacedFrame(TOOL)), np.tile(NOMINAL, (2, 1)), np.ones((12, 3), dtype=bool)
    )
    assert right.adjusted.shift is None


def test_intervals_are_wider_where_the_noise_is_estimated() -> None:
    known, half = np.eye(2), np.diag([1.0, 0.0])
    np.testing.assert_allclose(student_factor(known, half, np.inf), 1.959964, atol=1e-6)
    np.testing.assert_allclose(student_factor(known, half, 3.0), [3.182446, 1.959964], atol=1e-5)


def test_errors_stay_within_their_95_per_cent() -> None:
    """Few draws of ``python -m benchmarks.cell``."""
    from benchmarks.cell import coverage

    shares = [share for share, _, _ in coverage(3).values()]
    assert np.mean(np.concatenate(shares)) > 0.8
