"""The same campaigns through two versions of the program: do result.json and diagnosis.json agree?

    python -m benchmarks.same_results --old TREE [--tolerance 1e-9] [--recorded FOLDER] [--only demo points]

``--old`` is a working tree of the other version. The demonstration and five simulated campaigns of different kinds are
written once (to ``--cache``); ``--recorded`` adds every campaign folder below a folder. Both versions run all of them,
one after the other, each from its own tree. Numbers are compared relative to the larger of the two, seconds not at
all; sentences are counted apart, because words may change where numbers must not.
"""

import argparse
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from fixtures.campaigns import make_campaign
from fixtures.demo import render_demo
from fixtures.own_files import make_own

FILES = ("result.json", "diagnosis.json")
UNTIMED = ("timing", "seconds")
FLOOR = 1e-9
"""Numbers below this (mm, deg) are zero; p-values and variances have none."""
NO_FLOOR = ("p_value", "mm2", "deg2", "covariance")

CAMPAIGNS: Mapping[str, Callable[[Path], object]] = {
    "demo": lambda folder: render_demo(folder.parent),
    "frames": lambda folder: make_campaign(folder, seed=11, level="frames", effects=["joint_eccentricity"], snr=12.0),
    "points": lambda folder: make_campaign(folder, seed=12, level="points", effects=["backlash"], snr=12.0),
    "distances": lambda folder: make_campaign(
        folder, seed=13, level="distances", poses=200, verify=40, effects=["wire_stretch"], snr=12.0, model="table5.4"
    ),
    "sensor": lambda folder: make_campaign(folder, seed=14, level="sensor", poses=120, verify=30),
    "marks": lambda folder: make_own(folder, seed=15, robot="kr150", effects=["camera_moved"], snr=15.0),
}
"""Writers by name; each fills the folder that it is given."""


@dataclass(frozen=True)
class Agreement:
    """How two files agree: numbers compared, the first key that differs, the largest relative difference, sentences
    that differ, keys that only the new one has."""

    numbers: int
    first: str | None
    largest: float
    texts: int
    added: int


def leaves(value: Any, path: str = "") -> Iterator[tuple[str, Any]]:
    """Keys and plain values of nested data, in their order; what was measured in seconds is left out."""
    if isinstance(value, dict):
        for key, inner in value.items():
            if key not in UNTIMED:
                yield from leaves(inner, f"{path}.{key}" if path else str(key))
    elif isinstance(value, list):
        for k, inner in enumerate(value):
            yield from leaves(inner, f"{path}[{k}]")
    else:
        yield path, value


def relative_difference(a: float, b: float, key: str = "") -> float:
    """Of two numbers, against the larger one; numbers below ``FLOOR`` count as that, except where they may be tiny."""
    if a == b or (a != a and b != b):
        return 0.0
    if a != a or b != b:
        return float("inf")
    floor = 0.0 if any(word in key for word in NO_FLOOR) else FLOOR
    return abs(a - b) / max(abs(a), abs(b), floor)


def compare(old: Any, new: Any, tolerance: float) -> Agreement:
    """Two nested structures, number by number. A key that is gone, or another type, is an infinite difference."""
    mine, theirs = dict(leaves(new)), dict(leaves(old))
    first, largest, texts, numbers = None, 0.0, 0, 0
    for key, a in theirs.items():
        b = mine.get(key, compare)
        if isinstance(a, str) and isinstance(b, str):
            texts += a != b
            continue
        if _is_number(a) and _is_number(b):
            numbers += 1
            difference = relative_difference(float(a), float(b), key)
        else:
            difference = 0.0 if a is b or a == b else float("inf")
        largest = max(largest, difference)
        if difference > tolerance and first is None:
            first = key
    return Agreement(numbers, first, largest, texts, len(mine.keys() - theirs.keys()))


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool)


def run_tree(tree: Path, campaign: Path, run: Path) -> str | None:
    """``pipeline run`` with the code of a tree; its error, or None."""
    environment = {**os.environ, "PYTHONPATH": str(tree), "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    command = [sys.executable, "-m", "pipeline", "run", str(campaign), "--out", str(run), "-q"]
    done = subprocess.run(command, env=environment, cwd=tree, capture_output=True, text=True, check=False)
    return None if done.returncode == 0 else done.stderr.strip()[-200:] or f"exit code {done.returncode}"


def _load(run: Path, name: str) -> Any:
    return json.loads((run / name).read_text()) if (run / name).is_file() else None


def campaigns(cache: Path, recorded: Path | None) -> dict[str, Path]:
    """Folders by name; simulated ones are written where they are missing."""
    folders = {}
    for name, write in CAMPAIGNS.items():
        folder = cache / name / "campaign"
        if not (folder / "campaign.yaml").is_file():
            folder.parent.mkdir(parents=True, exist_ok=True)
            write(folder)
        folders[name] = folder
    for file in sorted(recorded.rglob("campaign*.yaml")) if recorded else ():
        folders["-".join(file.relative_to(recorded).with_suffix("").parts)] = file
    return folders


def main() -> int:
    """Command line; exit code 1 where anything differs."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--old", type=Path, required=True, help="working tree of the other version")
    parser.add_argument("--new", type=Path, default=Path.cwd(), help="this version's; default the current folder")
    parser.add_argument("--tolerance", type=float, default=1e-9)
    parser.add_argument("--recorded", type=Path, help="folder with more campaigns")
    parser.add_argument("--only", nargs="*", default=[], help="names of campaigns")
    parser.add_argument("--cache", type=Path, default=Path("build/same_results"))
    parser.add_argument("--keep-old", action="store_true", help="do not run the old version where its results lie")
    given = parser.parse_args()
    cache = given.cache.resolve()
    print(
        f"| {'campaign':24} | {'file':14} | numbers | largest difference | sentences | added | first key that differs |"
    )
    print(f"|{'-' * 26}|{'-' * 16}|---------|--------------------|-----------|-------|------------------------|")
    different = False
    for name, campaign in campaigns(cache, given.recorded and given.recorded.resolve()).items():
        if given.only and name not in given.only:
            continue
        errors = {}
        for version, tree in (("old", given.old.resolve()), ("new", given.new.resolve())):
            run = cache / "runs" / name / version
            if version == "old" and given.keep_old and (run / "report.html").is_file():
                continue
            shutil.rmtree(run, ignore_errors=True)
            errors[version] = run_tree(tree, campaign, run)
        for version, error in errors.items():
            if error:
                print(f"| {name:24} | {version} fails: {error}")
        for file in FILES:
            old, new = (_load(cache / "runs" / name / version, file) for version in ("old", "new"))
            if old is None and new is None:
                continue
            found = compare(old, new, given.tolerance)
            different |= found.first is not None
            print(
                f"| {name:24} | {file:14} | {found.numbers:7d} | {found.largest:18.1e} | {found.texts:9d} |"
                f" {found.added:5d} | {found.first or 'none'} |",
                flush=True,
            )
    return int(different)


if __name__ == "__main__":
    raise SystemExit(main())
