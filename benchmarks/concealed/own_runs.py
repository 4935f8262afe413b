"""Batteries of robots with their own station, at the level of marks, through the stages of ``pipeline run``."""

from __future__ import annotations

import json
import tempfile
import time
import traceback
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.concealed.equivalence import Equivalence
from fixtures.draws import NotDrawable
from fixtures.effects import Effect
from fixtures.own_station import (
    OWN_BODY_CAUSES,
    OWN_CAMERA_CAUSES,
    OWN_ROBOT_CAUSES,
    OwnPlan,
    OwnTruth,
    draw_own_effect,
    kept_out_frames,
    make_own,
)
from fixtures.rigid import Array
from fixtures.signature import Design, tip_error_mm

SNRS = (8.5, 15.0)
NULLS: dict[str, dict[str, float]] = {
    "plain": {}, "repeatability": {"joint_repeatability_rad": 15e-6}, "understated": {"stated_factor": 0.85},
    "overstated": {"stated_factor": 1.15}, "single blunders": {"blunder_share": 0.003},
}  # fmt: skip
ROBOTS = ("kr150", "kr150", "ur10", "irb120")
SWAPPABLE = frozenset({"base_moved", "camera_moved"})


@dataclass(frozen=True)
class Own:
    """One campaign of robot and station; ``label`` is a kind of noise or a cause."""

    battery: str
    label: str
    seed: int
    snr: float | None
    level: str = "own"

    @property
    def key(self) -> str:
        """Unique name, also for resuming."""
        return f"{self.battery}/{self.label}/{self.level}/{self.seed}/{self.snr}"

    @property
    def plan(self) -> dict[str, Any]:
        """Fields of the plan: robots, numbers of cameras and targets take turns."""
        cameras, targets = ((2, 5), (2, 9), (3, 5), (2, 5))[self.seed // 4 % 4]
        return {"seed": self.seed, "robot": ROBOTS[self.seed % 4], "cameras": cameras, "targets": targets}


def own_runs(battery: str, count: int, seed: int) -> Iterator[Own]:
    """``nulls`` or ``singles``."""
    for i in range(count):
        if battery == "nulls":
            for k, label in enumerate(NULLS):
                yield Own(battery, label, seed + 10 * i + k, None)
            continue
        causes = (*OWN_ROBOT_CAUSES, *OWN_CAMERA_CAUSES, *OWN_BODY_CAUSES)
        for number, cause in enumerate(causes):
            for k, snr in enumerate(SNRS[:1] if cause == "target_swapped" else SNRS):
                yield Own(battery, cause, seed + 1000 * i + 3 * number + k, snr)


def run_own(own: Own) -> dict[str, Any]:
    """Make, run and score one campaign; a failure of the tool is a record with ``error``."""
    from pipeline.runner import run_campaign

    record: dict[str, Any] = {"key": own.key, "battery": own.battery, "label": own.label, "level": own.level}
    record |= {"snr": own.snr, "seed": own.seed, "robot": own.plan["robot"]}
    with tempfile.TemporaryDirectory(prefix="concealed-") as folder:
        root = Path(folder)
        plan = own.plan | NULLS.get(own.label, {})
        try:
            effects = [] if own.snr is None else [draw_own_effect(OwnPlan(**plan), own.label, own.snr)]
        except NotDrawable as error:
            return {**record, "skipped": str(error)}
        truth = make_own(root / "campaign", effects=effects, **plan)
        record["truth"] = [e.as_dict() for e in effects]
        try:
            start = time.perf_counter()
            run_campaign(root / "campaign", root / "run", until="diagnose")
            record["seconds"] = time.perf_counter() - start
            diagnosis = json.loads((root / "run" / "diagnosis.json").read_text(encoding="utf-8"))
            record |= {"mismatch": diagnosis["mismatch"], "p_value": diagnosis["p_value"]}
            record |= {
                "noise": diagnosis.get("noise"),
                "unexplained_p": (diagnosis.get("unexplained") or {}).get("p_value"),
            }
            record["answer"] = [
                {k: c.get(k) for k in ("cause", "stage", "where", "direction", "parameters", "sigma", "p_value")}
                | {"rivals": [f"{r['cause']}@{r['where']}" for r in c.get("indistinguishable_from") or []]}
                for c in diagnosis["causes"]
            ]  # fmt: skip
            if effects:
                record |= _scores(truth, effects[0], diagnosis)
                record |= _gain(root, truth, plan)
        except Exception as error:
            return {**record, "error": f"{type(error).__name__}: {error}", "traceback": traceback.format_exc()[-1500:]}
    return record


def _scores(truth: OwnTruth, effect: Effect, diagnosis: Mapping[str, Any]) -> dict[str, Any]:
    causes: Sequence[Mapping[str, Any]] = diagnosis["causes"]
    equal = Equivalence(truth.robot, Design.of(truth.robot)) if effect.stage == "robot" else None

    def right(told: Mapping[str, Any]) -> bool:
        if told["cause"] == "unknown":
            return False
        if told["cause"] in SWAPPABLE and effect.cause in SWAPPABLE and told["cause"] != effect.cause:
            return False
        if equal is not None and told["cause"] not in _MEASURING:
            return equal.same(effect, told)
        if told["cause"] != effect.cause:
            return False
        if effect.cause == "target_swapped":  # either of the two may be named first
            return str(told["where"]) in (effect.where, str(effect.parameters["with"]))
        return str(told["where"]) == effect.where

    hits = [c for c in causes if right(c)]
    out: dict[str, Any] = {
        "exact": len(causes) == len(hits) == 1,
        "extras": len(causes) - len(hits),
        "named": len(hits),
    }
    if not causes:
        return out
    first = causes[0]
    rivals = list(first.get("indistinguishable_from") or [])
    covered = [r for r in rivals if right(r)]
    named = right(first)
    here = named or str(first["where"]) == effect.where
    directions = {str(first.get("direction") or ""), effect.direction or ""}
    out |= {"name_right": named, "stage_right": named or first.get("stage") == effect.stage, "where_right": here}
    out |= {"direction_right": named or (here and ("" in directions or len(directions) == 1))}
    out |= {
        "set_covers": named or bool(covered),
        "set_size": 1 + len(rivals),
        "next_poses": bool(diagnosis["next_poses"]),
    }
    if named and first["cause"] == effect.cause:
        out |= dict(zip(("intervals_inside", "intervals"), _intervals(effect, first), strict=True))
    return out


_MEASURING = frozenset({*OWN_CAMERA_CAUSES, *OWN_BODY_CAUSES, "scale_drift", "scale_error", "centroid_bias"})
_PERIODIC = ("phase_deg", "azimuth_deg")


def _intervals(effect: Effect, told: Mapping[str, Any]) -> tuple[int, int]:
    """How many 95 % intervals hold the true value, of how many."""
    inside = total = 0
    for name, sigma in (told.get("sigma") or {}).items():
        true, value = effect.parameters.get(name), told["parameters"].get(name)
        if true is None or value is None or sigma is None or name in ("threshold_Nm", "tau_h", "order", "pose"):
            continue
        if effect.cause in ("camera_moved", "base_moved"):  # each tool has its own frame for it
            continue
        for a, b, s in zip(np.atleast_1d(value), np.atleast_1d(true), np.atleast_1d(sigma), strict=False):
            off = float(a) - float(b)
            off = (off + 180.0) % 360.0 - 180.0 if name in _PERIODIC else off
            total += 1
            inside += abs(off) <= 1.96 * float(s)
    return inside, total


def _gain(root: Path, truth: OwnTruth, plan: Mapping[str, Any]) -> dict[str, Any]:
    """Errors on kept-out poses: fitted without the diagnosis, with it, and fitted where nothing is concealed."""
    from pipeline.runner import run_campaign
    from pipeline.runs import Run

    true = kept_out_frames(truth)
    run, table = Run(root / "run"), root / "campaign" / "kept_out.csv"
    out = {"before_inside": tip_error_mm(_predicted(_fitted(root / "campaign", run), table), true)}
    out["after_inside"] = tip_error_mm(_predicted(run.load("calibrated_diagnose"), table), true)
    healthy = make_own(root / "healthy", effects=(), **plan)
    run_campaign(root / "healthy", root / "healthy_run", until="identify")
    calibrated = _fitted(root / "healthy", Run(root / "healthy_run"))
    table = root / "healthy" / "kept_out.csv"
    out["oracle_inside"] = tip_error_mm(_predicted(calibrated, table), kept_out_frames(healthy))
    return out


def _fitted(folder: Path, run: Any) -> Any:
    """The identified robot fitted once more beside the errors of its station, without any further physics."""
    from pipeline.bodies import body_for_robot
    from pipeline.calibrated import with_folded_cell
    from pipeline.campaign import read_campaign
    from pipeline.stages.diagnose import own_elasticities, recording_for_diagnosis
    from pipeline.stages.identify import load_identification, require_robot
    from robcal.diagnosis.fitting import fit

    campaign = read_campaign(folder)
    _, poses = require_robot(campaign)
    found = load_identification(run)
    body, points, station = body_for_robot(campaign, run), run.load("points"), run.load("orient")
    recording = recording_for_diagnosis(poses, found.recording, found.rows, body, points, station)
    robot = found.robot()
    model = fit(robot.model, recording, (*robot.names, *own_elasticities(robot))).model
    return replace(run.load("calibrated_identify"), model=with_folded_cell(model), statics="converged")


def _predicted(calibrated: Any, table: Path) -> Array:
    from pipeline.calibrated import predicted
    from pipeline.poses_table import read_poses

    poses = read_poses(table, calibrated.model, calibrated.model.payloads, to_predict=True)
    frames: Array = predicted(calibrated, poses)[0]
    return frames
