"""Command batch: all campaigns of a folder, on the cores of this machine or on a Dask cluster.

Every campaign is a task of its own in a process of one thread, so that the numbers do not depend on how many there are.
A worker that dies takes nothing with it: its campaigns are given to another one, which resumes their runs.
"""

import logging
import multiprocessing
import os
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pipeline.json_io import fingerprint, read_json, write_json
from pipeline.messages import LOG
from pipeline.parallel import THREAD_VARIABLES, begin_worker
from pipeline.runner import processes, run_campaign
from robcal.errors import InvalidInput, RobcalError

FORMAT = "robcal/batch-1"
TRIES = 4
"""So often a campaign is begun whose worker died; then it is the campaign that kills them."""
TIMES = ("timing", "seconds")
"""Keys of a result that hold times."""
_ONE_AT_A_TIME = threading.Lock()


@dataclass(frozen=True)
class Task:
    """A campaign and the folder of its run, as text that any worker can read."""

    name: str
    campaign: str
    run: str


def campaigns_in(folder: Path, out: Path) -> list[Task]:
    """All campaigns below a folder, in the order of their names.

    Raises
    ------
    InvalidInput : there are none, or the runs would lie among them.
    """
    if not folder.is_dir():
        raise InvalidInput(f"{folder}: is no folder: name the one that holds the campaigns")
    files = sorted(folder.rglob("campaign.yaml"))
    inside = out.resolve()
    found = [file.parent for file in files if not file.resolve().is_relative_to(inside)]
    if not found:
        raise InvalidInput(f"{folder}: holds no campaign: a campaign is a folder with a campaign.yaml")
    if any(inside.is_relative_to(campaign.resolve()) for campaign in found):
        raise InvalidInput(f"{out}: lies within a campaign, which is never written to: choose another --out")
    names = [campaign.relative_to(folder).as_posix() for campaign in found]
    names = [campaign.name if name == "." else name for name, campaign in zip(names, found, strict=True)]
    return [
        Task(name, str(campaign.resolve()), str((out / name).resolve()))
        for name, campaign in zip(names, found, strict=True)
    ]


def run_one(task: Task) -> dict[str, Any]:
    """Run one campaign in this process; an error of the data is part of the answer."""
    answer: dict[str, Any] = {"name": task.name, "run": task.run, "error": None, "result_sha256": None}
    with _ONE_AT_A_TIME:  # a worker of several threads: the log of a run belongs to its process
        logging.getLogger("pipeline").propagate = False
        try:
            run_campaign(Path(task.campaign), Path(task.run), workers=1)
            answer["result_sha256"] = result_hash(Path(task.run))
        except RobcalError as error:
            answer["error"] = " ".join(str(error).split())
    return answer


def result_hash(run: Path) -> str:
    """Hash of a run's result.json without the times that it took."""
    return fingerprint(without_times(read_json(run / "result.json")))


def without_times(value: Any) -> Any:
    """Plain data without the entries that hold times."""
    if isinstance(value, dict):
        return {k: without_times(v) for k, v in value.items() if k not in TIMES}
    return [without_times(v) for v in value] if isinstance(value, list) else value


def run_batch(folder: Path, out: Path, *, workers: int | None = None, cluster: str | None = None) -> dict[str, Any]:
    """Run all campaigns below a folder; writes ``batch.json`` among the runs.

    Parameters
    ----------
    workers : processes on this machine.
    cluster : address of a Dask scheduler instead; its workers see the same folders.

    Raises
    ------
    InvalidInput : no campaigns, no cluster, or a campaign that failed (all others are done nevertheless).
    """
    tasks = campaigns_in(folder, out)
    begin = time.perf_counter()
    found = _on_cluster(tasks, cluster) if cluster else _on_cores(tasks, workers or processes())
    answers: dict[str, dict[str, Any]] = {}
    for answer in found:
        answers[answer["name"]] = answer
        state = answer["error"] or "done"
        LOG.info("%d of %d: %s: %s", len(answers), len(tasks), answer["name"], state)
    entries = {task.name: {k: v for k, v in answers[task.name].items() if k != "name"} for task in tasks}
    for entry in entries.values():
        entry["run"] = os.path.relpath(entry["run"], out.resolve())
    write_json(out / "batch.json", {"format": FORMAT, "campaigns": entries})
    failed = [name for name, entry in entries.items() if entry["error"]]
    if failed:
        raise InvalidInput(
            f"{len(failed)} of {len(tasks)} campaigns gave no result, the others are done (see {out / 'batch.json'}): "
            f"{failed[0]}: {entries[failed[0]]['error']}"
        )
    return {"campaigns": len(tasks), "runs": str(out), "seconds": round(time.perf_counter() - begin, 1)}


def _on_cores(tasks: Sequence[Task], workers: int) -> Iterator[dict[str, Any]]:
    """Answers as they come; what a dead worker had is begun again."""
    if workers <= 1 or len(tasks) == 1:
        yield from map(run_one, tasks)
        return
    before = {name: os.environ.get(name) for name in THREAD_VARIABLES}
    os.environ.update(dict.fromkeys(THREAD_VARIABLES, "1"))  # read when a worker loads numpy
    left = {task.name: task for task in tasks}
    try:
        for _ in range(TRIES):
            for answer in _in_pool(list(left.values()), min(workers, len(left))):
                del left[answer["name"]]
                yield answer
            if not left:
                return
            LOG.warning("a worker died; %d campaigns are begun again and resume where they stood", len(left))
        for task in left.values():
            yield _lost(task)
    finally:
        for name, value in before.items():
            os.environ.pop(name) if value is None else os.environ.__setitem__(name, value)


def _in_pool(tasks: Sequence[Task], workers: int) -> Iterator[dict[str, Any]]:
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(workers, context, initializer=begin_worker, initargs=(os.getpid(),)) as pool:
        for future in as_completed([pool.submit(run_one, task) for task in tasks]):
            try:
                yield future.result()
            except BrokenProcessPool:
                continue


def _lost(task: Task) -> dict[str, Any]:
    reason = f"its worker died {TRIES} times, probably for lack of memory: use fewer --workers"
    return {"name": task.name, "run": task.run, "error": reason, "result_sha256": None}


def _on_cluster(tasks: Sequence[Task], address: str) -> Iterator[dict[str, Any]]:
    """Answers of a Dask cluster; its scheduler gives the campaigns of a lost worker to another one."""
    try:
        from distributed import Client, KilledWorker
        from distributed import as_completed as completed
    except ImportError:
        raise InvalidInput("--cluster needs the package distributed: pip install 'robcal[cluster]'") from None
    try:
        client = Client(address, timeout=10, set_as_default=False)
    except (OSError, ValueError, TimeoutError) as error:
        raise InvalidInput(
            f"{address}: no Dask scheduler answers there ({error}): start one, or use --workers"
        ) from None
    with client:
        submit: Callable[..., Any] = client.submit
        futures = {
            submit(run_one, task, key=f"robcal-{k}-{task.run}", pure=False): task for k, task in enumerate(tasks)
        }
        for future in completed(list(futures), loop=client.loop):
            try:
                yield future.result()
            except KilledWorker:
                yield _lost(futures[future])
