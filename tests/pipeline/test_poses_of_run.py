"""`pipeline poses RUN`: the run's robot, cameras and body, base and tool included."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from pipeline.cli import app
from pipeline.pose_request_of_run import describe_run
from robcal.errors import InvalidInput
from robcal.files.tables import read_table

runner = CliRunner()
ROBOTS = Path(__file__).parents[2] / "configs" / "robots"


@pytest.fixture
def run(tmp_path: Path) -> Path:
    """A folder with what a run leaves of its robot."""
    folder = tmp_path / "run"
    folder.mkdir()
    cell = "world_T_base: {xyz_mm: [2000, 0, 0], rpy_deg: [0, 0, 180]}\nflange_T_tool: {xyz_mm: [0, 0, 150]}\n"
    text = (ROBOTS / "irb120_like.yaml").read_text(encoding="utf-8")
    (folder / "robot_calibrated.yaml").write_text(text + cell, encoding="utf-8")
    return folder


@pytest.mark.slow
def test_poses_of_a_run(run: Path, tmp_path: Path) -> None:
    done = runner.invoke(app, ["poses", str(run), "--out", str(tmp_path / "more.csv"), "--json", "-q"])
    assert done.exit_code == 0, done.output
    assert json.loads(done.stdout)["poses"] == 100
    assert read_table(tmp_path / "more.csv").columns["set"].count("verify") == 20
    description = tmp_path / "more_cell.yaml"
    assert "robot: run\n" in description.read_text(encoding="utf-8")


def test_cameras_and_the_body_that_they_see(run: Path, tmp_path: Path) -> None:
    for name in ("cameras", "bodies"):
        (run / name).mkdir()
    camera = "format: robcal/camera-1\nwidth: 640\nheight: 480\nfx: 800\nfy: 801\ncx: 320\ncy: 240\n"
    (run / "cameras" / "left.yaml").write_text(camera + "world_T_camera: {xyz_mm: [1, 2, 3], rpy_deg: [0, 0, 90]}\n")
    (run / "cameras" / "survey.yaml").write_text(camera)
    targets = "".join(f"  - {{id: {k}, xyz_mm: [{k}, 0, 0], normal: [0, -1, 0]}}\n" for k in (1, 2, 3))
    (run / "bodies" / "plate.yaml").write_text(f"format: robcal/body-1\ntargets:\n{targets}")
    describe_run(run, tmp_path / "cell.yaml")
    text = (tmp_path / "cell.yaml").read_text(encoding="utf-8")
    assert "left: run/cameras/left.yaml" in text
    assert "survey" not in text
    assert "facing: [0.0, -1.0, 0.0]" in text
    describe_run(run, tmp_path / "cell.yaml")
    assert (tmp_path / "cell.yaml").read_text(encoding="utf-8") == text

    (run / "bodies" / "sphere.yaml").write_text(f"format: robcal/body-1\ntargets:\n{targets}")
    with pytest.raises(InvalidInput, match="plate, sphere"):
        describe_run(run, tmp_path / "other.yaml")


def test_a_folder_without_a_robot(tmp_path: Path) -> None:
    with pytest.raises(InvalidInput, match=r"holds no robot_calibrated\.yaml"):
        describe_run(tmp_path, tmp_path / "cell.yaml")
