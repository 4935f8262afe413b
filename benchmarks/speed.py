"""This version against an earlier one in one run: detection, the stages of a whole campaign, memory; same results?

    python -m benchmarks.speed --old TREE [--images 12] [--rounds 3] [--orientations 1] [--campaigns 1] [--poses 80]

The campaign of ``benchmarks.full_campaign`` is rendered once. Detection: each version is one process; image by image
they take turns, so that a machine that slows down meanwhile slows both; of every image the shortest processor time of
the rounds counts. Centres are compared in standard deviations of the old version. Campaign: both versions run it in
turn; of every stage the shortest time counts. The first run of compiled loops on a machine is timed apart.
"""

import argparse
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from benchmarks.full_campaign import rendered
from benchmarks.old_against_new import BENCHMARKS

Array = NDArray[np.float64]

_WORKER = """
import json, sys, time
import cv2
cv2.setNumThreads(1)
from pathlib import Path
from robcal.files.images import read_image
from robcal.imaging.detect import detect_targets
for line in sys.stdin:
    path = Path(line.strip())
    begin = time.process_time()
    image = read_image(path)
    read = time.process_time()
    found = detect_targets(image)
    end = time.process_time()
    columns = {name: getattr(found, name).tolist() for name in ("xy", "covariance", "code")}
    print(json.dumps({"read": read - begin, "detect": end - read, **columns}), flush=True)
"""


@dataclass
class Version:
    """A process of one version that detects the targets of images."""

    tree: Path
    environment: dict[str, str]

    def __post_init__(self) -> None:
        self.process = subprocess.Popen(
            [sys.executable, "-c", _WORKER],
            env={**self.environment, "PYTHONPATH": str(self.tree)},
            cwd=self.tree,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )

    def detect(self, path: Path) -> dict[str, Any]:
        """Seconds and targets of an image."""
        if self.process.stdin is None or self.process.stdout is None:
            raise SystemExit("no pipe to the process of a version")
        print(path, file=self.process.stdin, flush=True)
        line = self.process.stdout.readline()
        if not line:
            raise SystemExit(f"{self.tree}: detection fails on {path}")
        return dict(json.loads(line))

    def close(self) -> None:
        """End the process."""
        if self.process.stdin is not None:
            self.process.stdin.close()
        self.process.wait()


def moved(old: dict[str, Any], new: dict[str, Any]) -> tuple[Array, int, int]:
    """Distances of centres found by both in sigmas of the old, targets that only one has, codes that differ."""
    a, b = np.array(old["xy"]).reshape(-1, 2), np.array(new["xy"]).reshape(-1, 2)
    if len(a) == 0 or len(b) == 0:
        return np.zeros(0), len(a) + len(b), 0
    distance, row = cKDTree(b).query(a)
    both = distance < 1.0
    strangers = int((~both).sum() + (cKDTree(a).query(b)[0] >= 1.0).sum())
    covariance = np.array(old["covariance"])[both]
    d = a[both] - b[row[both]]
    size = np.sqrt(np.einsum("ni,nij,nj->n", d, np.linalg.inv(covariance), d))
    return size, strangers, int((np.array(old["code"])[both] != np.array(new["code"])[row[both]]).sum())


def detection_table(trees: dict[str, Path], images: Sequence[Path], rounds: int) -> None:
    """Prints processor seconds an image, their ratio, and how the results agree."""
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    with tempfile.TemporaryDirectory() as empty:
        first = Version(trees["new"], {**environment, "NUMBA_CACHE_DIR": empty})
        cold = first.detect(images[0])["detect"]
        first.close()
    versions = {name: Version(tree, environment) for name, tree in trees.items()}
    warm = {name: version.detect(images[0])["detect"] for name, version in versions.items()}
    seconds: dict[str, list[float]] = {f"{name} {part}": [] for name in trees for part in ("read", "detect")}
    sizes, alone, codes, count = [], 0, 0, 0
    for path in images:
        results = [{name: version.detect(path) for name, version in versions.items()} for _ in range(rounds)]
        for key, values in seconds.items():
            name, part = key.split()
            values.append(min(result[name][part] for result in results))
        size, strangers, differ = moved(results[0]["old"], results[0]["new"])
        sizes.append(size)
        alone, codes, count = alone + strangers, codes + differ, count + len(results[0]["old"]["xy"])
    for version in versions.values():
        version.close()
    print(f"| processor seconds an image ({len(images)} images) | old | new | old / new |\n|---|---|---|---|")
    for part in ("detect", "read"):
        old, new = np.mean(seconds[f"old {part}"]), np.mean(seconds[f"new {part}"])
        print(f"| {part} | {old:.3f} | {new:.3f} | {old / new:.2f} |")
    print(f"| first image of a process | {warm['old']:.2f} | {warm['new']:.2f} | |")
    print(f"| first image ever, loops compiled | | {cold:.2f} | |")
    all_sizes = np.concatenate(sizes)
    print(
        f"\n{count} targets: centres of both moved by {np.sqrt((all_sizes**2).mean()):.4f} sigma (RMS), "
        f"{np.quantile(all_sizes, 0.99):.3f} (99 %), {all_sizes.max():.3f} (most); {codes} codes differ; "
        f"{alone} places in one version only"
    )


