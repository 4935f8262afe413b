"""The report in Chromium, headless: no error, every plot drawn, no request."""

from __future__ import annotations

import os
import shutil
import time
from pathlib import Path

import pytest

from pipeline.report import write_report
from pipeline.runs import Run, open_run
from tests.pipeline.test_report import HOSTILE, diagnosed  # noqa: F401

CHROMIUM = os.environ.get("CHROMIUM") or shutil.which("chromium") or shutil.which("chromium-browser") or ""
PATIENCE_S = 120

pytestmark = [pytest.mark.browser, pytest.mark.skipif(not CHROMIUM, reason="Chromium is not installed")]
ARGUMENTS = [
    "--no-sandbox",
    "--disable-gpu",
    "--disable-dev-shm-usage",
    "--use-gl=angle",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
]


def opened(report: Path, width: int = 1200) -> dict:
    """What a browser makes of a report."""
    playwright = pytest.importorskip("playwright.sync_api")
    problems: list[str] = []
    requests: list[str] = []
    with playwright.sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=CHROMIUM, args=ARGUMENTS)
        tab = browser.new_page(viewport={"width": width, "height": 900})
        tab.on("console", lambda m: problems.append(m.text) if m.type == "error" else None)
        tab.on("pageerror", lambda e: problems.append(str(e)))
        tab.on("dialog", lambda d: (problems.append(f"dialog {d.message}"), d.dismiss()))
        tab.on("request", lambda r: requests.append(r.url))
        tab.goto(report.resolve().as_uri())
        end = time.monotonic() + PATIENCE_S
        state: dict = {}
        while time.monotonic() < end:
            state = tab.evaluate("() => ({...document.documentElement.dataset})")
            if state.get("plots") == state.get("drawn"):
                break
            tab.wait_for_timeout(200)
        state["shown"] = tab.evaluate(
            "() => [...document.querySelectorAll('.plot')].filter(d => d.querySelector('svg.main-svg')"
            " && d.getBoundingClientRect().height > 50).length"
        )
        state["scroll"] = tab.evaluate(
            "() => document.documentElement.scrollWidth - document.documentElement.clientWidth"
        )
        state["title"] = tab.title()
        browser.close()
    outside = [url for url in requests if not url.startswith(("file:", "data:", "blob:"))]
    return {**state, "problems": problems, "outside": outside}


def test_the_report_of_a_diagnosed_robot(diagnosed: Run) -> None:  # noqa: F811
    state = opened(diagnosed.report)
    assert state["problems"] == []
    assert state["outside"] == []
    assert int(state["plots"]) >= 7
    assert state["drawn"] == state["plots"]
    assert state["shown"] == int(state["plots"])
    assert state["title"].startswith(HOSTILE)


def test_the_report_fits_a_narrow_window(diagnosed: Run) -> None:  # noqa: F811
    assert opened(diagnosed.report, width=480)["scroll"] <= 0


def test_the_report_of_images(image_run: Path, tmp_path: Path) -> None:
    folder = shutil.copytree(image_run, tmp_path / "run")
    state = opened(write_report(open_run(folder)))
    assert state["problems"] == []
    assert state["outside"] == []
    assert state["drawn"] == state["plots"]
