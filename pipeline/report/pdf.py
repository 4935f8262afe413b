"""The report as PDF, printed by the Chromium (or Chrome, Edge) of this machine."""

import os
import shutil
import subprocess
import tempfile
from pathlib import Path

from robcal.errors import RobcalError
from robcal.files.storage import storage_error

BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "microsoft-edge", "msedge")
PATIENCE_S = 600
_DRAWING_MS = 60_000
"""Time of the page, which passes at once while nothing is drawn."""


class NoPrinter(RobcalError):
    """No browser that prints, or it failed."""


def browser() -> str:
    """A browser that can print; the environment's CHROMIUM goes before those on the path.

    Raises
    ------
    NoPrinter : there is none.
    """
    found = os.environ.get("CHROMIUM") or next(filter(None, map(shutil.which, BROWSERS)), None)
    if found is None:
        raise NoPrinter(
            "a PDF needs Chromium, Chrome or Edge, and none is found: install one (apt-get install chromium) or name "
            "it in the environment (CHROMIUM=/path/to/it); or open report.html and print it"
        )
    return found


def print_report(report: Path, out: Path) -> Path:
    """Print an HTML report to PDF, A4 in portrait; returns its path.

    Raises
    ------
    NoPrinter : no browser, or it failed. StorageError : the folder cannot be written.
    """
    program = browser()
    try:
        with tempfile.TemporaryDirectory(dir=out.parent, prefix=".printing-") as scratch:
            made = Path(scratch) / "report.pdf"
            _print(program, report, made, scratch)
            made.replace(out)
    except OSError as error:
        raise storage_error(out, error) from None
    return out


def _print(program: str, report: Path, made: Path, scratch: str) -> None:
    root = ["--no-sandbox"] if getattr(os, "geteuid", lambda: 1)() == 0 else []
    command = [
        program,
        "--headless",
        *root,
        "--disable-dev-shm-usage",
        "--use-gl=angle",
        "--use-angle=swiftshader",
        "--enable-unsafe-swiftshader",
        f"--user-data-dir={scratch}/profile",
        "--no-pdf-header-footer",
        f"--virtual-time-budget={_DRAWING_MS}",
        f"--print-to-pdf={made}",
        f"{report.resolve().as_uri()}#print",
    ]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE_S, check=False)
    except subprocess.TimeoutExpired:
        raise NoPrinter(f"{program} did not print within {PATIENCE_S} s: open {report} and print it") from None
    except OSError as error:
        raise NoPrinter(f"{program} cannot be started: {error.strerror or error}") from None
    if not made.is_file():
        said = (done.stderr.strip().splitlines() or ["without a word"])[-1]
        raise NoPrinter(f"{program} did not print ({said[:200]}): open {report} and print it")
