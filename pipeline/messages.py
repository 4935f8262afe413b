"""What people see while a run works: progress and warnings on standard error, everything in the run's log.txt.

All of it goes through ``LOG``, the logger ``pipeline``: INFO is what is going on, WARNING what matters even when quiet,
DEBUG what belongs into the file alone.
"""

import logging
import os
import time
import warnings
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, TextIO, TypeVar

from robcal.files.storage import storage_error

if TYPE_CHECKING:
    from rich.console import Console
    from rich.progress import Progress, Task
    from rich.text import Text

T = TypeVar("T")

LOG = logging.getLogger("pipeline")
LOG.setLevel(logging.DEBUG)
LOG.addHandler(logging.NullHandler())
_TERMINAL = "terminal"
_BARS: list["Progress"] = []
BETWEEN_LINES = 10.0
"""Seconds from one line of progress to the next where there is no terminal."""


class _LogFile(logging.FileHandler):
    def handleError(self, record: logging.LogRecord) -> None:
        """A full disk is told, not passed over."""
        try:
            raise
        except OSError as error:
            raise storage_error(Path(self.baseFilename), error) from None


@contextmanager
def logged_to(path: Path) -> Iterator[None]:
    """Append every message to a file, with its time."""
    try:
        handler = _LogFile(path, encoding="utf-8", errors="backslashreplace")
    except OSError as error:
        raise storage_error(path, error) from None
    handler.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(message)s", "%Y-%m-%dT%H:%M:%S%z"))
    LOG.addHandler(handler)
    try:
        yield
    finally:
        LOG.removeHandler(handler)
        handler.close()


def show(quiet: bool) -> None:
    """Show messages on standard error; only warnings when quiet."""
    from rich.console import Console, ConsoleRenderable
    from rich.logging import RichHandler
    from rich.text import Text

    class Terminal(RichHandler):
        def render_message(self, record: logging.LogRecord, message: str) -> ConsoleRenderable:
            warning = record.levelno >= logging.WARNING
            return Text(f"warning: {message}", style="yellow") if warning else Text(message)

        def render(self, *, message_renderable: ConsoleRenderable, **_: object) -> ConsoleRenderable:
            return message_renderable  # without rich's columns, which fold lines

    for handler in [h for h in LOG.handlers if h.name == _TERMINAL]:
        LOG.removeHandler(handler)
    handler = Terminal(logging.WARNING if quiet else logging.INFO, Console(stderr=True, soft_wrap=True))
    handler.name = _TERMINAL
    LOG.addHandler(handler)


class Heard(logging.Handler):
    """Keeps the warnings that go to the terminal, for the answer to programs."""

    def __init__(self) -> None:
        super().__init__(logging.WARNING)
        self.sentences: list[str] = []

    def emit(self, record: logging.LogRecord) -> None:
        self.sentences.append(record.getMessage())


def keep_libraries_silent() -> None:
    """Warnings of libraries go into the log, not onto the terminal; what matters is an error or a note of our own."""
    os.environ.setdefault("OPENCV_LOG_LEVEL", "SILENT")  # read when OpenCV is loaded, also by workers

    def logged(
        message: Warning | str,
        category: type[Warning],
        filename: str,
        lineno: int,
        file: TextIO | None = None,
        line: str | None = None,
    ) -> None:
        LOG.debug("%s:%d: %s: %s", filename, lineno, category.__name__, message)

    warnings.showwarning = logged


def _terminal() -> "Console | None":
    """The terminal on which messages are shown; None without one."""
    from rich.logging import RichHandler

    shown = next((h for h in LOG.handlers if isinstance(h, RichHandler) and h.level <= logging.INFO), None)
    return shown.console if shown is not None and shown.console.is_terminal else None


@contextmanager
def working(label: str, expected: float | None) -> Iterator[None]:
    """A moving bar on a terminal while something works that cannot count; with the time left where it is known.

    ``expected`` : seconds that it took before, None if that is not known.
    """
    console = _terminal()
    if console is None:
        yield
        return
    from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

    class Left(TextColumn):
        def __init__(self) -> None:
            super().__init__("")

        def render(self, task: "Task") -> "Text":
            from rich.text import Text

            if expected is None or task.elapsed is None:
                return Text("")
            return Text(f"about {max(expected - task.elapsed, 0.0):.0f} s left")

    columns = (SpinnerColumn(), TextColumn("{task.description}"), BarColumn(30), TimeElapsedColumn(), Left())
    bar = Progress(*columns, console=console, transient=True)
    _BARS.append(bar)
    try:
        with bar:
            bar.add_task(label, total=None)
            yield
    finally:
        _BARS.remove(bar)


def track(items: Iterable[T], total: int, label: str) -> Iterator[T]:
    """Yield items while a progress bar with the time left moves on a terminal; without one, a line now and then."""
    console = _terminal()
    if console is None:
        yield from _logged(items, total, label)
        return
    from rich.progress import track as bar

    for outer in _BARS:
        outer.stop()  # one bar at a time; this one can count
    yield from bar(items, label, total, console=console, transient=True)


def _logged(items: Iterable[T], total: int, label: str) -> Iterator[T]:
    begin = last = time.monotonic()
    for k, item in enumerate(items):
        now = time.monotonic()
        if k and now - last > BETWEEN_LINES:
            last = now
            left = (now - begin) * (total - k) / k
            LOG.info("  %s: %d of %d, about %.0f s left", label, k, total, left)
        yield item
