"""The one place where the benchmark touches the system under test: a campaign folder in, an :class:`Answer` out.

``library`` calls the diagnosis in this process on what the campaign reader reads (fast, for hundreds of runs);
``command`` runs the commands ``pipeline run`` and ``pipeline predict`` as a user would.
"""

import csv
import json
import subprocess
import sys
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from fixtures.rigid import Array, frame_from_six


@dataclass(frozen=True)
class Answer:
    """What the tool said: diagnosis.json's content, predicted frames (n, 4, 4) by name of pose table, seconds
    (of computing for ``library``, of waiting for ``command``)."""

    diagnosis: Mapping[str, Any]
    predicted: Mapping[str, Array]
    seconds: float

    @property
    def mismatch(self) -> bool:
        return bool(self.diagnosis["mismatch"])

    @property
    def causes(self) -> list[Mapping[str, Any]]:
        return list(self.diagnosis.get("causes") or [])


def command(folder: Path, tables: Mapping[str, Path]) -> Answer:
    """By the commands. Raises RuntimeError with the tool's own words where one fails."""
    run = folder.parent / "run"
    start = time.perf_counter()
    _call(["run", str(folder), "--out", str(run), "--until", "diagnose", "-q"])
    seconds = time.perf_counter() - start
    diagnosis = json.loads((run / "diagnosis.json").read_text(encoding="utf-8"))
    predicted = {}
    for name, table in tables.items():
        out = folder.parent / f"predicted_{name}.csv"
        _call(["predict", str(run), "--poses", str(table), "--out", str(out), "-q"])
        predicted[name] = _frames(out)
    return Answer(diagnosis, predicted, seconds)


def _call(arguments: list[str]) -> None:
    done = subprocess.run(
        [sys.executable, "-c", "from pipeline.cli import main; main()", *arguments],
        capture_output=True,
        text=True,
        check=False,
        timeout=900,
    )
    if done.returncode:
        raise RuntimeError(f"pipeline {arguments[0]}: exit {done.returncode}: {done.stderr.strip()[-500:]}")


def _frames(path: Path) -> Array:
    with path.open(encoding="utf-8") as stream:
        rows = list(csv.DictReader(stream))
    six = np.array([[float(r[k]) for k in ("x_mm", "y_mm", "z_mm", "roll_deg", "pitch_deg", "yaw_deg")] for r in rows])
    return frame_from_six(six * np.array([1e-3] * 3 + [np.pi / 180] * 3))


def library(folder: Path, tables: Mapping[str, Path]) -> Answer:
    """In this process: campaign reader, identification and diagnosis, without stages and reports."""
    from pipeline.bodies import body_for_robot
    from pipeline.campaign_reader import read_campaign
    from pipeline.runs import Run
    from pipeline.stages.identify import options_of, require_robot
    from pipeline.stages.observations import build_recording
    from robcal.diagnosis.content import diagnosis_content
    from robcal.recipe.identification import identify_robot
    from robcal.recipe.robot_diagnosis import Measured, diagnose_robot

    start = time.process_time()  # of this one core, whatever else runs on the machine
    campaign = read_campaign(folder)
    robot, poses = require_robot(campaign)
    run = Run(folder.parent / "run")
    body = body_for_robot(campaign, run)
    measured = build_recording(campaign, run, body)
    found = identify_robot(robot, poses, measured, options_of(campaign, measured.stated))
    outcome = diagnose_robot(found, poses, Measured(body))
    if outcome is None:
        raise RuntimeError("no poses to identify from")
    seconds = time.process_time() - start
    result = outcome.diagnosis
    predicted = _predicted(result.model, campaign, poses.recorded(), tables)
    return Answer(diagnosis_content(result), predicted, seconds)


def _predicted(
    model: Any, campaign: Any, recorded: Mapping[str, Array], tables: Mapping[str, Path]
) -> dict[str, Array]:
    from robcal.files.poses_table import read_poses
    from robcal.robot.kernel import Kernel

    kernel = Kernel(model, "converged")
    predicted = {}
    for name, table in tables.items():
        poses = read_poses(table, campaign.robot, campaign.robot.payloads, to_predict=True)
        inputs = poses.inputs(kernel)
        after = {**inputs.covariates, "index": np.full(len(poses), float(len(recorded["index"])))}
        predicted[name] = kernel.frames(kernel.theta0, kernel.poses(poses.q, poses.payload, after))
    return predicted


ADAPTERS = {"library": library, "command": command}
