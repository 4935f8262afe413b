"""What people see while a run works: progress and warnings on standard error, everything in log.txt."""

from __future__ import annotations

import datetime
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TypeVar

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from pipeline.files import storage_error

T = TypeVar("T")


class Messages:
    """Sink of messages.

    Parameters
    ----------
    quiet : only warnings and errors on the terminal.
    log : file that gets every line with its time; None for no file.
    """

    def __init__(self, quiet: bool = False, log: Path | None = None) -> None:
        self.quiet = quiet
        self.log = log
        self.console = Console(stderr=True, highlight=False, soft_wrap=True)

    def info(self, text: str) -> None:
        """A line about what is going on."""
        self.record(text)
        if not self.quiet:
            self.console.print(text, markup=False)

    def warn(self, text: str) -> None:
        """A line that matters even when quiet."""
        self.record(f"warning: {text}")
        self.console.print(f"warning: {text}", style="yellow", markup=False)

    def record(self, text: str) -> None:
        """A line for log.txt alone."""
        if self.log is None:
            return
        stamp = datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")
        try:
            with self.log.open("a", encoding="utf-8", errors="backslashreplace") as stream:
                stream.write("".join(f"{stamp} {line}\n" for line in text.splitlines() or [""]))
        except OSError as error:
            raise storage_error(self.log, error) from None

    def track(self, items: Iterable[T], total: int, label: str) -> Iterator[T]:
        """Yield items while a progress bar moves (on a terminal, unless quiet)."""
        if self.quiet or not self.console.is_terminal:
            yield from items
            return
        columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
        with Progress(*columns, console=self.console, transient=True) as progress:
            task = progress.add_task(label, total=total)
            for item in items:
                yield item
                progress.advance(task)
