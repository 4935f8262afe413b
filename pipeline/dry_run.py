"""What a run would do, without doing it: stages, their inputs, what is up to date, and about how long it takes."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pipeline.campaign import Campaign, all_sources
from pipeline.campaign_reader import read_campaign
from pipeline.runner import STAGE_NAMES, default_folder, keep_inputs_apart, processes, stage_key
from pipeline.runs import Run
from pipeline.stages.base import Context, Stage
from pipeline.stages.registry import STAGES

_ROUGH: dict[str, Callable[[int, int, int], float]] = {
    "detect": lambda images, poses, workers: 1.0 * images / workers,
    "survey": lambda images, poses, workers: 2.0 + 0.2 * images,
    "orient": lambda images, poses, workers: 2.0 + 0.3 * poses,
    "measure": lambda images, poses, workers: 1.0 + 0.02 * poses,
    "frames": lambda images, poses, workers: 1.0 + 0.02 * poses,
    "identify": lambda images, poses, workers: 2.0 + 0.1 * poses,
    "adjust": lambda images, poses, workers: 1.0 + 0.03 * poses,
    "diagnose": lambda images, poses, workers: 20.0 + 1.5 * poses,
    "verify": lambda images, poses, workers: 2.0 + 0.2 * poses,
    "report": lambda images, poses, workers: 3.0,
}
"""Seconds of a stage that has not run yet, from images, poses and processes: right to a factor of three or so."""


@dataclass(frozen=True)
class Planned:
    """A stage of a run to come.

    Attributes
    ----------
    why : '' where it is up to date. inputs : files of the campaign; seconds : about how long it takes.
    measured : the time is that of an earlier run of this stage in this folder.
    """

    stage: str
    why: str
    inputs: tuple[Path, ...]
    seconds: float
    measured: bool


def plan_run(
    path: Path, out: Path | None, until: str | None = None, start: str | None = None, workers: int | None = None
) -> tuple[Run, Campaign, list[Planned]]:
    """The stages that a run would go through; nothing is written.

    Raises
    ------
    InvalidInput : the campaign cannot be read.
    """
    campaign = read_campaign(path)
    run = Run(out or default_folder(campaign))
    keep_inputs_apart(campaign, run)
    run.load_hashes()
    context = Context(campaign, run, workers or processes())
    stages = [stage for stage in STAGES if stage.applies(campaign)]
    names = [stage.name for stage in stages]
    planned: list[Planned] = []
    for stage in stages:
        if until and STAGE_NAMES.index(stage.name) > STAGE_NAMES.index(until):
            break
        forced = start is not None and STAGE_NAMES.index(stage.name) >= STAGE_NAMES.index(start)
        before = [p.stage for p in planned if p.why and p.stage in stage.after]
        planned.append(_planned(stage, context, names, forced, before))
    return run, campaign, planned


def _planned(stage: Stage, context: Context, names: list[str], forced: bool, before: list[str]) -> Planned:
    campaign, run = context.campaign, context.run
    record = run.record(stage.name)
    if forced:
        why = "asked for with --from"
    elif record is None:
        why = "has not run"
    elif before:
        why = f"after {before[0]}, which runs again"
    elif not run.up_to_date(stage.name, stage_key(stage, context, names)):
        why = "an input, a setting or the program has changed"
    else:
        why = ""
    images = sum(len(source.images) for source in all_sources(campaign))
    poses = len(campaign.poses) if campaign.poses is not None else 0
    rough = _ROUGH[stage.name](images, poses, context.workers) if stage.name in _ROUGH else 2.0
    seconds = 0.0 if not why else record.seconds if record is not None else rough
    return Planned(stage.name, why, tuple(stage.inputs(campaign)), seconds, record is not None)


def plan_data(run: Run, campaign: Campaign, planned: list[Planned]) -> dict[str, Any]:
    """The plan as plain data."""
    home = campaign.path.parent
    return {
        "dry_run": True,
        "run": str(run.folder),
        "stages": [
            {
                "stage": p.stage,
                "runs": bool(p.why),
                "why": p.why or "up to date",
                "inputs": [str(path.relative_to(home) if path.is_relative_to(home) else path) for path in p.inputs],
                "seconds": round(p.seconds, 1),
            }
            for p in planned
        ],
        "seconds": round(sum(p.seconds for p in planned), 1),
    }


def plan_lines(data: dict[str, Any]) -> list[str]:
    """The plan for people, a line for each stage."""
    lines = []
    for stage in data["stages"]:
        names = stage["inputs"]
        files = ", ".join(names) if len(names) <= 3 else f"{names[0]} and {len(names) - 1} more files"
        message = f"{stage['why']}{f'; from {files}' if files else ''}; about {stage['seconds']:.0f} s"
        lines.append(f"{stage['stage']}: {message if stage['runs'] else 'up to date'}")
    return [*lines, f"into {data['run']}, about {data['seconds']:.0f} s in all; nothing was done"]
