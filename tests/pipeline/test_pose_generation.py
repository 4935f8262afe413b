"""Command poses: a description of a cell in, a table of poses out that a campaign can read; errors in one sentence."""

from pathlib import Path

import numpy as np
import pytest
import yaml

from pipeline.pose_generation import generate_poses, read_request
from robcal.calibration.pose_candidates import check_poses
from robcal.errors import InvalidInput
from robcal.files.poses_table import read_poses

CONFIGS = Path(__file__).resolve().parents[2] / "configs"


def description(folder: Path, **changes: object) -> Path:
    """The example with its files named absolutely and small numbers."""
    data = yaml.safe_load((CONFIGS / "poses" / "kr150_station.yaml").read_text())
    data["robot"] = str(CONFIGS / "robots" / "kr150_class.yaml")
    data["body"]["targets"] = str(CONFIGS / "bodies" / "plate_five_targets.yaml")
    data["cameras"] = {name: str(CONFIGS / "cameras" / Path(file).name) for name, file in data["cameras"].items()}
    data["choice"] = {"method": "worst_case", "count": 12, "verify": 4, "candidates": 60}
    for key, value in changes.items():
        if value is None:
            data.pop(key)
        elif isinstance(value, dict) and isinstance(data.get(key), dict):
            data[key] = {**data[key], **value}
        else:
            data[key] = value
    path = folder / "cell.yaml"
    path.write_text(yaml.safe_dump(data))
    return path


def test_poses_can_be_driven_and_read_as_a_campaign(tmp_path):
    config, out = description(tmp_path), tmp_path / "poses.csv"
    answer = generate_poses(config, out)
    request = read_request(config)
    poses = read_poses(out, request.model, request.model.payloads)
    assert answer["poses"] == len(poses) == 16
    assert answer["verify"] == 4
    assert check_poses(request.model, request.cell, poses.q).all()
    assert 0 < answer["predicted_mean_mm"] < answer["predicted_worst_mm"] < 1
    path = (tmp_path / "poses_path.csv").read_text().splitlines()
    assert sum(not line.split(",")[0].endswith("_via") for line in path[1:]) == 16
    header = out.read_text().splitlines()[0].split(",")
    assert header[-6:] == [f"approach{k}" for k in range(1, 7)]
    signs = np.loadtxt(out, delimiter=",", skiprows=1, usecols=range(len(header) - 6, len(header)))
    assert np.abs(signs.sum(axis=0)).max() <= 1


def test_the_example_of_the_repository_is_valid():
    request = read_request(CONFIGS / "poses" / "kr150_station.yaml")
    assert len(request.cell.viewpoints) == 2
    assert len(request.cell.obstacles) == 2


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"chioce": {}}, "chioce"),
        ({"payload": "anvil"}, "anvil"),
        ({"body": None}, "no body for them to see"),
        ({"visibility": {"cameras": 3}}, "asks for 3 cameras"),
        ({"collision": {"obstacles": [{"kind": "box", "xyz_mm": [0, 0, 0]}]}}, "size_mm is missing"),
        ({"collision": {"capsules": [{"frame": "elbow", "end_mm": [1, 0, 0], "radius_mm": 10}]}}, "'elbow'"),
        ({"start": [0, 0]}, "start has 2"),
        ({"choice": {"parameters": ["axis9.x"]}}, "axis9.x"),
        ({"world_T_base": {"xyz_mm": [0, 50000, 0], "rpy_deg": [0, 0, 0]}}, "most fail by visibility"),
    ],
)
def test_contradictions_are_told_with_the_file(changes, words, tmp_path):
    config = description(tmp_path, **changes)
    with pytest.raises(InvalidInput, match=words) as problem:
        generate_poses(config, tmp_path / "poses.csv")
    assert "cell.yaml" in str(problem.value)
    assert not (tmp_path / "poses.csv").exists()


def test_a_run_gives_robot_base_and_tool_that_are_not_stated(tmp_path):
    run = tmp_path / "run"
    run.mkdir()
    robot = yaml.safe_load((CONFIGS / "robots" / "kr150_class.yaml").read_text(encoding="utf-8"))
    robot["world_T_base"] = {"xyz_mm": [10.0, 20.0, 30.0], "rpy_deg": [0, 0, 0]}
    robot["flange_T_tool"] = {"xyz_mm": [1.0, 2.0, 150.0], "rpy_deg": [0, 0, 0]}
    (run / "robot_calibrated.yaml").write_text(yaml.safe_dump(robot), encoding="utf-8")
    body = {"targets": str(CONFIGS / "bodies" / "plate_five_targets.yaml")}
    config = description(tmp_path, robot="run", world_T_base=None)
    stated = read_request(config).cell
    assert np.allclose(stated.world_T_base[:3, 3], [0.01, 0.02, 0.03])
    assert np.allclose(stated.flange_T_body[:3, 3], [0, 0, 0.15])  # the file's own goes before
    data = yaml.safe_load(config.read_text(encoding="utf-8"))
    config.write_text(yaml.safe_dump({**data, "body": body}), encoding="utf-8")
    assert np.allclose(read_request(config).cell.flange_T_body[:3, 3], [0.001, 0.002, 0.15])
