"""Seconds that ``pipeline diagnose`` takes for a survey alone whose camera file leaves the distortion out.

Run: ``python -m benchmarks.survey_diagnosis [--images 100] [--targets 125] [--seeds 1 2 3]``. Marks of a survey (with
noise of 0.05 px) by a lens with radial and tangential distortion and pixels that are not square; its file says pinhole.
The survey is adjusted first, then the diagnosis runs alone. Goal: 30 s on one core for 100 images.
"""

import argparse
import json
import os
import tempfile
import time
from pathlib import Path

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):  # before numpy is loaded: one core
    os.environ.setdefault(_name, "1")

from fixtures.effects import Effect  # noqa: E402
from fixtures.sightings import LENS, SightingPlan, draw_scene, make_sightings  # noqa: E402
from pipeline.runner import run_campaign  # noqa: E402


def concealed_lens(plan: SightingPlan) -> list[Effect]:
    """All groups of lens terms of the plan's camera, to be left out in its file."""
    camera = draw_scene(plan).cameras["survey"]
    values = {"k1": camera.k1, "k2": camera.k2, "p1": camera.p1, "p2": camera.p2, "fy_over_fx": camera.fy / camera.fx}
    return [Effect(group, "survey", None, {name: values[name] for name in names}) for group, names in LENS.items()]


def measured(images: int, targets: int, seed: int) -> tuple[int, float, float, list[str]]:
    """Marks; seconds of processor and of waiting for the diagnosis; the causes that it names."""
    plan = {"seed": seed, "kind": "survey", "views": images, "targets": targets}
    with tempfile.TemporaryDirectory(prefix="survey-diagnosis-") as folder:
        campaign, run = Path(folder) / "campaign", Path(folder) / "run"
        make_sightings(campaign, effects=concealed_lens(SightingPlan(**plan)), **plan)  # type: ignore[arg-type]
        run_campaign(campaign, run, until="survey")
        cpu, wall = time.process_time(), time.perf_counter()
        run_campaign(campaign, run, only=("diagnose",))
        cpu, wall = time.process_time() - cpu, time.perf_counter() - wall
        diagnosis = json.loads((run / "diagnosis.json").read_text(encoding="utf-8"))
        marks = len((campaign / "survey.csv").read_text(encoding="utf-8").splitlines()) - 1
    return marks, cpu, wall, [cause["cause"] for cause in diagnosis["causes"]]


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--images", type=int, default=100)
    parser.add_argument("--targets", type=int, default=125)
    parser.add_argument("--seeds", type=int, nargs="+", default=[1, 2, 3])
    given = parser.parse_args()
    print("seed images  marks  processor s  waiting s  causes")
    for seed in given.seeds:
        marks, cpu, wall, causes = measured(given.images, given.targets, seed)
        print(f"{seed:4d} {given.images:6d} {marks:6d} {cpu:12.1f} {wall:10.1f}  {', '.join(causes)}", flush=True)


if __name__ == "__main__":
    main()
