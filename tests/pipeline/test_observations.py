"""What the robot stages work on."""

import csv
from pathlib import Path

import numpy as np

from fixtures.campaigns import make_campaign
from pipeline.artifacts import IDENTIFICATION
from pipeline.runner import run_campaign
from pipeline.runs import Run
from robcal.calibration.observations import PointObservations
from tests.pipeline.conftest import Rows, edit_rows


def without_sigmas(rows: Rows) -> Rows:
    return [{name: row[name] for name in ("pose", "target", "x_mm", "y_mm", "z_mm")} for row in rows]


def test_points_that_state_no_uncertainty_are_diagnosed_as_points(tmp_path: Path) -> None:
    make_campaign(tmp_path / "campaign", seed=36, poses=60, verify=12, effects=("scale_error",), snr=20)
    table = tmp_path / "campaign" / "points.csv"
    with table.open(newline="", encoding="utf-8") as stream:
        variance = np.mean([float(row["sigma_mm"]) ** 2 for row in csv.DictReader(stream)])
    edit_rows(table, without_sigmas)
    done = run_campaign(tmp_path / "campaign", tmp_path / "run", until="verify")
    # frames alone do not show the scale: the lengths of the robot absorb it
    assert [c["cause"] for c in done.result["diagnosis"]["causes"]] == ["scale_error"]
    (points,) = Run(tmp_path / "run").load(IDENTIFICATION).recording.detailed
    assert isinstance(points, PointObservations)
    # they scatter about their bodies as they are noisy, and as the scale lets them miss their places
    assert 0.9 * variance < 1e6 * points.covariance[0, 0, 0] < 2.0 * variance
