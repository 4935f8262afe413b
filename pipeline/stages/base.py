"""What a stage is, and what it gets to work with."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pipeline.campaign import Campaign
from pipeline.runs import Run


@dataclass(frozen=True)
class Context:
    """One run at work.

    Attributes
    ----------
    workers : processes for work on images; 1 works in this process.
    body : the only body to survey, None for all.
    """

    campaign: Campaign
    run: Run
    workers: int = 1
    body: str | None = None


@dataclass(frozen=True)
class Outcome:
    """What a stage leaves behind: its part of result.json, its files, sentences about what it left out or assumed."""

    result: Mapping[str, Any] = field(default_factory=dict)
    outputs: Sequence[Path] = ()
    notes: Sequence[str] = ()


@dataclass(frozen=True)
class Stage:
    """A stage of the chain.

    Attributes
    ----------
    applies : whether the campaign has input for it.
    inputs : files of the campaign it reads; settings : entries of campaign.yaml (and else) it depends on.
    after : stages whose outputs it reads.
    module : the module that defines it; a change in what that can reach makes its results out of date.
    """

    name: str
    applies: Callable[[Campaign], bool]
    work: Callable[[Context], Outcome]
    inputs: Callable[[Campaign], Sequence[Path]]
    settings: Callable[[Campaign], Any]
    after: tuple[str, ...]
    module: str


def no_files(campaign: Campaign) -> Sequence[Path]:
    """Inputs of a stage that reads no file of the campaign itself."""
    return ()
