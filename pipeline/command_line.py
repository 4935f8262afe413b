"""What all commands share: options, one line for errors on purpose, exit codes, the line for programs."""

import json
import tempfile
import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any, NoReturn

import typer

from pipeline.json_io import plain
from pipeline.messages import LOG, Heard, show
from robcal.errors import InvalidInput, RobcalError
from robcal.files.storage import in_plain_words

Quiet = Annotated[bool, typer.Option("-q", "--quiet", help="Only warnings and errors on standard error.")]
Json = Annotated[bool, typer.Option("--json", help="One result line for programs on standard output.")]
Workers = Annotated[int | None, typer.Option("--workers", min=1, max=1024, help="Processes for work on images.")]
RunFolder = Annotated[Path, typer.Argument(metavar="RUN", help="Run folder of a finished campaign.")]
InstrumentName = Annotated[
    str | None, typer.Option("--instrument", metavar="NAME", help="In the world and with the tool of this instrument.")
]
CampaignPath = Annotated[Path, typer.Argument(metavar="CAMPAIGN", help="Campaign folder, or its YAML file.")]

SHOWN = 20
"""Sentences of one error that a terminal shows."""
INTERRUPTED = 130
"""Exit code after Ctrl-C, as shells expect it."""


@contextmanager
def answers(command: str, as_json: bool, quiet: bool) -> Iterator[dict[str, Any]]:
    """Run a command's body; errors on purpose become one line and exit code 1, a mistake of the program too."""
    answer: dict[str, Any] = {}
    show(quiet)
    heard = Heard()
    LOG.addHandler(heard)
    try:
        yield answer
    except typer.Exit:
        raise
    except KeyboardInterrupt:
        _fail(
            command,
            as_json,
            "interrupted: the same command goes on where it was, finished stages are kept",
            code=INTERRUPTED,
        )
    except RobcalError as error:
        _fail(command, as_json, *_sentences(error))
    except OSError as error:
        where = f"{error.filename}: " if error.filename else ""
        _fail(command, as_json, f"{where}{in_plain_words(error)}")
    except MemoryError:
        _fail(command, as_json, "not enough memory: use smaller images or fewer at once")
    except Exception as error:
        with tempfile.NamedTemporaryFile(
            "w", prefix="robcal-", suffix=".log", delete=False, encoding="utf-8", errors="backslashreplace"
        ) as stream:
            stream.write(traceback.format_exc())
        _fail(command, as_json, f"internal error ({type(error).__name__}): the traceback is in {stream.name}")
    finally:
        LOG.removeHandler(heard)
    if as_json:
        answer.setdefault("warnings", heard.sentences)
        typer.echo(json.dumps(plain({"ok": True, "command": command, **answer})))


def _sentences(error: RobcalError) -> list[str]:
    """The error's text, and what else was found wrong with it."""
    first = " ".join(str(error).split())
    faults = [" ".join(fault.split()) for fault in error.faults] if isinstance(error, InvalidInput) else []
    return list(dict.fromkeys([first, *faults]))


def _fail(command: str, as_json: bool, *sentences: str, code: int = 1) -> None:
    # one line is the contract; only the refused lines of a program are wanted all at once
    shown = sentences[: SHOWN if command == "program" else 1]
    more = len(sentences) - len(shown)
    for number, sentence in enumerate(shown, 1):
        rest = f" (and {more} more: --json lists all)" if more and number == len(shown) else ""
        typer.echo(f"error: {sentence}{rest}", err=True)
    if as_json:
        several = {"errors": list(sentences)} if len(sentences) > 1 else {}
        typer.echo(json.dumps({"ok": False, "command": command, "error": sentences[0], **several}))
    raise typer.Exit(code)


def wrong_use(sentence: str) -> NoReturn:
    """Say what is wrong with the use of a command and end with exit code 2."""
    typer.echo(f"wrong use: {sentence}", err=True)
    raise typer.Exit(2)
