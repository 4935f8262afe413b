"""Poses of a sensor in the hand, from their description to the table: square, exact, free, and what is not reached."""

from pathlib import Path

import numpy as np
import pytest
import yaml

from fixtures.rigid import frame_from_six, inverse
from fixtures.true_robot import TrueRobot
from pipeline.pose_generation import generate_poses
from robcal.calibration.collision import Ball, obstacle_clearance, place_capsules
from robcal.errors import InvalidInput
from robcal.files.tables import read_table

CONFIGS = Path(__file__).parents[2] / "configs"
PLACE = {"xyz_mm": [1400, 300, 600], "rpy_deg": [0, 0, 20]}
SENSOR = {"xyz_mm": [50, 0, 300], "rpy_deg": [5, 10, 15]}


def description(folder: Path, **changes: object) -> Path:
    data = yaml.safe_load((CONFIGS / "poses" / "kr150_sphere.yaml").read_text())
    data["robot"] = str(CONFIGS / "robots" / "kr150_class.yaml")
    data["body"] = str(CONFIGS / "bodies" / "sphere_200.yaml")
    data["base_T_body"], data["sensor"]["flange_T_sensor"] = PLACE, SENSOR
    data["choice"] = {"count": 40, "verify": 6}
    for key, value in changes.items():
        data[key] = {**data[key], **value} if isinstance(value, dict) and isinstance(data.get(key), dict) else value
    path = folder / "cell.yaml"
    path.write_text(yaml.safe_dump({k: v for k, v in data.items() if v is not None}))
    return path


def six(place: dict) -> np.ndarray:  # type: ignore[type-arg]
    return np.concatenate([np.array(place["xyz_mm"]) / 1e3, np.radians(place["rpy_deg"])])


def seen_by_the_true_robot(out: Path, parameters: dict) -> tuple[np.ndarray, np.ndarray]:  # type: ignore[type-arg]
    """Tilt (deg) against the normal and distance (m) from the target, by the fixtures' own kinematics."""
    true = TrueRobot(
        yaml.safe_load((CONFIGS / "robots" / "kr150_class.yaml").read_text()),
        parameters,
        world_T_base=inverse(frame_from_six(six(PLACE))),
        flange_T_tool=frame_from_six(six(SENSOR)),
    )
    table = read_table(out)
    q = np.radians(np.column_stack([table.numbers(f"q{k}_deg") for k in range(1, 7)]))
    R, p, _ = true._place(true._rest(q, true.deviation))
    T = np.tile(np.eye(4), (len(q), 1, 1))
    T[:, :3, :3], T[:, :3, 3] = R[:, -1], p[:, -1]
    T = true.world_T_base @ T @ true.flange_T_tool
    body = yaml.safe_load((CONFIGS / "bodies" / "sphere_200.yaml").read_text())["targets"]
    at = {t["id"]: np.array(t["xyz_mm"]) / 1e3 for t in body}
    target = np.array([at[int(i)] for i in table.numbers("target")])
    normal = target / np.linalg.norm(target, axis=1, keepdims=True)
    tilt = np.degrees(np.arccos(np.clip(-np.sum(T[:, :3, 2] * normal, axis=1), -1, 1)))
    # where the line of sight ends
    return tilt, np.linalg.norm(T[:, :3, 3] + 0.2 * T[:, :3, 2] - target, axis=1)


@pytest.fixture(scope="module")
def nominal(tmp_path_factory: pytest.TempPathFactory) -> tuple[dict, Path]:
    folder = tmp_path_factory.mktemp("sphere")
    out = folder / "poses.csv"
    return generate_poses(description(folder), out), out


def test_poses_stand_square_at_the_distance(nominal: tuple[dict, Path]) -> None:
    answer, out = nominal
    tilt, miss = seen_by_the_true_robot(out, {})
    assert tilt.max() < 0.01
    assert miss.max() < 1e-5
    table = read_table(out)
    assert (answer["poses"], answer["verify"], len(table)) == (46, 6, 46)
    counts = np.unique(table.numbers("target"), return_counts=True)[1]
    assert counts.max() - counts.min() <= 1
    assert len(counts) + len(answer["unreachable"]) == 42


