"""The report in Chromium, headless: no error, every plot drawn, no request; poses chosen and images opened."""

import shutil
from pathlib import Path

import pytest

from pipeline.report import write_report
from pipeline.report.style import NIGHT, PAPER
from pipeline.runs import Run, open_run
from tests.pipeline.browser import needs_browser, opened, page_of, wait_until
from tests.pipeline.test_report import HOSTILE, diagnosed  # noqa: F401

pytestmark = [pytest.mark.browser, needs_browser]

MARKED = """() => [...document.querySelectorAll('.plot')].filter(
    d => d.data.some(t => t.name === 'chosen pose' || (t.selectedpoints || []).length)).length"""


@pytest.mark.slow
def test_a_chosen_pose_is_marked_in_plots_and_rows(diagnosed: Run) -> None:  # noqa: F811
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
        assert problems == []


def test_the_report_of_a_diagnosed_robot(diagnosed: Run) -> None:  # noqa: F811
    state = opened(diagnosed.report)
    assert state["problems"] == []
    assert state["outside"] == []
    assert int(state["plots"]) >= 7
    assert state["drawn"] == state["plots"]
    assert state["shown"] == int(state["plots"])
    assert state["title"].startswith(HOSTILE)
    assert state["scroll"] <= 0


@pytest.mark.slow
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
