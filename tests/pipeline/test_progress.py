"""Dry runs, interruption, progress, version, completion, and what programs are told."""

import io
import json
import logging
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from typer.testing import CliRunner

from pipeline.campaign_reader import read_campaign
from pipeline.cli import app
from pipeline.messages import LOG, show, track, working
from pipeline.runner import default_folder
from tests.pipeline.conftest import edit_rows

runner = CliRunner()


def test_a_dry_run_says_what_would_run_and_does_nothing(frame_campaign: Path, tmp_path: Path) -> None:
    out = tmp_path / "run"
    before = set(tmp_path.rglob("*"))
    done = runner.invoke(app, ["run", str(frame_campaign), "--out", str(out), "--dry-run", "--json"])
    assert done.exit_code == 0
    assert set(tmp_path.rglob("*")) == before
    planned = {stage["stage"]: stage for stage in json.loads(done.stdout)["stages"]}
    assert {"identify", "verify", "report"} <= set(planned)
    assert all(stage["runs"] and stage["seconds"] > 0 for stage in planned.values())
    assert {"frames.csv", "poses.csv", "robot.yaml"} <= set(planned["identify"]["inputs"])
    assert runner.invoke(app, ["run", str(frame_campaign), "--out", str(out), "-q"]).exit_code == 0
    told = runner.invoke(app, ["run", str(frame_campaign), "--out", str(out), "--dry-run"]).stderr
    assert told.count("up to date") == len(planned)
    edit_rows(frame_campaign / "frames.csv", lambda rows: rows[:-1])
    answer = json.loads(
        runner.invoke(app, ["run", str(frame_campaign), "--out", str(out), "--dry-run", "--json"]).stdout
    )
    assert all(stage["runs"] for stage in answer["stages"])


def test_programs_get_the_warnings_of_the_terminal(point_campaign: Path, tmp_path: Path) -> None:
    edit_rows(point_campaign / "points.csv", lambda rows: [r for r in rows if r["pose"] != "p003"])
    arguments = ["run", str(point_campaign), "--out", str(tmp_path / "run"), "--until", "frames", "--json"]
    done = runner.invoke(app, arguments)
    (line,) = [line for line in done.stderr.splitlines() if "p003" in line and line.startswith("warning: ")]
    assert line.removeprefix("warning: ") in json.loads(done.stdout)["warnings"]


def _heed_ctrl_c() -> None:
    signal.signal(signal.SIGINT, signal.SIG_DFL)


@pytest.mark.skipif(os.name == "nt", reason="signals of another system")
def test_ctrl_c_ends_at_once_and_the_same_command_goes_on(frame_campaign: Path, tmp_path: Path) -> None:
    text = (frame_campaign / "campaign.yaml").read_text().replace("enabled: false", "enabled: true")
    (frame_campaign / "campaign.yaml").write_text(text)
    out = tmp_path / "run"
    command = [sys.executable, "-m", "pipeline", "run", str(frame_campaign), "--out", str(out), "--workers", "1"]
    # a shell that runs the tests in the background has them ignore the signal, and what they start inherits that
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True, preexec_fn=_heed_ctrl_c)
    record = out / "state" / "identify.json"
    end = time.monotonic() + 120
    # the diagnosis, which takes seconds, follows
    while not record.is_file() and time.monotonic() < end and process.poll() is None:
        time.sleep(0.05)
    process.send_signal(signal.SIGINT)
    _, told = process.communicate(timeout=20)
    assert process.returncode == 130
    assert "interrupted" in told
    assert "Traceback" not in told
    assert record.is_file()
    planned = json.loads(
        runner.invoke(app, ["run", str(frame_campaign), "--out", str(out), "--dry-run", "--json"]).stdout
    )
    runs = {stage["stage"]: stage["runs"] for stage in planned["stages"]}
    assert runs["identify"] is False
    assert runs["diagnose"] is True


def test_version_and_completion() -> None:
    assert runner.invoke(app, ["--version"]).output.startswith("robcal ")
    environment = {"_PIPELINE_COMPLETE": "complete_bash", "COMP_WORDS": "pipeline su", "COMP_CWORD": "1"}
    done = runner.invoke(app, [], prog_name="pipeline", env=environment)
    assert "survey" in done.output


def test_the_default_run_folder_lies_beside_the_campaign(
    point_campaign: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    monkeypatch.chdir(elsewhere)
    campaign = read_campaign(point_campaign)
    assert default_folder(campaign) == point_campaign.parent / "runs" / campaign.name
    begun = elsewhere / "runs" / campaign.name / "state"
    begun.mkdir(parents=True)
    (begun / "run.json").write_text("{}")
    assert default_folder(campaign) == Path("runs") / campaign.name


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def test_a_bar_on_a_terminal_and_lines_without_one(monkeypatch: pytest.MonkeyPatch) -> None:
    screen = Terminal()
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setattr(sys, "stderr", screen)
    show(quiet=False)
    with working("identify", 60.0):
        time.sleep(0.3)
    assert "identify" in screen.getvalue()
    assert "left" in screen.getvalue()
    with working("detect", None):
        assert list(track([1, 2, 3], 3, "detecting targets")) == [1, 2, 3]
    assert "detecting targets" in screen.getvalue()
    plain = io.StringIO()
    monkeypatch.setattr(sys, "stderr", plain)
    monkeypatch.setattr("pipeline.messages.BETWEEN_LINES", 0.0)
    show(quiet=False)
    assert list(track(iter("abc"), 3, "detecting targets")) == list("abc")
    assert "detecting targets: 2 of 3, about" in plain.getvalue()
    for handler in [h for h in LOG.handlers if not isinstance(h, logging.NullHandler)]:
        LOG.removeHandler(handler)
