"""The report in Chromium, headless: no error, every plot drawn, no request."""

import shutil
from pathlib import Path

import pytest

from pipeline.report import write_report
from pipeline.runs import Run, open_run
from tests.pipeline.browser import needs_browser, opened
from tests.pipeline.test_report import HOSTILE, diagnosed  # noqa: F401

pytestmark = [pytest.mark.browser, needs_browser]


def test_the_report_of_a_diagnosed_robot(diagnosed: Run) -> None:  # noqa: F811
    state = opened(diagnosed.report)
    assert state["problems"] == []
    assert state["outside"] == []
    assert int(state["plots"]) >= 7
    assert state["drawn"] == state["plots"]
    assert state["shown"] == int(state["plots"])
    assert state["title"].startswith(HOSTILE)
    assert state["scroll"] <= 0


def test_the_report_of_images(image_run: Path, tmp_path: Path) -> None:
    folder = shutil.copytree(image_run, tmp_path / "run")
    state = opened(write_report(open_run(folder)))
    assert state["problems"] == []
    assert state["outside"] == []
    assert state["drawn"] == state["plots"]
