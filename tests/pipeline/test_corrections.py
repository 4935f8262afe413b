"""A fault of the measuring system that the diagnosis found does not spoil the verification of the robot."""

import json
from pathlib import Path

from fixtures.campaigns import make_campaign
from fixtures.own_files import make_own
from pipeline.runner import run_campaign


def test_scale_error_is_taken_back_before_the_verification(tmp_path: Path) -> None:
    make_campaign(tmp_path / "campaign", seed=36, poses=60, verify=12, effects=("scale_error",), snr=20)
    done = run_campaign(tmp_path / "campaign", tmp_path / "run", until="verify")
    assert [c["cause"] for c in done.result["diagnosis"]["causes"]] == ["scale_error"]
    verification = done.result["verification"]
    # noise of the measured frames is about 0.05 mm, the scale displaces the tool by half a millimetre
    assert verification["as_recorded"]["0"]["mean"] < 0.1
    assert verification["delivered"]["mean"] == verification["tools"]["0"]["mean"]
    assert verification["coverage_95"] > 0.7
    assert json.loads((tmp_path / "run" / "result.json").read_text())["verification"] == verification


def test_errors_beside_those_of_the_station_are_as_large_as_predicted(tmp_path: Path) -> None:
    make_own(tmp_path / "campaign", effects=[], seed=1, poses=50, verify=16, kept_out=4)
    done = run_campaign(tmp_path / "campaign", tmp_path / "run", until="verify")
    assert not done.result["diagnosis"]["mismatch"]
    verification = done.result["verification"]
    assert 0.6 < verification["normalised_error_squared"] < 1.5
    assert 0.001 < verification["p_value"] < 0.999
    # in the world, the station's own errors add to the robot's
    assert verification["predicted_sigma_mm"] > 1.2 * verification["tools"]["0"]["mean"] / 3**0.5
