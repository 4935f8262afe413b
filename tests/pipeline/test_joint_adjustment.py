"""`model: {adjustment: joint}` in a run: results, the way back, refusals."""

from pathlib import Path

import numpy as np
import pytest

from fixtures.own_files import make_own
from fixtures.own_station import kept_out_frames
from pipeline.artifacts import IDENTIFICATION
from pipeline.campaign_reader import read_campaign
from pipeline.json_io import read_json
from pipeline.runner import run_campaign
from pipeline.runs import open_run
from pipeline.stages.identify import load_calibrated
from robcal.calibration.calibrated import CalibratedRobot
from robcal.errors import InvalidInput
from tests.pipeline.conftest import edit_yaml


@pytest.mark.slow
def test_joint_adjustment_of_a_run_and_back(tmp_path: Path) -> None:
    campaign, out = tmp_path / "campaign", tmp_path / "run"
    truth = make_own(campaign, seed=4, robot="ur10", poses=26, verify=6, kept_out=40, joint_repeatability_rad=2e-5)
    settings = {"diagnosis": {"enabled": False}, "model": {"adjustment": "joint"}}
    edit_yaml(campaign / "campaign.yaml", lambda d: d.update(settings))
    run_campaign(campaign, out)
    run = open_run(out)
    result = read_json(run.result)
    section = result["adjustment"]
    assert section["kind"] == "joint"
    assert section["poses"] == 26
    assert section["marks"] > 26 * 2 * 4
    assert "adjusted jointly" in " ".join(result["notes"])
    assert "One adjustment of" in run.report.read_text(encoding="utf-8")
    assert (out / "cameras" / "joint" / "left.yaml").is_file()

    def miss(robot: CalibratedRobot) -> float:
        T, _ = robot.predict(robot.kernel.poses(truth.kept_out.q, truth.kept_out.circumstances.payload))
        return float(np.linalg.norm((T - kept_out_frames(truth))[:, :3, 3], axis=1).mean())

    joint, staged = load_calibrated(run), run.load(IDENTIFICATION).robot
    assert miss(joint) < miss(staged)
    kept = result["verification"]
    assert kept["poses"] == 6
    assert kept["tools"]["0"]["mean"] < 0.3
    assert kept["coverage_95"] > 0.8
    assert kept["p_value"] > 1e-3
    edit_yaml(campaign / "campaign.yaml", lambda d: d.update(model={"adjustment": "staged"}))
    done = run_campaign(campaign, out, until="verify")
    assert "adjust" not in done.ran
    assert "adjustment" not in done.result
    assert np.allclose(load_calibrated(run).covariance, staged.covariance)


def test_joint_adjustment_of_what_it_does_not_know_is_refused(tmp_path: Path) -> None:
    make_own(tmp_path, seed=4, robot="ur10", poses=3, verify=1, kept_out=1)
    stated = {"xyz_mm": [0, 0, 0], "rpy_deg": [0, 0, 0]}
    edit_yaml(tmp_path / "campaign.yaml", lambda d: d.update(model={"adjustment": "joint"}, flange_T_tool=stated))
    with pytest.raises(InvalidInput, match="joint' knows nothing of what flange_T_tool states"):
        read_campaign(tmp_path)


def test_joint_adjustment_without_a_station_is_refused(tmp_path: Path) -> None:
    make_own(tmp_path, seed=4, robot="ur10", poses=3, verify=1, kept_out=1)

    def tracked(d: dict) -> None:  # type: ignore[type-arg]
        del d["station"]
        d.update(measurements="frames.csv", model={"adjustment": "joint"})

    (tmp_path / "frames.csv").write_text("pose,x_mm,y_mm,z_mm,roll_deg,pitch_deg,yaw_deg\np001,0,0,0,0,0,0\n")
    edit_yaml(tmp_path / "campaign.yaml", tracked)
    with pytest.raises(InvalidInput, match=r"campaign.yaml.*adjustment: joint.*needs 'robot', and a 'station'"):
        read_campaign(tmp_path)
