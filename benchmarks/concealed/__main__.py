"""Run a battery of concealed campaigns through the tool, score it, print the tables.

    python -m benchmarks.concealed nulls --count 100 --out nulls.jsonl
    python -m benchmarks.concealed singles --count 2 --causes backlash gear_ripple
    python -m benchmarks.concealed table nulls.jsonl singles.jsonl

Records are appended to --out one by one; what it holds already is not run again.
"""

import argparse
import json
import os
import sys
import tempfile
import time
import traceback
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):  # before numpy is loaded: a run uses one core
    os.environ.setdefault(_name, "1")

from benchmarks.concealed.adapter import ADAPTERS, Answer  # noqa: E402
from benchmarks.concealed.image_runs import Imaged, image_runs, run_imaged  # noqa: E402
from benchmarks.concealed.own_runs import Own, own_runs, run_own  # noqa: E402
from benchmarks.concealed.scenarios import BATTERIES, Scenario  # noqa: E402
from benchmarks.concealed.scoring import score  # noqa: E402
from benchmarks.concealed.sighting_runs import Sighting, run_sighting, sightings  # noqa: E402
from benchmarks.concealed.tables import report  # noqa: E402
from fixtures.campaigns import write_campaign, write_poses  # noqa: E402
from fixtures.plan import Truth  # noqa: E402
from fixtures.recordings import driven_further, record  # noqa: E402

LEVELS = ("points", "frames", "distances", "sensor", "survey", "station", "own", "images")
"""Levels of measurement; surveys, stations and robots with an own station (``own``: marks, ``images``: rendered images)
have nulls and singles only."""


Run = Scenario | Sighting | Own | Imaged


def run_one(scenario: Run, adapter: str) -> dict[str, Any]:
    """Make, run and score one campaign; a failure of the tool is a record with ``error``."""
    if isinstance(scenario, Sighting):
        return run_sighting(scenario)
    if isinstance(scenario, Own):
        return run_own(scenario)
    if isinstance(scenario, Imaged):
        return run_imaged(scenario)
    head = {"key": scenario.key, "battery": scenario.battery, "label": scenario.label, "level": scenario.level}
    head |= {"snr": scenario.snr, "seed": scenario.seed}
    plan = scenario.build()
    if plan is None:
        return {**head, "skipped": "the effect does not show in this campaign"}
    recording, truth = record(plan)
    with tempfile.TemporaryDirectory(prefix="concealed-") as folder:
        root = Path(folder)
        campaign = write_campaign(recording, root / "campaign")
        tables = {}
        if truth.effects and truth.plan.level != "distances":
            for name, kept in (("inside", truth.inside), ("outside", truth.outside)):
                tables[name] = root / f"{name}.csv"
                write_poses(kept.poses, truth, tables[name])
        try:
            answer = ADAPTERS[adapter](campaign, tables)
            result = {**head, **score(scenario, recording, truth, answer)}
            if scenario.follow and answer.diagnosis.get("next_poses"):
                result |= _followed(truth, answer, adapter, root)
            return result
        except Exception as error:
            return {
                **head,
                "error": f"{type(error).__name__}: {error}",
                "traceback": traceback.format_exc()[-1500:],
                "truth": [e.as_dict() for e in truth.effects],
            }


def _followed(truth: Truth, answer: Answer, adapter: str, root: Path) -> dict[str, Any]:
    """Drive the poses that the tool proposes, ask again: is the first name the true one now?"""
    recording, _ = record(truth.plan, driven_further(truth, answer.diagnosis["next_poses"]))
    second = ADAPTERS[adapter](write_campaign(recording, root / "again" / "campaign"), {})
    first = second.causes[0] if second.causes else {"cause": None, "where": None}
    effect = truth.effects[0]
    right = first["cause"] == effect.cause and first["where"] == effect.where
    return {"followed_right": right, "followed": [c["cause"] for c in second.causes]}


def _read(path: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines() if line.strip()]