def test_free_turns_cover_joint_space(nominal: tuple[dict, Path]) -> None:
    table = read_table(nominal[1])
    assert np.ptp(table.numbers("turn_deg")) > 180
    assert np.ptp(table.numbers("q6_deg")) > 180
    # in a short order: neighbours are nearer than a random pair
    q = np.column_stack([table.numbers(f"q{k}_deg") for k in range(1, 7)])
    steps = np.abs(np.diff(q, axis=0)).max(axis=1)
    mixed = np.abs(q - np.random.default_rng(0).permutation(q)).max(axis=1)
    assert steps.mean() < 0.7 * mixed.mean()


def test_the_sphere_is_an_obstacle_for_the_links(nominal: tuple[dict, Path], tmp_path: Path) -> None:
    from pipeline.pose_generation import read_sensor_request

    request = read_sensor_request(description(tmp_path))
    table = read_table(nominal[1])
    q = np.radians(np.column_stack([table.numbers(f"q{k}_deg") for k in range(1, 7)]))
    centre = request.base_T_body[:3, 3]
    placed = place_capsules(request.model, q, request.capsules, request.flange_T_sensor)
    assert obstacle_clearance(placed, [Ball(tuple(centre), 0.2)]).min() > request.clearance


def test_a_calibrated_robot_stands_square_as_it_really_is(tmp_path: Path) -> None:
    deviations = {"axis2.pitch": 0.003, "axis3.x": 0.002, "axis4.yaw": -0.002, "axis5.pitch": 0.004}
    robot = yaml.safe_load((CONFIGS / "robots" / "kr150_class.yaml").read_text())
    robot["parameters"] = deviations
    (tmp_path / "robot.yaml").write_text(yaml.safe_dump(robot))
    out = tmp_path / "poses.csv"
    generate_poses(description(tmp_path, robot=str(tmp_path / "robot.yaml")), out)
    tilt, miss = seen_by_the_true_robot(out, deviations)
    assert tilt.max() < 0.1
    assert miss.max() < 1e-5
    assert seen_by_the_true_robot(out, {})[1].max() > 1e-3


def test_what_cannot_be_looked_at_is_listed_with_its_reason(tmp_path: Path) -> None:
    wall = {"kind": "box", "xyz_mm": [1400, 750, 600], "size_mm": [1200, 400, 1200]}
    config = description(tmp_path, collision={"obstacles": [wall]}, choice={"count": 30})
    answer = generate_poses(config, tmp_path / "poses.csv")
    reasons = {entry["reason"] for entry in answer["unreachable"]}
    assert {"the robot would collide", "out of reach or beyond a joint limit"} <= reasons
    looked_at = set(read_table(tmp_path / "poses.csv").numbers("target").astype(int))
    assert not looked_at & {entry["target"] for entry in answer["unreachable"]}
    assert any("no pose looks at target" in sentence for sentence in answer["warnings"])


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"body": None}, "looks at the targets of a body"),
        ({"base_T_body": None}, "base_T_body is missing"),
        ({"sensor": {"cone_deg": 70}}, "below 60 degrees"),
        ({"sensor": {"distance_mm": -1}}, "distance_mm"),
        ({"cameras": {"left": "left.yaml"}}, "two ways of measuring"),
        ({"base_T_body": {"xyz_mm": [9000, 0, 0], "rpy_deg": [0, 0, 0]}}, "no target of body"),
        ({"body": str(CONFIGS / "bodies" / "plate_coded.yaml")}, "is no sphere"),
    ],
)
def test_contradictions_are_told_in_one_sentence(changes: dict, words: str, tmp_path: Path) -> None:  # type: ignore[type-arg]
    with pytest.raises(InvalidInput, match=words):
        generate_poses(description(tmp_path, **changes), tmp_path / "poses.csv")
    assert not (tmp_path / "poses.csv").exists()


def test_a_radius_that_the_targets_do_not_have_is_refused(tmp_path: Path) -> None:
    body = yaml.safe_load((CONFIGS / "bodies" / "sphere_200.yaml").read_text())
    body["shape"] = {"kind": "sphere", "radius_mm": 210}
    (tmp_path / "sphere.yaml").write_text(yaml.safe_dump(body))
    config = description(tmp_path, body=str(tmp_path / "sphere.yaml"))
    with pytest.raises(InvalidInput, match="states a radius of 210 mm"):
        generate_poses(config, tmp_path / "poses.csv")
