"""Exit codes, the JSON line, and never a traceback."""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pycolmap
import pytest
import yaml
from typer.testing import CliRunner

from pipeline.cli import app
from tests.pipeline.conftest import edit_yaml

COMMANDS = ("run", "survey", "diagnose", "predict", "compensate", "report", "demo", "poses", "export")

runner = CliRunner()


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_has_help_quiet_and_json(command: str) -> None:
    result = runner.invoke(app, [command, "--help"], env={"COLUMNS": "200"})
    assert result.exit_code == 0
    assert "--json" in result.output
    assert "-q" in result.output


@pytest.mark.parametrize(
    "arguments",
    [
        [],
        ["nonsense"],
        ["run"],
        ["run", "x", "--nonsense"],
        ["run", "x", "--until", "identity"],
        ["run", "x", "--workers", "0"],
        ["compensate", "r", "--frames", "f.csv", "--out", "o.csv", "--as", "poses"],
        ["compensate", "r", "--frames", "f.csv", "--out", "o.csv", "--in", "flange"],
        ["export", "r"],
        ["predict", "r"],
    ],
)
def test_wrong_use_is_exit_code_two(arguments: list[str]) -> None:
    result = runner.invoke(app, arguments)
    assert result.exit_code == 2
    assert "Traceback" not in result.output


@pytest.mark.parametrize(
    "arguments",
    [
        ["run", "{}"],
        ["survey", "{}"],
        ["diagnose", "{}"],
        ["report", "{}"],
        ["predict", "{}", "--poses", "p.csv", "--out", "o.csv"],
        ["compensate", "{}", "--frames", "p.csv", "--out", "o.csv"],
        ["export", "{}", "--urdf", "o.urdf"],
        ["poses", "{}/none.yaml", "--out", "o.csv"],
    ],
)
def test_bad_data_is_exit_code_one_in_one_line(arguments: list[str], tmp_path: Path) -> None:
    result = runner.invoke(app, [a.format(tmp_path) for a in arguments] + ["--json"])
    assert result.exit_code == 1
    lines = result.stderr.strip().splitlines()
    assert len(lines) == 1
    assert lines[0].startswith("error: ")
    answer = json.loads(result.stdout)
    assert answer["ok"] is False
    assert answer["error"] in lines[0]


def test_a_mistake_of_the_program_is_one_line_and_a_traceback_in_the_log(
    point_campaign: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from pipeline.stages import measure

    def broken(*_: object) -> None:
        raise ZeroDivisionError("never shown")

    monkeypatch.setattr(measure, "write_points", broken)
    result = runner.invoke(app, ["run", str(point_campaign), "--out", str(tmp_path / "run")])
    assert result.exit_code == 1
    assert "internal error (ZeroDivisionError)" in result.stderr
    assert "Traceback" not in result.output
    assert "ZeroDivisionError: never shown" in (tmp_path / "run" / "log.txt").read_text()


def test_run_predict_compensate_and_export(frame_campaign: Path, tmp_path: Path) -> None:
    out = tmp_path / "run"
    done = runner.invoke(app, ["run", str(frame_campaign), "--out", str(out), "--until", "verify", "-q", "--json"])
    assert done.exit_code == 0, done.output
    answer = json.loads(done.stdout)
    assert answer["ran"] == ["identify", "verify"]
    verification = answer["verification"]
    assert verification["poses"] == 8
    assert verification["tools"]["0"]["mean"] * 10 < verification["nominal"]["0"]["mean"]
    assert done.stderr == ""
    for name in ("result.json", "robot_calibrated.yaml", "covariance.npz", "residuals.csv", "log.txt"):
        assert (out / name).is_file()

    poses, predicted = frame_campaign / "poses.csv", tmp_path / "predicted.csv"
    told = runner.invoke(app, ["predict", str(out), "--poses", str(poses), "--out", str(predicted), "--json"])
    assert told.exit_code == 0, told.output
    assert json.loads(told.stdout)["poses"] == 48
    header = "pose,x_mm,y_mm,z_mm,roll_deg,pitch_deg,yaw_deg"
    assert predicted.read_text().startswith(header)

    commands = tmp_path / "q.csv"
    arguments = ["compensate", str(out), "--frames", str(predicted), "--out", str(commands), "--skip-unreachable"]
    told = runner.invoke(app, [*arguments, "--json"])
    assert told.exit_code == 0, told.output
    assert json.loads(told.stdout)["remaining_max_mm"] < 1e-4
    assert commands.read_text().startswith("pose,q1_deg,q2_deg")
    program = [*arguments[:5], str(tmp_path / "part.mod"), "--skip-unreachable", "--program", "rapid", "--as", "frames"]
    told = runner.invoke(app, program)
    assert told.exit_code == 0, told.output
    assert "not in the robot's base" in told.stderr
    assert "tool_robcal" in told.stderr
    told = runner.invoke(app, ["export", str(out), "--c", str(tmp_path / "c"), "--urdf", str(tmp_path / "r.urdf")])
    assert told.exit_code == 0, told.output
    assert (tmp_path / "r.urdf").is_file()


def test_survey_alone_and_unknown_body(image_campaign: Path, detected: Path) -> None:
    told = runner.invoke(app, ["survey", str(image_campaign), "--body", "plat", "--out", str(detected)])
    assert told.exit_code == 1
    assert "did you mean 'plate'?" in told.stderr
    done = runner.invoke(app, ["survey", str(image_campaign), "--out", str(detected), "--workers", "1", "--json", "-q"])
    assert done.exit_code == 0, done.output
    answer = json.loads(done.stdout)
    assert answer["ran"] == ["detect", "survey"]
    assert answer["survey"]["plate"]["images"] >= 6
    body = yaml.safe_load((detected / "bodies" / "plate.yaml").read_text(encoding="utf-8"))
    assert all(np.linalg.norm(t["normal"]) == pytest.approx(1.0, abs=1e-5) for t in body["targets"])
    # the targets of the scale bars are listed, but not on the plate
    assert {t["id"] for t in body["targets"]}.isdisjoint({51, 53, 55, 57})
    model = pycolmap.Reconstruction(detected / "colmap" / "plate")
    assert model.num_images() == answer["survey"]["plate"]["images"]
    assert model.num_points3D() == answer["survey"]["plate"]["targets"]
    assert model.compute_mean_reprojection_error() < 1.0


def test_as_a_process_nothing_but_the_sentence_is_printed(point_campaign: Path, tmp_path: Path) -> None:
    edit_yaml(point_campaign / "campaign.yaml", lambda d: d.update(mesurements=1))
    arguments = [sys.executable, "-m", "pipeline", "run", str(point_campaign), "--out", str(tmp_path / "run")]
    done = subprocess.run(arguments, capture_output=True, text=True, timeout=120, env=os.environ, check=False)
    assert done.returncode == 1
    assert "Traceback" not in done.stderr
    assert done.stdout == ""
    assert len(done.stderr.strip().splitlines()) == 1


def test_diagnose_takes_a_run(point_campaign: Path, tmp_path: Path) -> None:
    run = tmp_path / "run"
    begun = runner.invoke(app, ["run", str(point_campaign), "--out", str(run), "-q", "--until", "identify"])
    assert begun.exit_code == 0
    edit_yaml(point_campaign / "campaign.yaml", lambda d: d.pop("diagnosis"))
    result = runner.invoke(app, ["diagnose", str(run), "--json", "-q"])
    assert result.exit_code == 0, result.output
    assert json.loads(result.stdout)["diagnosis"]["format"] == "robcal/diagnosis-1"
