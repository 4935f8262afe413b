"""What a check found, for people and for programs."""

import re
from typing import Any

from pipeline.checking.check import Checked

_PLACE = re.compile(r"(?P<file>.+?)(?:, (?P<kind>row|line) (?P<number>\d+))?: (?P<text>.*)", re.DOTALL)


def as_lines(found: Checked, quiet: bool = False) -> list[str]:
    """A line each; the last one counts. ``quiet``: faults and warnings alone."""
    lines = [f"error: {text}" for text in found.faults] + [f"warning: {text}" for text in found.warnings]
    if quiet:
        return lines
    lines += [f"note: {text}" for text in found.notes]
    outcome = "a run would stop" if found.faults else "ready to run"
    return [*lines, f"{_count(found.faults, 'error')}, {_count(found.warnings, 'warning')}: {outcome}"]


def as_data(found: Checked) -> dict[str, Any]:
    """The same as plain data; each sentence with its file, and its row or line, where it names them."""
    return {
        "campaign": found.campaign.name if found.campaign is not None else None,
        "faults": [_entry(text) for text in found.faults],
        "warnings": [_entry(text) for text in found.warnings],
        "notes": list(found.notes),
    }


def _entry(text: str) -> dict[str, Any]:
    place = _PLACE.fullmatch(text)
    if place is None or " " in place["file"].rpartition("/")[2].split(".")[-1]:
        return {"text": text}
    entry: dict[str, Any] = {"text": text, "file": place["file"]}
    if place["kind"]:
        entry[place["kind"]] = int(place["number"])
    return entry


def _count(items: tuple[str, ...], what: str) -> str:
    return f"{len(items)} {what}{'' if len(items) == 1 else 's'}"
