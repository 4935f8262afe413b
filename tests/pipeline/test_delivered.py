"""The headline is what `predict` misses with the campaign's own table of poses, and the datum is that of the frames."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from fixtures.campaigns import make_campaign
from pipeline.artifacts import IDENTIFICATION
from pipeline.campaign_reader import read_campaign
from pipeline.prediction import predict_run
from pipeline.runner import run_campaign
from pipeline.runs import open_run
from pipeline.stages.identify import load_calibrated
from robcal.files.tables import read_table
from robcal.recipe.agreement import disagreements
from robcal.recipe.verification import verify_robot
from robcal.robot.model import Term


@pytest.mark.parametrize("level", ["frames", "points"])
def test_prediction_from_own_poses_misses_what_the_headline_says(tmp_path: Path, level: str) -> None:
    campaign, run = tmp_path / "campaign", tmp_path / "run"
    make_campaign(campaign, seed=7, level=level, poses=60, verify=12, effects=("backlash",), snr=15)
    done = run_campaign(campaign, run, until="verify")
    predict_run(run, campaign / "poses.csv", tmp_path / "predicted.csv")
    tables = [tmp_path / "predicted.csv", (campaign if level == "frames" else run) / "frames.csv"]
    predicted, measured = (
        dict(
            zip((t := read_table(p)).texts("pose"), np.column_stack([t.numbers(f"{n}_mm") for n in "xyz"]), strict=True)
        )
        for p in tables
    )
    log = read_table(campaign / "poses.csv")
    kind = dict(zip(log.texts("pose"), log.texts("set"), strict=True))
    off = {s: np.array([predicted[p] - measured[p] for p in measured if kind[p] == s]) for s in ("identify", "verify")}
    rms = float(np.sqrt(np.mean(np.sum(off["verify"] ** 2, axis=1))))
    assert rms == pytest.approx(done.result["verification"]["delivered"]["rms"], rel=1e-3)
    sigma = off["identify"].std(axis=0, ddof=1) / np.sqrt(len(off["identify"]))
    assert np.all(np.abs(off["identify"].mean(axis=0)) < 4 * sigma + 1e-6)
    assert isinstance(done.result["diagnosis"]["in_force"], bool)
    diagnosis = json.loads((run / "diagnosis.json").read_text(encoding="utf-8"))
    assert diagnosis["heldout_mm"]["after"] == pytest.approx(rms, rel=1e-3)
    backlash = diagnosis["causes"][0]
    assert backlash["in_force"] == diagnosis["in_force"]
    assert ("not in force" in backlash["statement"]) != backlash["in_force"]
    assert f"{backlash['parameters']['width_deg']:.4f}" in backlash["statement"]
    assert not any("does not quote" in note for note in diagnosis["notes"])
    assert "predict gives" not in " ".join(done.result["verdict"]["reasons"])


def test_results_that_contradict_one_another_are_told(tmp_path: Path) -> None:
    campaign, folder = tmp_path / "campaign", tmp_path / "run"
    make_campaign(campaign, seed=7, level="frames", poses=40, verify=12)
    run_campaign(campaign, folder, until="verify")
    run, poses = open_run(folder), read_campaign(campaign).poses
    assert poses is not None
    identification, robot = run.load(IDENTIFICATION), load_calibrated(run)
    found = verify_robot(robot.model, identification, robot, poses)
    after = 1e3 * found.delivered.tools["0"].rms
    told = {"heldout_mm": {"after": after}, "in_force": False, "causes": []}
    assert disagreements(found, robot, poses, identification.recording, told) == []
    wrong = {"heldout_mm": {"after": 0.9 * after}, "in_force": True, "causes": [{"cause": "x", "in_force": False}]}
    assert len(disagreements(found, robot, poses, identification.recording, wrong)) == 2
    other = replace(robot, model=robot.model.with_parameters({"axis2.x": 1e-3}))
    assert "predict gives" in disagreements(found, other, poses, identification.recording)[0]
    lag = Term("lag", "axis1", "q", "width*approach1", {"width": 2e-4})
    late = replace(robot, model=robot.model.with_terms((*robot.model.terms, lag)))
    guessed = replace(poses, inferred=(0,))
    freed = verify_robot(robot.model, identification, late, guessed, freed=identification.recording)
    assert freed.recorded is not None
    assert freed.unstated is not None
    assert freed.delivered.coverage_95 == freed.unstated.coverage_95 != freed.recorded.coverage_95
    assert freed.delivered.normalised == pytest.approx(freed.unstated.normalised)


def test_predictions_without_diagnosis_state_what_the_model_misses(tmp_path: Path) -> None:
    campaign, run = tmp_path / "campaign", tmp_path / "run"
    make_campaign(campaign, seed=7, level="points", poses=60, verify=30, effects=("backlash",), snr=150)
    with (campaign / "campaign.yaml").open("a", encoding="utf-8") as file:
        file.write("\ndiagnosis: {enabled: false}\n")
    run_campaign(campaign, run, until="verify")
    bare = replace(open_run(run).load(IDENTIFICATION).robot, joint_sigma=0.0)
    assert np.all(np.asarray(load_calibrated(open_run(run)).joint_sigma) > 0.0)
    predict_run(run, campaign / "poses.csv", tmp_path / "predicted.csv")
    at, seen = read_table(tmp_path / "predicted.csv"), read_table(run / "frames.csv")
    place = {pose: k for k, pose in enumerate(at.texts("pose"))}
    log = read_table(campaign / "poses.csv")
    kept_out = {p for p, s in zip(log.texts("pose"), log.texts("set"), strict=True) if s == "verify"}
    rows = [k for k, pose in enumerate(seen.texts("pose")) if pose in kept_out]
    there = [place[seen.texts("pose")[k]] for k in rows]
    poses = read_campaign(campaign).poses
    assert poses is not None
    alone = 1e3 * np.sqrt(np.diagonal(bare.predict(bare.inputs(poses.as_stated()))[1], axis1=1, axis2=2)[:, :3])
    error = np.stack([seen.numbers(f"{n}_mm")[rows] - at.numbers(f"{n}_mm")[there] for n in "xyz"], axis=1)
    stated = np.stack([at.numbers(f"s{n}_mm")[there] for n in "xyz"], axis=1)
    assert np.all(stated > alone[there])
    assert np.mean(np.abs(error) < 1.96 * stated) > 0.85
