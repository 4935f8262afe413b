"""Closed loops from a table: a tip held at a point, on a plane, by a bar identifies a robot without any instrument."""

import json
from pathlib import Path

import numpy as np
import pytest
import yaml

from fixtures.campaigns import write_table, write_yaml
from fixtures.rigid import frame_from_six
from fixtures.touching import touching
from fixtures.true_robot import Circumstances, TrueRobot
from pipeline.campaign_reader import read_campaign
from pipeline.prediction import predict_run
from pipeline.runner import run_campaign
from robcal.errors import InvalidInput
from robcal.files.tables import read_table

ROBOT = Path(__file__).parents[2] / "configs" / "robots" / "kr150_class.yaml"
TRUTH = {"axis2.pitch": 2e-3, "axis3.pitch": -1.5e-3, "axis3.x": 4e-4, "axis5.pitch": 1e-3}
TOOL = frame_from_six([0.12, 0.0, 0.25, 0.0, 0.0, 0.0])
MIDDLE = np.radians([10.0, -60.0, 95.0, 20.0, 55.0, 30.0])
ROWS = 24


def held_poses(rng: np.random.Generator) -> tuple[dict, dict]:  # type: ignore[type-arg]
    """poses.csv and constraints.csv of a true robot: a point, a plane, a bar of 0.3 m, each within 0.02 mm."""
    true = TrueRobot(yaml.safe_load(ROBOT.read_text()), TRUTH, flange_T_tool=TOOL)
    centre = true.world_T_tool(MIDDLE[None])[0, :3, 3]
    away = rng.standard_normal((ROWS, 3))
    away /= np.linalg.norm(away, axis=1, keepdims=True)
    places = {
        "tip": 0.0 * away,
        "table": rng.uniform(-0.3, 0.3, (ROWS, 3)) * [1, 1, 0],
        "bar": 0.3 * away * [1, 1, 0.5] / np.linalg.norm(away * [1, 1, 0.5], axis=1, keepdims=True),
    }
    q, table = [], {k: [] for k in ("pose", "constraint", "kind", "value_mm", "sigma_mm")}  # type: ignore[var-annotated]
    kinds = {"tip": ("point", ""), "table": ("plane", 0.0), "bar": ("length", 300.0)}
    for name, local in places.items():
        start = MIDDLE + rng.uniform(-0.3, 0.3, (ROWS, 6)) * np.array([1, 1, 1, 2, 1.5, 4])
        q.append(touching(true, start, centre + local + 2e-5 * rng.standard_normal((ROWS, 3))))
        kind, value = kinds[name]
        first = len(table["pose"])
        table["pose"] += [f"p{first + i:03d}" for i in range(ROWS)]
        table["constraint"] += [name] * ROWS
        table["kind"] += [kind] * ROWS
        table["value_mm"] += [value] * ROWS
        table["sigma_mm"] += [0.02] * ROWS
    angles = np.degrees(np.concatenate(q))
    poses = {"pose": table["pose"], **{f"q{k + 1}_deg": angles[:, k].tolist() for k in range(6)}}
    poses["set"] = ["verify" if k % 8 == 7 else "identify" for k in range(3 * ROWS)]
    return poses, table


@pytest.fixture(scope="module")
def loops(tmp_path_factory):  # type: ignore[no-untyped-def]
    folder = tmp_path_factory.mktemp("loops")
    poses, table = held_poses(np.random.default_rng(4))
    write_table(folder / "poses.csv", poses)
    write_table(folder / "constraints.csv", table)
    write_yaml(
        folder / "campaign.yaml",
        {
            "format": "robcal/campaign-1",
            "name": "loops",
            "robot": str(ROBOT),
            "poses": "poses.csv",
            "measurements": "constraints.csv",
            "model": {"parameters": list(TRUTH)},
        },
    )
    run_campaign(folder, out=folder / "run")
    return folder


def test_the_robot_and_its_tip_are_identified_from_loops_alone(loops: Path) -> None:
    covariance = np.load(loops / "run" / "covariance.npz")
    found = dict(zip(covariance["names"].tolist(), covariance["theta"].tolist(), strict=True))
    sigma = dict(zip(covariance["names"].tolist(), np.sqrt(np.diag(covariance["covariance"])), strict=True))
    for name, value in TRUTH.items():
        assert abs(found[name] - value) < 4 * sigma[name], name
        assert sigma[name] < 0.3 * abs(value), name
    result = json.loads((loops / "run" / "result.json").read_text())
    names = set(result["instruments"])
    assert names == {"measurements-tip", "measurements-table", "measurements-bar"}
    assert {entry["kind"] for entry in result["instruments"].values()} == {"constraints"}
    assert all(0.6 < entry["sigma0"] < 1.5 for entry in result["instruments"].values())
    tool = np.array(result["instruments"]["measurements-tip"]["flange_T_tool"]["xyz_mm"])
    assert np.linalg.norm(tool - 1e3 * TOOL[:3, 3]) < 0.3


def test_the_identified_robot_goes_where_the_true_one_goes(loops: Path) -> None:
    predict_run(loops / "run", loops / "poses.csv", loops / "f.csv", instrument="measurements-tip")
    table = read_table(loops / "f.csv")
    p = np.column_stack([table.numbers(f"{a}_mm") for a in "xyz"])
    q = np.radians(np.column_stack([read_table(loops / "poses.csv").numbers(f"q{k}_deg") for k in range(1, 7)]))
    true = TrueRobot(yaml.safe_load(ROBOT.read_text()), TRUTH, flange_T_tool=TOOL)
    t = 1e3 * true.world_T_tool(q, Circumstances.plain(len(q), 6))[:, :3, 3]
    a, b = p - p.mean(axis=0), t - t.mean(axis=0)
    U, _, Vt = np.linalg.svd(a.T @ b)
    assert np.linalg.norm(a @ U @ Vt - b, axis=1).mean() < 0.1


@pytest.mark.parametrize(
    ("old", "new", "sentence"),
    [
        (",plane,", ",line,", "kind is 'line': a closed loop is a point, a plane, a length"),
        (",length,300.0,", ",length,-1,", "the length of a bar is above zero"),
        (",length,", ",plane,", "constraint 'bar' is a plane before and a length here"),
        ("p024,", "p999,", "pose 'p999' is not in the table of poses"),
        (",0.02", ",0", "sigma_mm"),
    ],
)
def test_bad_rows_are_told_with_file_and_row(loops: Path, tmp_path: Path, old: str, new: str, sentence: str) -> None:
    for name in ("poses.csv", "campaign.yaml"):
        (tmp_path / name).write_text((loops / name).read_text())
    text = (loops / "constraints.csv").read_text()
    assert old in text
    (tmp_path / "constraints.csv").write_text(text.replace(old, new, 1))
    with pytest.raises(InvalidInput, match=rf"constraints\.csv, row \d+: .*{sentence}"):
        read_campaign(tmp_path)
