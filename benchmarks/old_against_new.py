"""How long the benchmarks take in this version against another one, in one run, turn by turn.

    python -m benchmarks.old_against_new --old TREE [--rounds 3] [--only bundle identification]

Each tree runs its own benchmarks (quick variants) from its own folder, old and new alternating, so that a machine that
slows down meanwhile slows both. Of every printed time the shortest over the rounds counts; the ratio is new to old.
"""

import argparse
import os
import re
import subprocess
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Timed:
    """A benchmark: its arguments, and a pattern of the lines with a time (groups ``name`` and ``time``)."""

    arguments: tuple[str, ...]
    line: str


BENCHMARKS: Mapping[str, Timed] = {
    "bundle": Timed(("--no-scipy",), r"^\| (?P<name>robcal, [^|]*?) *\| *(?P<time>[\d.]+) \|"),
    "identification": Timed(("time",), r"^\W*(?P<name>(?:build|frames|identify)[^|]*?)[ |]{2,}(?P<time>[\d.]+)\W*$"),
    "centroids": Timed(("--scenes", "1"), r"^(?P<name>[a-z1][a-z0-9, ]+?) +\d+ +\d+ +(?P<time>\d+\.\d\d)$"),
    "full_campaign": Timed(
        ("--survey-images", "14", "--poses", "20"), r"^(?P<name>[a-z]+) +(?P<time>\d+\.\d\d)(?: .*)?$"
    ),
}
"""Quick variants by module."""


def times(tree: Path, name: str, cache: Path) -> dict[str, float]:
    """Times that a tree's benchmark prints, by the words beside them.

    Raises
    ------
    SystemExit : the benchmark fails, or prints no time that the pattern finds.
    """
    timed = BENCHMARKS[name]
    environment = {**os.environ, "PYTHONPATH": str(tree), "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    shared = ("--cache", str(cache)) if name == "full_campaign" else ()
    command = [sys.executable, "-m", f"benchmarks.{name}", *timed.arguments, *shared]
    done = subprocess.run(command, env=environment, cwd=tree, capture_output=True, text=True, check=False)
    if done.returncode:
        raise SystemExit(f"{tree}: benchmarks.{name} fails: {done.stderr.strip()[-500:]}")
    found = {m["name"].strip(): float(m["time"]) for m in re.finditer(timed.line, done.stdout, re.MULTILINE)}
    if not found:
        raise SystemExit(f"{tree}: benchmarks.{name} prints no times:\n{done.stdout[-1000:]}")
    return found


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--old", type=Path, required=True, help="working tree of the other version")
    parser.add_argument("--new", type=Path, default=Path.cwd(), help="this version's; default the current folder")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--only", nargs="*", choices=list(BENCHMARKS), default=[])
    parser.add_argument("--cache", type=Path, default=Path("build/benchmarks"))
    given = parser.parse_args()
    trees = {"old": given.old.resolve(), "new": given.new.resolve()}
    print(
        f"| {'benchmark':14} | {'what':52} |   old |   new | ratio |\n|{'-' * 16}|{'-' * 54}|-------|-------|-------|"
    )
    for name in given.only or BENCHMARKS:
        best: dict[str, dict[str, float]] = {version: {} for version in trees}
        for _ in range(given.rounds):
            for version, tree in trees.items():
                for what, took in times(tree, name, given.cache.resolve()).items():
                    best[version][what] = min(took, best[version].get(what, took))
        for what, old in best["old"].items():
            new = best["new"].get(what, float("nan"))
            ratio = new / old if old else float("nan")
            print(f"| {name:14} | {what:52} | {old:5.2f} | {new:5.2f} | {ratio:5.2f} |", flush=True)


if __name__ == "__main__":
    main()