_ORIENT = """
import sys, time
from pathlib import Path
from pipeline.campaign_reader import read_campaign
from pipeline.runs import Run
from pipeline.stages import orient
from pipeline.stages.base import Context
context = Context(read_campaign(Path(sys.argv[1])), Run(Path(sys.argv[2])), 1)
begin = time.process_time()
orient.work(context)
print(time.process_time() - begin)
"""


def orientation_table(trees: dict[str, Path], folder: Path, rounds: int) -> None:
    """Prints processor seconds of the stage that orients the station, on copies of a run of the new version."""
    if not (folder / "run").is_dir():
        raise SystemExit(f"{folder / 'run'}: run the campaign once first (--campaigns 1)")
    best: dict[str, float] = {}
    for _ in range(rounds):
        for name, tree in trees.items():
            with tempfile.TemporaryDirectory() as scratch:
                run = Path(shutil.copytree(folder / "run", Path(scratch) / "run"))
                environment = {**os.environ, "PYTHONPATH": str(tree), "OMP_NUM_THREADS": "1"}
                command = [sys.executable, "-c", _ORIENT, str((folder / "campaign").resolve()), str(run)]
                done = subprocess.run(
                    command,
                    env={**environment, "OPENBLAS_NUM_THREADS": "1"},
                    cwd=tree,
                    capture_output=True,
                    text=True,
                    check=False,
                )
            if done.returncode:
                raise SystemExit(f"{tree}: the orientation fails: {done.stderr.strip()[-500:]}")
            took = float(done.stdout.split()[-1])
            best[name] = min(took, best.get(name, took))
    print(
        f"\n| processor seconds | old | new | old / new |\n|---|---|---|---|\n"
        f"| orientation of the station | {best['old']:.2f} | {best['new']:.2f} | {best['old'] / best['new']:.2f} |"
    )


def campaign_table(trees: dict[str, Path], cache: Path, rounds: int, survey_images: int, poses: int) -> None:
    """Prints seconds by stage and peak memory of ``benchmarks.full_campaign`` in both versions."""
    pattern = BENCHMARKS["full_campaign"].line
    best: dict[str, dict[str, float]] = {name: {} for name in trees}
    for _ in range(rounds):
        for name, tree in trees.items():
            environment = {**os.environ, "PYTHONPATH": str(tree), "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
            arguments = ["--survey-images", str(survey_images), "--poses", str(poses), "--cache", str(cache.resolve())]
            command = [sys.executable, "-m", "benchmarks.full_campaign", *arguments]
            done = subprocess.run(command, env=environment, cwd=tree, capture_output=True, text=True, check=False)
            if done.returncode:
                raise SystemExit(f"{tree}: the campaign fails: {done.stderr.strip()[-500:]}")
            found = {m["name"].strip(): float(m["time"]) for m in re.finditer(pattern, done.stdout, re.MULTILINE)}
            if (memory := re.search(r"peak memory (\d+) MB", done.stdout)) is not None:
                found["peak memory, MB"] = float(memory[1])
            for what, number in found.items():
                best[name][what] = min(number, best[name].get(what, number))
    print(f"\n| seconds, {survey_images} + {2 * poses} images | old | new | old / new |\n|---|---|---|---|")
    for what, old in best["old"].items():
        new = best["new"].get(what, float("nan"))
        print(f"| {what} | {old:.2f} | {new:.2f} | {old / new:.2f} |")


def main() -> None:
    """Both tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--old", type=Path, required=True, help="working tree of the other version")
    parser.add_argument("--new", type=Path, default=Path.cwd(), help="this version's; default the current folder")
    parser.add_argument("--images", type=int, default=12, help="images whose targets are detected; 0: none")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--orientations", type=int, default=0, help="orientations of the station by each version")
    parser.add_argument("--campaigns", type=int, default=1, help="runs of the campaign by each version; 0: none")
    parser.add_argument("--survey-images", type=int, default=60)
    parser.add_argument("--poses", type=int, default=80)
    parser.add_argument("--cache", type=Path, default=Path("build/benchmarks"))
    given = parser.parse_args()
    trees = {"old": given.old.resolve(), "new": given.new.resolve()}
    verify = given.poses // 5
    size = {"survey_images": given.survey_images, "identify": given.poses - verify, "verify": verify}
    folder, _ = rendered(given.cache, **size, seed=1)
    every = sorted((folder / "campaign").resolve().rglob("*.png"))
    if given.images:
        detection_table(trees, every[:: max(1, len(every) // given.images)][: given.images], given.rounds)
    if given.orientations:
        orientation_table(trees, folder, given.orientations)
    if given.campaigns:
        campaign_table(trees, given.cache, given.campaigns, given.survey_images, given.poses)


if __name__ == "__main__":
    main()
