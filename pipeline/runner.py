"""Runs the stages of a campaign in order: skips what is up to date, resumes what was interrupted."""

import os
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pipeline.campaign import Campaign, all_sources
from pipeline.campaign_reader import read_campaign
from pipeline.codec import StaleCache
from pipeline.json_io import fingerprint, read_json, write_json
from pipeline.messages import LOG, logged_to, working
from pipeline.runs import RUN_FORMAT, Run, StageRecord, run_file
from pipeline.sources import code_version
from pipeline.stages.base import Context, Outcome, Stage
from pipeline.stages.identify import check_joint_limits
from pipeline.stages.registry import STAGES
from robcal.errors import InvalidInput, RobcalError
from robcal.files.schemas import proposal
from robcal.files.storage import storage_error

STAGE_NAMES = tuple(stage.name for stage in STAGES)


class InternalError(RobcalError):
    """A mistake of this program; the traceback is in log.txt."""


@dataclass(frozen=True)
class Done:
    """What a run did."""

    run: Run
    ran: tuple[str, ...]
    skipped: tuple[str, ...]
    result: dict[str, Any]


def default_folder(campaign: Campaign) -> Path:
    """``runs/<campaign name>`` beside the campaign; in the current folder where a run of it is, or nothing else can be.

    A campaign in the current folder itself has its runs there as well.
    """
    here = Path("runs") / campaign.name
    beside = campaign.path.absolute().parent.parent
    if run_file(Run(here)).is_file() or beside == Path.cwd() or not os.access(beside, os.W_OK):
        return here
    return beside / here


def processes() -> int:
    """Processors that this process may use."""
    affinity = getattr(os, "sched_getaffinity", None)
    return len(affinity(0)) if affinity else os.cpu_count() or 1


def run_campaign(
    path: Path,
    out: Path | None = None,
    *,
    until: str | None = None,
    start: str | None = None,
    only: Sequence[str] | None = None,
    workers: int | None = None,
    body: str | None = None,
) -> Done:
    """Run a campaign.

    Parameters
    ----------
    until : last stage to run; start : first stage that runs even if it is up to date.
    only : restrict the run to these stages; body : survey this body alone.

    Raises
    ------
    InvalidInput : the campaign or a stage's name is wrong; any other RobcalError of a stage, told with its file.
    InternalError : a mistake of this program.
    """
    for name in (until, start):
        if name is not None and name not in STAGE_NAMES:
            raise InvalidInput(f"there is no stage '{name}'{proposal(name, list(STAGE_NAMES))}")
    if until and start and STAGE_NAMES.index(until) < STAGE_NAMES.index(start):
        raise InvalidInput(f"stage '{until}' comes before '{start}': --until must not lie before --from")
    campaign = read_campaign(path)
    run = Run(out or default_folder(campaign))
    keep_inputs_apart(campaign, run)
    with run.lock(), logged_to(run.log):
        LOG.debug("run of %s in %s", campaign.path, run.folder)
        check_joint_limits(campaign, run)
        moved = _adopt(run, campaign)
        if moved is not None:
            LOG.info(moved)
        run.load_hashes()
        context = Context(campaign, run, workers or processes(), body)
        for note in campaign.notes:
            LOG.info(note)
        for warning in campaign.warnings:
            LOG.warning(warning)
        try:
            return _run_stages(context, until, start, only)
        finally:
            run.save_hashes()


def keep_inputs_apart(campaign: Campaign, run: Run) -> None:
    """Refuse a run folder that holds recordings, or files that are none of a run.

    Raises
    ------
    InvalidInput : it does.
    """
    out = run.folder.resolve()
    if out == campaign.path.parent.resolve():
        raise InvalidInput(f"{run.folder}: is the campaign itself, which is never written to: choose another --out")
    images = [path for source in all_sources(campaign) for path in source.images.values()]
    recorded = {path.parent.resolve() for path in (*campaign.files, *images)}
    if out in recorded:
        raise InvalidInput(f"{run.folder}: holds recordings of the campaign: choose another --out")
    others = [path.name for path in run.contract_files() if path.exists()]
    if others and not run_file(run).is_file():
        raise InvalidInput(
            f"{run.folder}: is no run folder but holds {others[0]}, which would be overwritten: choose another --out"
        )


def _adopt(run: Run, campaign: Campaign) -> str | None:
    """Take the run folder for this campaign; a sentence where it was that of the same campaign in another place.

    Raises
    ------
    InvalidInput : the folder holds the run of another campaign.
    """
    path = run_file(run)
    here = str(campaign.path.resolve())
    try:
        known = read_json(path) if path.is_file() else {}
    except InvalidInput:
        known = {}  # damaged: written anew, and every stage's record is checked by itself
    moved = None
    if known and known.get("campaign") != here:
        before, there = known.get("name"), str(known.get("campaign"))
        if before != campaign.name or Path(there).exists():
            raise InvalidInput(
                f"{run.folder}: holds the run of another campaign ('{before}', {there}): choose another folder with "
                "--out"
            )
        moved = f"the campaign was at {there} when this run was begun; what has not changed is not run again"
    write_json(path, {"format": RUN_FORMAT, "campaign": here, "name": campaign.name})
    return moved


