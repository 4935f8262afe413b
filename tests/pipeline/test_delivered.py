"""The headline is what `predict` misses with the campaign's own table of poses, and the datum is that of the frames."""

from pathlib import Path

import numpy as np
import pytest

from fixtures.campaigns import make_campaign
from pipeline.prediction import predict_run
from pipeline.runner import run_campaign
from robcal.files.tables import read_table


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
