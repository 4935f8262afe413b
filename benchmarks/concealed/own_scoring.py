"""Scores of a diagnosis of a robot with its own station: names, places, intervals, gain on poses that were kept out."""

import json
import os
import traceback
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from benchmarks.concealed.equivalence import Equivalence
from fixtures.effects import Effect
from fixtures.own_files import make_own
from fixtures.own_station import OWN_BODY_CAUSES, OWN_CAMERA_CAUSES, OwnTruth, kept_out_frames
from fixtures.rigid import Array, best_frame
from fixtures.signature import Design, tip_error_mm

SWAPPABLE = frozenset({"base_moved", "camera_moved"})


def diagnosed(root: Path, truth: OwnTruth) -> dict[str, Any]:
    """Run the campaign in ``root`` up to its diagnosis and score it; a failure of the tool is ``error``."""
    from pipeline.runner import run_campaign

    record: dict[str, Any] = {"truth": [e.as_dict() for e in truth.plan.effects]}
    try:
        start = sum(os.times()[:4])  # of this process and those it started
        run_campaign(root / "campaign", root / "run", until="diagnose")
        record["seconds"] = sum(os.times()[:4]) - start
        diagnosis = json.loads((root / "run" / "diagnosis.json").read_text(encoding="utf-8"))
        record |= answered(diagnosis)
        for effect in truth.plan.effects:
            record |= own_scores(truth, effect, diagnosis)
            record |= own_gain(root, truth)
    except Exception as error:
        return {**record, "error": f"{type(error).__name__}: {error}", "traceback": traceback.format_exc()[-1500:]}
    return record


def answered(diagnosis: Mapping[str, Any]) -> dict[str, Any]:
    """What a record keeps of diagnosis.json."""
    return {
        "mismatch": diagnosis["mismatch"],
        "p_value": diagnosis["p_value"],
        "noise": diagnosis.get("noise"),
        "unexplained_p": (diagnosis.get("unexplained") or {}).get("p_value"),
        "answer": [
            {k: c.get(k) for k in ("cause", "stage", "where", "direction", "parameters", "sigma", "p_value")}
            | {"rivals": [f"{r['cause']}@{r['where']}" for r in c.get("indistinguishable_from") or []]}
            for c in diagnosis["causes"]
        ],
    }


def own_scores(truth: OwnTruth, effect: Effect, diagnosis: Mapping[str, Any]) -> dict[str, Any]:
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
        if effect.cause == "ellipse_eccentricity":  # the same dots in the images of all cameras
            return str(told["where"]) in (effect.where, *truth.cameras)
        return str(told["where"]) == effect.where

    hits = [c for c in causes if right(c)]
    once = effect.cause != "ellipse_eccentricity"
    out: dict[str, Any] = {
        "exact": len(causes) == len(hits) > 0 and (len(hits) == 1 or not once),
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


_IMAGE = ("centroid_bias", "ellipse_eccentricity")
_MEASURING = frozenset({*OWN_CAMERA_CAUSES, *OWN_BODY_CAUSES, "scale_drift", "scale_error", *_IMAGE})
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


def own_gain(root: Path, truth: OwnTruth) -> dict[str, Any]:
    """Errors on kept-out poses: fitted without the diagnosis, with it, and fitted where nothing is concealed.

    The last one at the level of marks, with the noise that the plan states.
    """
    from pipeline.artifacts import CALIBRATED
    from pipeline.runner import run_campaign
    from pipeline.runs import Run

    run, table = Run(root / "run"), root / "campaign" / "kept_out.csv"
    true = kept_out_frames(truth) @ true_T_surveyed(truth, root / "run" / "bodies" / "plate.yaml")
    out = {"before_inside": tip_error_mm(_predicted(_fitted(root / "campaign", run), table), true)}
    out["after_inside"] = tip_error_mm(_predicted(run.load(CALIBRATED), table), true)
    plan = {name: value for name, value in vars(truth.plan).items() if name != "effects"}
    healthy = make_own(root / "healthy", effects=(), **plan)
    run_campaign(root / "healthy", root / "healthy_run", until="identify")
    calibrated = _fitted(root / "healthy", Run(root / "healthy_run"))
    table = root / "healthy" / "kept_out.csv"
    out["oracle_inside"] = tip_error_mm(_predicted(calibrated, table), kept_out_frames(healthy))
    return out


def true_T_surveyed(truth: OwnTruth, surveyed: Path) -> Array:
    """Frame (4, 4) of the surveyed body in that of the true one, from its codes; none where it was not surveyed."""
    if not surveyed.exists():
        return np.eye(4)
    found = {e["id"]: e["xyz_mm"] for e in yaml.safe_load(surveyed.read_text(encoding="utf-8"))["targets"]}
    both = [k for k, i in enumerate(truth.ids) if i in truth.coded and found.get(i) is not None]
    mine = np.array([found[truth.ids[k]] for k in both]) / 1000.0
    frame: Array = best_frame(mine, truth.points[both][None])[0]
    return frame


def _fitted(folder: Path, run: Any) -> Any:
    """The identified robot fitted once more beside the errors of its station, without any further physics."""
    from pipeline.artifacts import IDENTIFICATION, ORIENTATION, POINTS, body_for_robot
    from pipeline.campaign_reader import read_campaign
    from pipeline.stages.identify import require_robot
    from robcal.calibration.calibrated import with_folded_cell
    from robcal.diagnosis.core.fitting import fit
    from robcal.recipe.recording import recording_for_diagnosis
    from robcal.recipe.robot_diagnosis import own_elasticities

    campaign = read_campaign(folder)
    _, poses = require_robot(campaign)
    found = run.load(IDENTIFICATION)
    body, points, station = body_for_robot(campaign, run), run.load(POINTS), run.load(ORIENTATION)
    recording = recording_for_diagnosis(poses, found.recording, found.rows, body, points, station)
    robot = found.robot
    model = fit(robot.model, recording, (*robot.names, *own_elasticities(robot))).model
    return replace(robot, model=with_folded_cell(model), statics="converged")


def _predicted(calibrated: Any, table: Path) -> Array:
    from robcal.files.poses_table import read_poses

    poses = read_poses(table, calibrated.model, calibrated.model.payloads, to_predict=True)
    frames: Array = calibrated.predict(calibrated.inputs(poses))[0]
    return frames