def _run_stages(context: Context, until: str | None, start: str | None, only: Sequence[str] | None) -> Done:
    campaign, run = context.campaign, context.run
    stages = [stage for stage in STAGES if stage.applies(campaign)]
    names = [stage.name for stage in stages]
    for name in STAGE_NAMES:
        if name not in names:
            run.forget(name)  # what an earlier campaign.yaml asked for does not hold any more
    ran: list[str] = []
    skipped: list[str] = []
    for stage in stages:
        if until and STAGE_NAMES.index(stage.name) > STAGE_NAMES.index(until):
            break
        if only is not None and stage.name not in only:
            continue
        missing = [name for name in stage.after if name in names and run.record(name) is None]
        if missing:
            raise InvalidInput(f"stage '{stage.name}' needs the stage '{missing[0]}': run the whole campaign first")
        forced = start is not None and STAGE_NAMES.index(stage.name) >= STAGE_NAMES.index(start)
        key = stage_key(stage, context, names)
        if not forced and run.up_to_date(stage.name, key):
            skipped.append(stage.name)
            LOG.info("%s: up to date", stage.name)
            continue
        before = run.record(stage.name)
        run.forget(stage.name)
        _run_stage(stage, key, context)
        run.remove_stale(before, run.record(stage.name))
        ran.append(stage.name)
        run.write_result(collect_result(run, campaign, names))
    result = collect_result(run, campaign, names)
    run.write_result(result)
    return Done(run, tuple(ran), tuple(skipped), result)


def _run_stage(stage: Stage, key: str, context: Context) -> None:
    LOG.info("%s: ...", stage.name)
    begin = time.perf_counter()
    try:
        before = context.run.record(stage.name)
        with working(stage.name, before.seconds if before is not None else None):
            outcome = stage.work(context)
    except StaleCache as error:
        raise InvalidInput(f"{error}") from None
    except RobcalError as error:
        LOG.debug("stage %s failed: %s", stage.name, error)
        raise
    except OSError as error:
        LOG.debug("stage %s failed", stage.name, exc_info=True)
        raise storage_error(Path(error.filename or context.run.folder), error) from None
    except MemoryError:
        raise InvalidInput(f"stage {stage.name}: not enough memory: use smaller images or fewer at once") from None
    except Exception as error:
        LOG.debug("stage %s failed", stage.name, exc_info=True)
        raise InternalError(
            f"stage {stage.name}: internal error ({type(error).__name__}): the traceback is in {context.run.log}"
        ) from error
    seconds = time.perf_counter() - begin
    finish(context.run, stage.name, key, outcome, seconds)
    for note in outcome.notes:
        LOG.info("  %s", note)
    LOG.info("%s: done in %.1f s", stage.name, seconds)


def finish(run: Run, stage: str, key: str, outcome: Outcome, seconds: float) -> None:
    """Write the record of a finished stage."""
    outputs = run.outputs(list(outcome.outputs))
    run.write_record(StageRecord(stage, key, outputs, dict(outcome.result), tuple(outcome.notes), seconds))


def stage_key(stage: Stage, context: Context, applying: Sequence[str]) -> str:
    """Hash of everything that the result of a stage depends on."""
    run, campaign = context.run, context.campaign
    home = campaign.path.parent.absolute()
    files = {_name_within(path, home): run.hash(path) for path in stage.inputs(campaign)}
    upstream = {}
    for name in stage.after:
        record = run.record(name) if name in applying else None
        upstream[name] = dict(record.outputs) if record else None
    # the index of images holds their places; everything else is the same wherever the campaign lies
    alone = context.body if stage.name == "survey" else str(home) if stage.name == "detect" else None
    return fingerprint(stage.name, files, stage.settings(campaign), upstream, code_version(stage.module), alone)


def _name_within(path: Path, home: Path) -> str:
    """A file's place seen from the campaign; on another drive its full place."""
    try:
        return Path(os.path.relpath(path.absolute(), home)).as_posix()
    except ValueError:
        return str(path.absolute())


def collect_result(run: Run, campaign: Campaign, names: Sequence[str]) -> dict[str, Any]:
    """result.json from the records of all finished stages."""
    result: dict[str, Any] = {"format": "robcal/result-1", "campaign": campaign.name}
    timing: dict[str, float] = {}
    notes: list[str] = [*campaign.notes, *campaign.warnings]
    for name in STAGE_NAMES:
        record = run.record(name) if name in names else None
        if record is None:
            continue
        result.update(record.result)
        timing[name] = round(record.seconds, 3)
        notes.extend(record.notes)
    result["timing"] = timing
    result["notes"] = notes
    return result
