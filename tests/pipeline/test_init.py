"""`pipeline init`: a campaign.yaml from what lies in a folder, which `pipeline check` accepts."""

import json
from pathlib import Path

import numpy as np
import pytest
import yaml
from typer.testing import CliRunner

from pipeline.beginning.writing import begin_campaign
from pipeline.campaign_reader import read_campaign
from pipeline.cli import app
from robcal.errors import InvalidInput
from robcal.files.robot_file import read_robot
from robcal.robot.export.urdf import urdf_text
from tests.pipeline.conftest import edit_rows

runner = CliRunner()


def begun(folder: Path) -> dict:
    """The campaign.yaml written anew, as data; the check accepts it."""
    (folder / "campaign.yaml").unlink(missing_ok=True)
    before = set(folder.rglob("*"))
    done = runner.invoke(app, ["init", str(folder)])
    assert done.exit_code == 0, done.output
    assert set(folder.rglob("*")) - before == {folder / "campaign.yaml"}
    assert runner.invoke(app, ["check", str(folder), "-q"]).exit_code == 0
    return yaml.safe_load((folder / "campaign.yaml").read_text(encoding="utf-8"))


@pytest.mark.parametrize("level", ["point_campaign", "frame_campaign", "image_campaign"])
def test_what_was_written_by_hand_is_found_again(level: str, request: pytest.FixtureRequest) -> None:
    folder: Path = request.getfixturevalue(level)
    wanted = yaml.safe_load((folder / "campaign.yaml").read_text())
    found = begun(folder)
    for key in ("robot", "poses", "measurements"):
        assert found.get(key) == wanted.get(key)
    assert set(found.get("payloads", ())) <= set(wanted.get("payloads", ()))
    assert set(found.get("bodies", ())) == set(wanted.get("bodies", ()))
    if "station" in wanted:
        assert found["station"]["body"] == wanted["station"]["body"]
        cameras = {name: use["images"] for name, use in wanted["station"]["cameras"].items()}
        assert {name: use["images"] for name, use in found["station"]["cameras"].items()} == cameras
        assert found["bodies"]["plate"]["survey"]["images"] == wanted["bodies"]["plate"]["survey"]["images"]


def test_files_of_other_programs(frame_campaign: Path) -> None:
    robot = frame_campaign / "robot.yaml"
    (frame_campaign / "arm.urdf").write_text(urdf_text(read_robot(robot)))
    wanted = read_campaign(frame_campaign).measurements[0].values
    edit_rows(frame_campaign / "poses.csv", lambda rows: [r | {"payload": ""} for r in rows])
    table = frame_campaign / "frames.csv"
    lines = [line.split(",") for line in table.read_text().splitlines()]
    lines[0] = [{"pose": "Name", "x_mm": "X [mm]", "y_mm": "Y [mm]", "z_mm": "Z [mm]"}.get(c, c) for c in lines[0]]
    text = "\n".join(["exported by a tracker", *(";".join(c.replace(".", ",") for c in line) for line in lines)])
    (frame_campaign / "Meßdaten #1.csv").write_text(text, encoding="utf-8")
    robot.unlink()
    table.unlink()
    found = begun(frame_campaign)
    assert found["robot"] == "arm.urdf"
    use = found["measurements"]
    assert use["file"] == "Meßdaten #1.csv"
    assert (use["sep"], use["decimal"], use["skip_rows"]) == (";", ",", 1)
    np.testing.assert_allclose(read_campaign(frame_campaign).measurements[0].values, wanted, atol=1e-12)


def test_an_existing_file_is_never_overwritten(point_campaign: Path) -> None:
    path = point_campaign / "campaign.yaml"
    before = path.read_bytes()
    done = runner.invoke(app, ["init", str(point_campaign), "--json"])
    assert done.exit_code == 1
    assert "never overwritten" in json.loads(done.stdout)["error"]
    assert path.read_bytes() == before


def test_folders_without_anything(tmp_path: Path) -> None:
    assert "no such folder" in runner.invoke(app, ["init", str(tmp_path / "none")]).stderr
    (tmp_path / "notes.txt").write_text("hello\nworld\n")
    (tmp_path / "broken.yaml").write_text("a: [")
    done = runner.invoke(app, ["init", str(tmp_path)])
    assert done.exit_code == 1
    assert "neither images nor measurements" in done.stderr
    assert sorted(p.name for p in tmp_path.iterdir()) == ["broken.yaml", "notes.txt"]


def test_tables_in_utf_16_are_named(tmp_path: Path) -> None:
    (tmp_path / "frames.csv").write_text("pose,x_mm,y_mm,z_mm\np1,1,2,3\n", encoding="utf-16")
    with pytest.raises(InvalidInput, match=r"not understood: frames\.csv"):
        begin_campaign(tmp_path)
