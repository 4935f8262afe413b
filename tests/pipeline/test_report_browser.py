"""The report in Chromium, headless: no error, every plot drawn, no request."""

from __future__ import annotations

import os
import shutil
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from pipeline.report import write_report
from pipeline.report.style import NIGHT, PAPER
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


def wait_until(tab: Any, condition: str) -> None:
    """Playwright's own waiting evaluates text in the page, which the report's policy forbids."""
    end = time.monotonic() + PATIENCE_S
    while not tab.evaluate(condition):
        assert time.monotonic() < end, condition
        tab.wait_for_timeout(100)


@contextmanager
def page_of(report: Path, width: int = 1200, scheme: str = "light") -> Iterator[tuple[Any, list[str], list[str]]]:
    """A report in a browser, all plots drawn; problems and requests as they come."""
    playwright = pytest.importorskip("playwright.sync_api")
    problems: list[str] = []
    requests: list[str] = []
    with playwright.sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=CHROMIUM, args=ARGUMENTS)
        tab = browser.new_page(viewport={"width": width, "height": 900}, color_scheme=scheme)
        tab.set_default_timeout(1000 * PATIENCE_S)
        tab.on("console", lambda m: problems.append(m.text) if m.type == "error" else None)
        tab.on("pageerror", lambda e: problems.append(str(e)))
        tab.on("dialog", lambda d: (problems.append(f"dialog {d.message}"), d.dismiss()))
        tab.on("request", lambda r: requests.append(r.url))
        tab.goto(report.resolve().as_uri())
        wait_until(tab, "(d => d.plots !== undefined && d.plots === d.drawn)(document.documentElement.dataset)")
        yield tab, problems, requests
        browser.close()


def opened(report: Path, width: int = 1200) -> dict:
    """What a browser makes of a report."""
    with page_of(report, width) as (tab, problems, requests):
        state: dict = tab.evaluate("() => ({...document.documentElement.dataset})")
        state["shown"] = tab.evaluate(
            "() => [...document.querySelectorAll('.plot')].filter(d => d.querySelector('svg.main-svg')"
            " && d.getBoundingClientRect().height > 50).length"
        )
        state["scroll"] = tab.evaluate(
            "() => document.documentElement.scrollWidth - document.documentElement.clientWidth"
        )
        state["title"] = tab.title()
    outside = [url for url in requests if not url.startswith(("file:", "data:", "blob:"))]
    return {**state, "problems": problems, "outside": outside}


MARKED = """() => [...document.querySelectorAll('.plot')].filter(
    d => d.data.some(t => t.name === 'chosen pose' || (t.selectedpoints || []).length)).length"""


def test_a_chosen_pose_is_marked_in_plots_and_rows_and_the_page_fits_a_phone(diagnosed: Run) -> None:  # noqa: F811
    with page_of(diagnosed.report, scheme="dark") as (tab, problems, _):
        assert tab.evaluate(MARKED) == 0
        row = tab.locator("tr[data-pose]").nth(1)
        row.locator("button.choose").press("Enter")  # by keyboard
        pose = row.get_attribute("data-pose")
        assert tab.locator("#pose").input_value() == pose
        assert tab.locator("tr.chosen").count() == 1
        assert tab.evaluate(MARKED) >= 4
        assert "marked in" in tab.locator("#chosen").inner_text()
        tab.keyboard.press("Escape")
        assert tab.evaluate(MARKED) == 0
        tab.locator("#verification .scatterlayer .point").last.click(force=True)  # by mouse, in a plot
        assert tab.locator("#pose").input_value() != ""
        assert tab.evaluate(MARKED) >= 4
        colours = "() => [...document.querySelectorAll('.plot')].map(d => d.layout.paper_bgcolor)"
        assert set(tab.evaluate(colours)) == {NIGHT[PAPER]}
        tab.emulate_media(color_scheme="light")
        wait_until(tab, f"document.querySelector('.plot').layout.paper_bgcolor === '{PAPER}'")
        tab.set_viewport_size({"width": 390, "height": 800})
        tab.wait_for_timeout(200)
        assert tab.evaluate("() => document.documentElement.scrollWidth - document.documentElement.clientWidth") <= 0
        assert problems == []


def test_the_report_of_a_diagnosed_robot(diagnosed: Run) -> None:  # noqa: F811
    state = opened(diagnosed.report)
    assert state["problems"] == []
    assert state["outside"] == []
    assert int(state["plots"]) >= 7
    assert state["drawn"] == state["plots"]
    assert state["shown"] == int(state["plots"])
    assert state["title"].startswith(HOSTILE)


def test_the_report_of_images(image_run: Path, tmp_path: Path) -> None:
    folder = shutil.copytree(image_run, tmp_path / "run")
    with page_of(write_report(open_run(folder)), width=390) as (tab, problems, requests):
        assert problems == []
        assert all(url.startswith(("file:", "data:", "blob:")) for url in requests)
        assert tab.evaluate("() => document.documentElement.scrollWidth - document.documentElement.clientWidth") <= 0
        shown = tab.locator("figure.seen:visible").count()
        pose = tab.locator("figure.seen.extra").first.get_attribute("data-pose")
        tab.locator("#pose").select_option(pose)
        assert tab.locator("figure.seen.chosen:visible").count() >= 1
        assert tab.locator("figure.seen:visible").count() > shown
        tab.locator("figure.seen.chosen > svg").first.click(force=True)
        mark = tab.locator("#viewer .mark:has(.residual)").first
        mark.focus()
        assert "residual" in tab.locator("#viewer output").inner_text()
        tab.locator("#viewer input[name=residuals]").uncheck()
        assert not mark.locator(".residual").is_visible()
        tab.keyboard.press("Escape")
        assert not tab.locator("#viewer").is_visible()
        assert problems == []
