"""Pages in Chromium, headless."""

import os
import shutil
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

CHROMIUM = os.environ.get("CHROMIUM") or shutil.which("chromium") or shutil.which("chromium-browser") or ""
PATIENCE_S = 120
NARROW = {"width": 480, "height": 900}
ARGUMENTS = [
    "--no-sandbox",
    "--disable-gpu",
    "--disable-dev-shm-usage",
    "--use-gl=angle",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
]

needs_browser = pytest.mark.skipif(not CHROMIUM, reason="Chromium is not installed")


def wait_until(tab: Any, condition: str) -> None:
    """Playwright's own waiting evaluates text in the page, which the report's policy forbids."""
    end = time.monotonic() + PATIENCE_S
    while not tab.evaluate(condition):
        assert time.monotonic() < end, condition
        tab.wait_for_timeout(100)


@contextmanager
def page_of(page: Path, width: int = 1200, scheme: str = "light") -> Iterator[tuple[Any, list[str], list[str]]]:
    """A page in a browser, all plots drawn; problems and requests as they come."""
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
        tab.goto(page.resolve().as_uri())
        wait_until(tab, "(d => d.plots === d.drawn)(document.documentElement.dataset)")
        yield tab, problems, requests
        browser.close()


def opened(page: Path) -> dict:
    """What a browser makes of a page: problems, requests to outside, plots drawn and shown, what a narrow one cuts."""
    with page_of(page) as (tab, problems, requests):
        state: dict = tab.evaluate("() => ({...document.documentElement.dataset})")
        state["shown"] = tab.evaluate(
            "() => [...document.querySelectorAll('.plot')].filter(d => d.querySelector('svg.main-svg')"
            " && d.getBoundingClientRect().height > 50).length"
        )
        state["title"], state["text"] = tab.title(), tab.inner_text("body")
        tab.set_viewport_size(NARROW)
        for _ in range(50):  # plots follow the window after a while
            tab.wait_for_timeout(200)
            state["scroll"] = tab.evaluate(
                "() => document.documentElement.scrollWidth - document.documentElement.clientWidth"
            )
            if state["scroll"] <= 0:
                break
    outside = [url for url in requests if not url.startswith(("file:", "data:", "blob:"))]
    return {**state, "problems": problems, "outside": outside}
