"""Time, memory and accuracy of a whole campaign: 60 survey images and 160 station images of 5 megapixels.

Run: ``python -m benchmarks.full_campaign [--survey-images 60] [--poses 80] [--seed 1]``. Renders the campaign once
(kept in ``--cache``), runs ``pipeline run`` on it in a process of its own and prints seconds by stage, the peak of the
memory of all its processes together (proportional set size, Linux), the verification on kept-out poses and, from truth,
where ``pipeline predict`` is wrong at poses nobody has measured. Goals: 100 s, 2 GB, 20 times better than nominal.
"""

import argparse
import csv
import json
import shutil
import subprocess
import sys
import threading
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from fixtures.campaign_writer import write_image_campaign
from fixtures.image_campaign import full_campaign
from fixtures.rigid import best_frame, move
from fixtures.viewing import frame_from_numbers


@dataclass
class MemoryWatch:
    """Samples the memory of a process and all its children, twenty times a second."""

    pid: int
    peak_mb: float = 0.0
    _stop: threading.Event = field(default_factory=threading.Event)

    def run(self) -> None:
        while not self._stop.wait(0.05):
            self.peak_mb = max(self.peak_mb, sum(_pss_mb(pid) for pid in _family(self.pid)))

    def stop(self) -> None:
        self._stop.set()


def _family(pid: int) -> list[int]:
    members = [pid]
    for member in members:
        try:
            for thread in Path(f"/proc/{member}/task").iterdir():
                members += [int(child) for child in (thread / "children").read_text().split()]
        except OSError:  # has ended meanwhile
            continue
    return members


def _pss_mb(pid: int) -> float:
    try:
        for line in Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines():
            if line.startswith("Pss:"):
                return int(line.split()[1]) / 1024.0
    except OSError:  # has ended meanwhile
        pass
    return 0.0


def rendered(cache: Path, *, survey_images: int, identify: int, verify: int, seed: int) -> tuple[Path, float]:
    """Folder with campaign/ and truth/, and the seconds of rendering (0 if it was there)."""
    folder = cache / f"campaign-{survey_images}-{identify}-{verify}-{seed}"
    if (folder / "done").exists():
        return folder, 0.0
    begin = time.perf_counter()
    plan = full_campaign(seed=seed, survey_images=survey_images, identify=identify, verify=verify)
    write_image_campaign(plan, folder / "campaign", folder / "truth")
    (folder / "done").touch()
    return folder, time.perf_counter() - begin


def run_pipeline(campaign: Path, run: Path) -> tuple[float, float]:
    """Seconds and peak megabytes of ``pipeline run``.

    Raises
    ------
    SystemExit
        If it fails; its message has been printed.
    """
    shutil.rmtree(run, ignore_errors=True)
    begin = time.perf_counter()
    process = subprocess.Popen([sys.executable, "-m", "pipeline.cli", "run", str(campaign), "--out", str(run)])
    watch = MemoryWatch(process.pid)
    thread = threading.Thread(target=watch.run)
    thread.start()
    code = process.wait()
    watch.stop()
    thread.join()
    if code != 0:
        raise SystemExit(f"pipeline run failed with code {code}")
    return time.perf_counter() - begin, watch.peak_mb


def prediction_errors(folder: Path, run: Path, scratch: Path) -> tuple[np.ndarray, np.ndarray]:
    """Distances (mm) of predicted and true tool origin at unmeasured poses, as stated and after aligning the worlds.

    The tool is the body's frame as surveyed, fitted onto the coordinates in its file; the truth is brought to it by the
    codes. The world is the first camera's frame as it was estimated; its small turn against the true one is no error of
    the robot's model.
    """
    truth = json.loads((folder / "truth" / "truth.json").read_text())
    q = np.array(truth["predict"]["q_deg"])
    with (scratch / "poses.csv").open("w", newline="") as stream:
        table = csv.writer(stream)
        table.writerow(["pose", *(f"q{k + 1}_deg" for k in range(q.shape[1]))])
        table.writerows([f"n{k}", *row] for k, row in enumerate(q.tolist()))
    out = scratch / "frames.csv"
    command = [sys.executable, "-m", "pipeline.cli", "predict", str(run), "--poses", str(scratch / "poses.csv")]
    subprocess.run([*command, "--out", str(out)], check=True, stdout=subprocess.DEVNULL)
    with out.open() as stream:
        predicted = np.array([[float(r[f"{a}_mm"]) for a in "xyz"] for r in csv.DictReader(stream)]) / 1e3
    true_T_surveyed = _body_alignment(truth["bodies"]["plate"], run / "bodies" / "plate.yaml")
    frames = [frame_from_numbers(f) @ true_T_surveyed for f in truth["predict"]["frames"]]
    true = np.array([f[:3, 3] for f in frames])
    placed = move(best_frame(predicted, true[None])[0], predicted)
    return 1e3 * np.linalg.norm(predicted - true, axis=1), 1e3 * np.linalg.norm(placed - true, axis=1)


def _body_alignment(true_body: dict[str, Any], surveyed: Path) -> np.ndarray:
    """Frame of the surveyed body in that of the true one, from the codes; identity if it was not surveyed."""
    if not surveyed.exists():
        return np.eye(4)
    true = dict(zip(true_body["ids"], true_body["xyz_mm"], strict=True))
    entries = {e["id"]: e["xyz_mm"] for e in yaml.safe_load(surveyed.read_text())["targets"] if e["code"]}
    both = [i for i in entries if i in true and entries[i] is not None]
    mine, theirs = (np.array([source[i] for i in both]) / 1e3 for source in (entries, true))
    return np.asarray(best_frame(mine, theirs[None])[0])


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--survey-images", type=int, default=60)
    parser.add_argument("--poses", type=int, default=80, help="a fifth of them kept out")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--cache", type=Path, default=Path("build/benchmarks"))
    given = parser.parse_args()
    verify = given.poses // 5
    folder, seconds = rendered(
        given.cache, survey_images=given.survey_images, identify=given.poses - verify, verify=verify, seed=given.seed
    )
    print(f"rendered in {seconds:.1f} s" if seconds else "rendered before", flush=True)
    total, peak = run_pipeline(folder / "campaign", folder / "run")
    result = json.loads((folder / "run" / "result.json").read_text())
    print(f"{'stage':12s} {'s':>8s}")
    for stage, took in result.get("timing", {}).items():
        print(f"{stage:12s} {took:8.2f}")
    print(f"{'total':12s} {total:8.2f}   (goal 100)")
    print(f"peak memory {peak:.0f} MB   (goal 2048)")
    for name, survey in result.get("survey", {}).items():
        print(f"survey of {name}: {survey}")
    print(f"points: {result.get('points')}")
    tools = result.get("verification", {})
    for reach, numbers in tools.get("tools", {}).items():
        nominal = tools.get("nominal", {}).get(reach, {})
        ratio = nominal["mean"] / numbers["mean"] if nominal else float("nan")
        print(
            f"tool {reach:>4s} mm: mean {numbers['mean']:.4f} mm, max {numbers['max']:.4f}; nominal {ratio:.1f} x worse"
        )
    direct, placed = prediction_errors(folder, folder / "run", folder)
    print(f"prediction at {len(direct)} new poses: mean {direct.mean():.4f} mm, max {direct.max():.4f};", end=" ")
    print(f"worlds aligned: mean {placed.mean():.4f} mm, max {placed.max():.4f}")


if __name__ == "__main__":
    main()
