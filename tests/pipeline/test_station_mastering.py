"""Mastering through the marks of a station of which one camera is left: resections, in the world of the calibration."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from fixtures.own_files import make_own
from pipeline.cli import app
from pipeline.runner import run_campaign
from tests.pipeline.conftest import edit_rows, edit_yaml

OFFSETS_DEG = np.array([0.4, -0.3, 0.25, 0.6, -0.5, 0.8])
AXES = [f"axis{k}" for k in range(1, 7)]


@pytest.fixture(scope="module")
def calibrated(tmp_path_factory):  # type: ignore[no-untyped-def]
    """A robot that two cameras calibrated."""
    folder = tmp_path_factory.mktemp("station")
    make_own(folder / "campaign", seed=21, robot="ur10", poses=45, verify=5, kept_out=2)
    edit_yaml(folder / "campaign" / "campaign.yaml", lambda d: d.update(diagnosis={"enabled": False}))
    run_campaign(folder / "campaign", folder / "run", until="identify")
    return folder


@pytest.mark.parametrize(("command", "poses"), [("master", 1), ("master", 8), ("exchange", 1)])
def test_one_camera_tells_the_zeros_of_all_joints(calibrated: Path, tmp_path: Path, command: str, poses: int) -> None:
    folder = tmp_path / "new"
    shutil.copytree(calibrated / "campaign", folder)
    camera = calibrated / "run" / "cameras" / "left.yaml"

    def one_camera(d: dict) -> None:  # type: ignore[type-arg]
        d["station"]["cameras"] = {"left": {"observations": "left.csv", "calibration": str(camera)}}

    edit_yaml(folder / "campaign.yaml", one_camera)
    kept: list[str] = []

    def indicated(rows: list[dict]) -> None:  # type: ignore[type-arg]
        kept.extend(row["pose"] for row in rows[:poses])
        del rows[poses:]
        for row in rows:
            row["set"] = "identify"
            for k in range(6):
                row[f"q{k + 1}_deg"] = str(float(row[f"q{k + 1}_deg"]) - OFFSETS_DEG[k])

    def of_these(rows: list[dict]) -> None:  # type: ignore[type-arg]
        rows[:] = [row for row in rows if row["image"] in kept]

    edit_rows(folder / "poses.csv", indicated)
    edit_rows(folder / "left.csv", of_these)
    words = [command, calibrated / "run", folder, "--out", tmp_path / "out", "--json", "-q"]
    done = CliRunner().invoke(app, [str(w) for w in words])
    assert done.exit_code == 0, done.output
    answer = json.loads(done.stdout.splitlines()[-1])
    found = np.array([answer["offsets_deg"][a] for a in AXES])
    sigma = np.array([answer["sigma_deg"][a] for a in AXES])
    assert np.all(np.abs(found - OFFSETS_DEG) < 4.0 * sigma)
    assert sigma.max() < (0.05 if command == "master" else 0.3)
