"""A sensor in the hand, from poses to a campaign and back: calibrated by its readings, the next poses are square."""

import json
from pathlib import Path

import numpy as np
import pytest
import yaml

from fixtures.campaigns import write_table, write_yaml
from fixtures.rigid import frame_from_six, inverse, six_from_frame
from fixtures.triangulation import TriangulationSensor
from fixtures.true_robot import Circumstances, TrueRobot
from pipeline.campaign_reader import read_campaign
from pipeline.pose_generation import generate_poses
from pipeline.runner import run_campaign
from robcal.calibration.instruments.cell_frame import FIXED, FREE
from robcal.errors import InvalidInput
from robcal.files.tables import read_table

ROBOT = Path(__file__).parents[2] / "configs" / "robots" / "kr150_class.yaml"
BODY = ROBOT.parents[1] / "bodies" / "sphere_200.yaml"
TRUE = TrueRobot(
    yaml.safe_load(ROBOT.read_text()),
    world_T_base=inverse(frame_from_six([1.35, 0.1, 0.75, 0.1, -0.2, 0.3])),
    flange_T_tool=frame_from_six([0.05, 0.02, 0.3, 0.1, 0.05, 0.2]),
)
TARGETS = {t["id"]: np.array(t["xyz_mm"]) / 1e3 for t in yaml.safe_load(BODY.read_text())["targets"]}
SENSOR = TriangulationSensor(sigma_m=2e-5)


def placed(T: np.ndarray) -> dict:  # type: ignore[type-arg]
    six = six_from_frame(T)
    return {"xyz_mm": (1e3 * six[:3]).tolist(), "rpy_deg": np.degrees(six[3:]).tolist()}


def examined(folder: Path) -> tuple[np.ndarray, np.ndarray, list[int], np.ndarray]:
    """True sensor frames, targets and their ids at the poses of a folder; angles of the tilt in degrees."""
    table = read_table(folder / "poses.csv")
    q = np.radians(np.column_stack([table.numbers(f"q{k}_deg") for k in range(1, 7)]))
    ids = table.numbers("target").astype(int).tolist()
    p = np.array([TARGETS[i] for i in ids])
    T = TRUE.world_T_tool(q, Circumstances.plain(len(q), 6))
    normal = p / np.linalg.norm(p, axis=1, keepdims=True)
    return T, p, ids, np.degrees(np.arccos(np.clip(-np.sum(T[:, :3, 2] * normal, axis=1), -1, 1)))


def measure(folder: Path, tool: dict) -> Path:  # type: ignore[type-arg]
    """A campaign from the poses of a folder: what the sensor reads there."""
    T, p, ids, _ = examined(folder)
    normal = p / np.linalg.norm(p, axis=1, keepdims=True)
    x, seen = SENSOR.read(T, p, normal, np.random.default_rng(len(folder.name)))
    names = [f"p{k:03d}" for k in range(1, len(x) + 1)]
    rows = np.flatnonzero(seen)
    table = {"cycle": [0] * len(rows), "time_s": (3.0 * rows).tolist()}
    table |= {"pose": [names[k] for k in rows], "target": [ids[k] for k in rows]}
    table |= {f"{a}_mm": (1e3 * x[rows, j]).tolist() for j, a in enumerate("xyz")} | {"sigma_mm": [0.02] * len(rows)}
    write_table(folder / "readings.csv", table)
    content = {
        "format": "robcal/campaign-1",
        "name": "sphere",
        "robot": str(ROBOT),
        "poses": "poses.csv",
        "bodies": {"sphere": {"targets": str(BODY)}},
        "model": {"parameters": "none", "joint_sigma_deg": 0.0},
        "diagnosis": {"enabled": False},
        "instruments": {
            "eye": {"measurements": "readings.csv", "mounted": "hand", "body": "sphere", "flange_T_tool": tool}
        },
    }
    write_yaml(folder / "campaign.yaml", content)
    return folder / "campaign.yaml"


