"""Palletisers and Stewart platforms through campaign, run folder and commands."""

import csv
from pathlib import Path

import numpy as np
import pytest

from fixtures import hexapods, loops
from pipeline.exports import Wanted, export_run
from pipeline.json_io import read_json
from pipeline.prediction import compensate_run, predict_run
from pipeline.runner import run_campaign
from robcal.errors import InvalidInput
from tests.pipeline.conftest import edit_yaml


def numbers(path: Path, columns: list[str]) -> np.ndarray:
    with path.open(newline="") as stream:
        return np.array([[float(row[name]) for name in columns] for row in csv.DictReader(stream)])


def missed_mm(path: Path, world_T_tool: np.ndarray) -> float:
    places = numbers(path, ["x_mm", "y_mm", "z_mm"])
    return float(np.sqrt(np.mean(np.sum((places - 1e3 * world_T_tool[:, :3, 3]) ** 2, axis=1))))


@pytest.mark.slow
@pytest.mark.parametrize("fourbar", [False, True], ids=["parallelogram", "fourbar"])
def test_palletiser_from_frames_to_the_noise(fourbar: bool, tmp_path: Path) -> None:
    truth, rng = loops.true_palletiser(1, fourbar), np.random.default_rng(11)
    q = loops.random_angles(truth.description, 120, rng)
    T = loops.write_campaign(tmp_path / "campaign", truth, q, 20, 0.03, 0.007, rng)
    done = run_campaign(tmp_path / "campaign", tmp_path / "run")
    assert read_json(tmp_path / "run" / "diagnosis.json")["mismatch"] is False
    verification = done.result["verification"]
    assert verification["delivered"]["rms"] < 1.25 * 0.03 * np.sqrt(3)
    assert verification["nominal"]["0"]["mean"] > 1.0
    predict_run(tmp_path / "run", tmp_path / "campaign" / "poses.csv", tmp_path / "p.csv")
    assert missed_mm(tmp_path / "p.csv", T) < 0.03
    export_run(tmp_path / "run", Wanted(c=tmp_path / "c"))
    if fourbar:
        with pytest.raises(InvalidInput, match="four-bar of frame 'elbow'"):
            export_run(tmp_path / "run", Wanted(urdf=tmp_path / "r.urdf"))


@pytest.mark.parametrize("kind", ["frames", pytest.param("points", marks=pytest.mark.slow)])
def test_hexapod_through_all_its_commands(kind: str, tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    driven = hexapods.drive(hexapods.true_hexapod(2), 90, rng)
    campaign, run = tmp_path / "campaign", tmp_path / "run"
    hexapods.write_campaign(campaign, driven, 15, kind, 0.02, rng)
    done = run_campaign(campaign, run, until=None if kind == "points" else "verify")
    assert done.result["identification"]["parameters"] == 42
    assert len(done.result["identification"]["eliminated"]) == 12
    assert "diagnosis" not in done.result
    predict_run(run, campaign / "poses.csv", tmp_path / "p.csv")
    assert missed_mm(tmp_path / "p.csv", driven.world_T_tool) < 0.02
    predict_run(run, campaign / "poses.csv", tmp_path / "n.csv", nominal=True)
    assert missed_mm(tmp_path / "n.csv", driven.world_T_tool) > 0.2
    compensate_run(run, tmp_path / "p.csv", tmp_path / "l.csv")
    found = numbers(tmp_path / "l.csv", [f"l{k}_mm" for k in range(1, 7)])
    assert found == pytest.approx(1e3 * driven.lengths, abs=1e-4)
    assert "robcal/hexapod-1" in (run / "robot_calibrated.yaml").read_text()
    with pytest.raises(InvalidInput, match="Stewart platform"):
        export_run(run, Wanted(urdf=tmp_path / "r.urdf"))
    if kind == "points":
        page = (run / "report.html").read_text()
        assert "leg lengths" in page
        assert "joint angles" not in page.split("<script")[0]


@pytest.mark.slow
def test_exchanged_legs_are_named(tmp_path: Path) -> None:
    rng = np.random.default_rng(4)
    driven = hexapods.drive(hexapods.true_hexapod(2), 40, rng)
    hexapods.write_campaign(tmp_path / "campaign", driven, 8, "frames", 0.02, rng)
    poses = tmp_path / "campaign" / "poses.csv"
    poses.write_text(poses.read_text().replace("l2_mm,l3_mm", "l3_mm,l2_mm"))
    edit_yaml(tmp_path / "campaign" / "campaign.yaml", lambda d: d.update(diagnosis={"enabled": False}))
    with pytest.raises(
        InvalidInput, match="leg lengths and measurements do not belong together: the columns of legs 2 and 3"
    ):
        run_campaign(tmp_path / "campaign", tmp_path / "run", until="identify")
