"""The report as PDF."""

import json
import os
from pathlib import Path

import pytest
from typer.testing import CliRunner

from pipeline.cli import app
from pipeline.report import pdf
from pipeline.report.pdf import NoPrinter, print_report
from tests.pipeline.browser import CHROMIUM


def test_without_a_browser_one_sentence_says_what_to_do(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.delenv("CHROMIUM", raising=False)
    monkeypatch.setattr(pdf.shutil, "which", lambda name: None)
    with pytest.raises(NoPrinter, match="install one"):
        print_report(tmp_path / "report.html", tmp_path / "report.pdf")


@pytest.mark.parametrize("script", ["exit 3", "echo no screen >&2; exit 1"])
def test_a_browser_that_fails_leaves_no_pdf(script: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    program = tmp_path / "browser"
    program.write_text(f"#!/bin/sh\n{script}\n")
    program.chmod(0o755)
    monkeypatch.setenv("CHROMIUM", str(program))
    (tmp_path / "report.html").write_text("<p>x</p>")
    with pytest.raises(NoPrinter, match="did not print"):
        print_report(tmp_path / "report.html", tmp_path / "report.pdf")
    assert sorted(os.listdir(tmp_path)) == ["browser", "report.html"]


@pytest.mark.slow
@pytest.mark.browser
@pytest.mark.skipif(not CHROMIUM, reason="Chromium is not installed")
def test_the_command_prints_all_chapters(point_campaign: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CHROMIUM", CHROMIUM)
    runner = CliRunner()
    run = tmp_path / "run"
    assert runner.invoke(app, ["run", str(point_campaign), "--out", str(run), "-q"]).exit_code == 0
    done = runner.invoke(app, ["report", str(run), "--pdf", "--json", "-q"])
    assert done.exit_code == 0, done.output
    printed = Path(json.loads(done.stdout)["pdf"])
    data = printed.read_bytes()
    assert data.startswith(b"%PDF-")
    assert data.count(b"/Type /Page\n") + data.count(b"/Type /Page ") >= 3
