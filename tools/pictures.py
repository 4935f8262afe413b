"""The pictures of docs/tutorial.md and docs/plate.md, made by the commands that these pages show.

    python -m tools.pictures [--demo FOLDER]

FOLDER holds what `pipeline demo --out FOLDER` left; without it a campaign is rendered and run here: a minute.
Needs Chromium for the pages of the report (`test` of pyproject.toml brings its driver).
"""

import argparse
import os
import shutil
import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import pypdfium2
from playwright.sync_api import sync_playwright

ROOT = Path(__file__).resolve().parent.parent
IMAGES = ROOT / "docs" / "images"
SHEET = """format: robcal/targets-1
page: A3
targets: {diameter_mm: 12, count: 12, plain: 23}
layout: {kind: plate, columns: 7, rows: 5, pitch_mm: 48}
"""
CHROMIUM = os.environ.get("CHROMIUM") or shutil.which("chromium") or shutil.which("chromium-browser") or ""
PATIENCE_S = 180
DRAWING = ["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]


def pipeline(*arguments: str | Path) -> None:
    """A command as a user gives it."""
    subprocess.run([sys.executable, "-m", "pipeline", *map(str, arguments), "-q"], check=True, cwd=ROOT)


def sheet(folder: Path) -> None:
    """A printed plate."""
    (folder / "plate_sheet.yaml").write_text(SHEET, encoding="utf-8")
    pipeline("targets", folder / "plate_sheet.yaml", "--out", folder / "plate.pdf")
    pypdfium2.PdfDocument(folder / "plate.pdf")[0].render(scale=0.75, grayscale=True).to_pil().save(
        IMAGES / "sheet.png"
    )


def seen(campaign: Path, folder: Path) -> None:
    """What is read in an image of the station."""
    pipeline("targets", "--images", campaign / "station" / "left", "--out", folder / "seen")
    picture = cv2.imread(str(sorted((folder / "seen").glob("*.jpg"))[0]))
    width = 900
    small = cv2.resize(
        picture, (width, round(picture.shape[0] * width / picture.shape[1])), interpolation=cv2.INTER_AREA
    )
    cv2.imwrite(str(IMAGES / "tutorial_targets.jpg"), small, [cv2.IMWRITE_JPEG_QUALITY, 75])


def chapters(report: Path) -> None:
    """The verdict, the errors and the network as the report shows them."""
    with sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=CHROMIUM, args=DRAWING)
        tab = browser.new_page(viewport={"width": 1000, "height": 640}, color_scheme="light")
        tab.goto(report.resolve().as_uri())
        for _ in range(PATIENCE_S):  # no function to wait for: the report's policy forbids to evaluate one
            state = tab.evaluate("() => ({...document.documentElement.dataset})")
            if state.get("plots") == state.get("drawn"):
                break
            tab.wait_for_timeout(1000)
        tab.screenshot(path=IMAGES / "tutorial_verdict.png")
        tab.set_viewport_size({"width": 1000, "height": 1000})
        for name in ("verification", "network"):
            tab.locator(f"#{name}").screenshot(path=IMAGES / f"tutorial_{name}.png")
        browser.close()


def main() -> None:
    """Make all pictures."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0] if __doc__ else None)
    parser.add_argument("--demo", type=Path, help="folder of `pipeline demo`")
    chosen = parser.parse_args()
    with TemporaryDirectory() as place:
        demo = chosen.demo or Path(place) / "demo"
        if chosen.demo is None:
            pipeline("demo", "--out", demo)
        sheet(Path(place))
        seen(demo / "campaign", Path(place))
        chapters(demo / "run" / "report.html")


if __name__ == "__main__":
    main()
