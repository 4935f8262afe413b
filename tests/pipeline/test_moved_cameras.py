"""Small camera movements in the stages, and what robot and station together tell."""

import json
from pathlib import Path

import numpy as np
import pytest

from fixtures.effects import Effect
from fixtures.own_effects import draw_own_effect
from fixtures.own_files import make_own
from fixtures.own_station import OwnPlan, kept_out_frames
from fixtures.signature import tip_error_mm
from pipeline.artifacts import IDENTIFICATION, ORIENTATION
from pipeline.campaign_reader import read_campaign
from pipeline.runner import run_campaign
from pipeline.runs import Run
from pipeline.stages.identify import load_calibrated
from robcal.calibration.calibrated import CalibratedRobot
from robcal.diagnosis.images.camera_moves import epochs_of
from robcal.diagnosis.images.diagnosis import ImageFinding
from robcal.diagnosis.search.selection import SelectionSettings
from robcal.files.poses_table import read_poses
from robcal.physics.library import kinds
from robcal.recipe.recording import common_errors
from robcal.recipe.robot_diagnosis import settings_beside
from robcal.recipe.verification import datum_note

PLAN = {"seed": 21, "robot": "ur10", "poses": 50, "verify": 10, "kept_out": 30}


def _moved(camera: str) -> Effect:
    found = draw_own_effect(OwnPlan(**PLAN), "camera_moved", 14.0)  # 14: whichever camera it is, below the sure limit
    return Effect("camera_moved", camera, None, found.parameters)


@pytest.mark.parametrize("camera", ["left", "right"])
def test_small_move_is_told_and_the_robot_tells_which_of_two_cameras(tmp_path: Path, camera: str) -> None:
    effect = _moved(camera)
    make_own(tmp_path / "campaign", effects=[effect], **PLAN)
    run_campaign(tmp_path / "campaign", tmp_path / "run", until="identify")
    station = Run(tmp_path / "run").load(ORIENTATION)
    (item,) = [e for e in station.evidence if e.name == "camera_moved"]
    assert item.where == camera
    assert item.alone
    assert abs(item.pose - effect.value("index")) <= 3
    assert [name for name, poses in epochs_of(station).items() if poses] == [camera]
    shift, covariance = station.movement(camera, item.pose)
    truth = np.r_[effect.vector("shift_mm") / 1000.0, np.radians(effect.vector("turn_deg"))]
    off = shift - truth
    assert off @ np.linalg.solve(covariance, off) < 30.0


def test_healthy_station_gets_no_epoch_and_a_better_robot_than_from_frames_alone(tmp_path: Path) -> None:
    truth = make_own(tmp_path / "campaign", effects=[], **PLAN)
    run_campaign(tmp_path / "campaign", tmp_path / "run", until="diagnose")
    run = Run(tmp_path / "run")
    station = run.load(ORIENTATION)
    assert not any(poses for poses in epochs_of(station).values())
    assert not json.loads(run.diagnosis.read_text())["mismatch"]

    def error(calibrated: CalibratedRobot) -> float:
        table = tmp_path / "campaign" / "kept_out.csv"
        poses = read_poses(table, calibrated.model, calibrated.model.payloads, to_predict=True)
        # the world is that of the measured frames, whose common error no pose can tell
        predicted = calibrated.predict(calibrated.inputs(poses))[0]
        return tip_error_mm(predicted, kept_out_frames(truth), free_world=True)

    assert error(load_calibrated(run)) < 0.95 * error(run.load(IDENTIFICATION).robot)
    assert not datum_note(run.load(IDENTIFICATION), load_calibrated(run), read_campaign(tmp_path / "campaign").poses)
    recording = run.load(IDENTIFICATION).recording
    rows = recording.poses
    (frames,) = recording.select(rows, detailed=True)
    columns = common_errors(frames, recording, rows, None, None, station)
    assert columns is not None
    joint = frames.covariance + columns @ np.swapaxes(columns, 1, 2)
    at = np.searchsorted(station.poses, rows[frames.pose])
    assert np.allclose(joint, station.body_covariance[at], rtol=0.02, atol=1e-12)


@pytest.mark.slow
def test_moved_base_may_be_moved_cameras(tmp_path: Path) -> None:
    effect = draw_own_effect(OwnPlan(**PLAN), "base_moved", 20.0)
    make_own(tmp_path / "campaign", effects=[effect], **PLAN)
    run_campaign(tmp_path / "campaign", tmp_path / "run", until="diagnose")
    content = json.loads((tmp_path / "run" / "diagnosis.json").read_text())
    first = content["causes"][0]
    assert (first["cause"], first["stage"]) == ("base_moved", "robot")
    assert {"cause": "camera_moved", "where": "station"}.items() <= first["indistinguishable_from"][-1].items()
    assert content["next_poses"]
    assert "targets at rest" in " ".join(content["notes"])


def test_robot_is_judged_sternly_beside_uncorrected_causes_in_images() -> None:
    def found(cause: str) -> ImageFinding:
        return ImageFinding(kinds()[cause], "left", None, {}, {}, 1e-9, (), (1.0, 0.5), "")

    plain = SelectionSettings()
    assert settings_beside(plain, [found("lens_radial"), found("camera_moved")]) == plain
    assert settings_beside(plain, [found("refraction")]).level == 1e-6