def _wanted(arguments: argparse.Namespace, done: set[str]) -> Iterator[Run]:
    scenarios: Iterator[Run]
    if arguments.level in ("survey", "station"):
        scenarios = sightings(arguments.battery, arguments.count, arguments.seed, arguments.level)
    elif arguments.level == "own":
        scenarios = own_runs(arguments.battery, arguments.count, arguments.seed)
    elif arguments.level == "images":
        scenarios = image_runs(arguments.battery, arguments.count, arguments.seed)
    else:
        scenarios = BATTERIES[arguments.battery](arguments.count, arguments.seed, arguments.level)
    for scenario in scenarios:
        chosen = not arguments.causes or scenario.label in arguments.causes
        snr = not arguments.snr or scenario.snr in arguments.snr
        if chosen and snr and scenario.key not in done:
            yield scenario


def _run(arguments: argparse.Namespace) -> list[dict[str, Any]]:
    records = _read(arguments.out) if arguments.out and arguments.out.exists() else []
    done = {r["key"] for r in records if "error" not in r}
    records = [r for r in records if "error" not in r]
    stream = arguments.out.open("a", encoding="utf-8") if arguments.out else None
    start = time.perf_counter()
    try:
        with ProcessPoolExecutor(arguments.jobs) as pool:
            wanted = _wanted(arguments, done)
            pending = []
            for scenario in wanted:
                pending.append(pool.submit(run_one, scenario, arguments.adapter))
            for number, future in enumerate(pending, 1):
                result = future.result()
                records.append(result)
                if stream:
                    stream.write(json.dumps(result) + "\n")
                    stream.flush()
                if not arguments.quiet:
                    print(
                        f"{number}/{len(pending)} {time.perf_counter() - start:.0f} s {_line(result)}", file=sys.stderr
                    )
    finally:
        if stream:
            stream.close()
    return records


def _line(result: dict[str, Any]) -> str:
    if "skipped" in result:
        return f"{result['key']}: {result['skipped']}"
    if "error" in result:
        return f"{result['key']}: {result['error'][:150]}"
    told = ", ".join(f"{c['cause']}@{c['where']}{c['direction'] or ''}" for c in result["answer"]) or "nothing"
    true = ", ".join(f"{e['cause']}@{e['where']}{e['direction'] or ''}" for e in result["truth"]) or "nothing"
    mark = {True: "right", False: "WRONG", None: ""}[result.get("name_right", result.get("exact"))]
    what = f"{result['label']} SNR {result['snr']} ({result['robot']})"
    return f"{what}: {true} -> {told} {mark} [{result['seconds']:.1f} s]"


def main() -> int:
    """Command line."""
    parser = argparse.ArgumentParser(prog="benchmarks.concealed", description=(__doc__ or "").split("\n", 1)[0])
    parser.add_argument("battery", choices=[*BATTERIES, "table"])
    parser.add_argument("records", nargs="*", type=Path, help="with 'table': stored records")
    parser.add_argument("--count", type=int, default=1, help="repetitions of the battery")
    parser.add_argument("--seed", type=int, default=10_000)
    parser.add_argument("--level", default="points", choices=LEVELS)
    parser.add_argument("--causes", nargs="*", default=[], help="only scenarios with these labels")
    parser.add_argument("--snr", nargs="*", type=float, default=[], help="only these classes of SNR")
    parser.add_argument("--adapter", choices=sorted(ADAPTERS), default="library")
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--out", type=Path, help="file of records (JSON lines), appended to and resumed from")
    parser.add_argument("-q", "--quiet", action="store_true")
    arguments = parser.parse_args()
    if arguments.level in LEVELS[4:] and arguments.battery not in ("nulls", "singles", "table"):
        parser.error(f"the level {arguments.level} has the batteries nulls and singles only")
    if arguments.battery == "table":
        records = [r for path in arguments.records for r in _read(path)]
    else:
        records = _run(arguments)
    print(report(records))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
