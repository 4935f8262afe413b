"""What people see while a run works: progress and warnings on standard error, everything in the run's log.txt.

All of it goes through ``LOG``, the logger ``pipeline``: INFO is what is going on, WARNING what matters even when quiet,
DEBUG what belongs into the file alone.
"""

import logging
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TypeVar

from robcal.files.storage import storage_error

T = TypeVar("T")

LOG = logging.getLogger("pipeline")
LOG.setLevel(logging.DEBUG)
LOG.addHandler(logging.NullHandler())
_TERMINAL = "terminal"


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


def track(items: Iterable[T], total: int, label: str) -> Iterator[T]:
    """Yield items while a progress bar moves, where messages are shown on a terminal."""
    from rich.logging import RichHandler
    from rich.progress import track as bar

    shown = next((h for h in LOG.handlers if isinstance(h, RichHandler) and h.level <= logging.INFO), None)
    if shown is None or not shown.console.is_terminal:
        return iter(items)
    return iter(bar(items, label, total, console=shown.console, transient=True))