@pytest.fixture(scope="module")
def first_round(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Believed 20 mm and 5 degrees off; the sensor's orientation is certified."""
    root = tmp_path_factory.mktemp("loop")
    (root / "one").mkdir()
    sensor = TRUE.flange_T_tool.copy()
    sensor[:3, 3] += [0.012, -0.012, 0.01]
    off = frame_from_six([0.012, 0.012, -0.01, 0.05, -0.05, 0.05])
    config = {
        "format": "robcal/poses-1",
        "robot": str(ROBOT),
        "body": str(BODY),
        "base_T_body": placed(inverse(TRUE.world_T_base) @ off),
        "sensor": {"distance_mm": 200, "flange_T_sensor": placed(sensor)},
        "choice": {"count": 40, "verify": 6},
    }
    write_yaml(root / "one.yaml", config)
    generate_poses(root / "one.yaml", root / "one" / "poses.csv")
    run_campaign(measure(root / "one", placed(sensor)), out=root / "run", until="verify")
    return root


def test_nine_unknowns_are_calibrated_and_the_orientation_is_held(first_round: Path) -> None:
    result = json.loads((first_round / "run" / "result.json").read_text())
    eye = result["instruments"]["eye"]
    assert result["identification"]["parameters"] == 9
    assert eye["kind"] == "sensor_points"
    sensor = np.array(eye["flange_T_tool"]["xyz_mm"]) / 1e3
    assert np.linalg.norm(sensor - TRUE.flange_T_tool[:3, 3]) < 1e-4  # tilts displace what the sensor reads
    assert "rpy_deg is held as stated" in (first_round / "run" / "log.txt").read_text()


def test_aimed_again_the_sensor_stands_square(first_round: Path) -> None:
    assert examined(first_round / "one")[3].max() > 2.0
    (first_round / "two").mkdir()
    config = {
        "format": "robcal/poses-1",
        "robot": str(first_round / "run" / "robot_calibrated.yaml"),
        "body": str(BODY),
        "sensor": {"distance_mm": 200},
        "choice": {"count": 40},
    }
    write_yaml(first_round / "two.yaml", config)
    generate_poses(first_round / "two.yaml", first_round / "two" / "poses.csv")
    T, p, _, tilt = examined(first_round / "two")
    assert tilt.max() < 0.1
    assert np.linalg.norm(T[:, :3, 3] + 0.2 * T[:, :3, 2] - p, axis=1).max() < 3e-4


@pytest.mark.parametrize(
    ("stated", "sigma", "certified"),
    [
        ({"rpy_deg": [0, 0, 10]}, FIXED, True),
        ({"rpy_deg": [0, 0, 10], "sigma_deg": 0.1}, np.radians(0.1), False),
        ({"rpy_deg": [0, 0, 10], "free": "all"}, FREE, False),
        ({}, FREE, False),
    ],
)
def test_what_is_stated_of_the_orientation(
    first_round: Path, tmp_path: Path, stated: dict, sigma: float, certified: bool
) -> None:
    (tmp_path / "poses.csv").write_text((first_round / "one" / "poses.csv").read_text())
    tool = read_campaign(measure(tmp_path, stated)).instruments["eye"].tool
    assert tool.sigma[3:] == pytest.approx((sigma,) * 3)
    assert tool.certified == certified


def test_a_target_that_the_body_lacks_is_refused_with_its_row(first_round: Path, tmp_path: Path) -> None:
    (tmp_path / "poses.csv").write_text((first_round / "one" / "poses.csv").read_text())
    campaign = measure(tmp_path, {})
    text = (tmp_path / "readings.csv").read_text().splitlines()
    text[1] = text[1].replace(text[1].split(",")[3], "7777")
    (tmp_path / "readings.csv").write_text("\n".join(text))
    with pytest.raises(InvalidInput, match=r"readings\.csv, row 2: target 7777"):
        run_campaign(campaign, out=tmp_path / "run", until="identify")
