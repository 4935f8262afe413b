"""Linear cameras as a measuring system: calibration, points, a campaign, and what is refused."""

import csv
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from fixtures.line_cameras import LEDS, write_line_campaign
from fixtures.plan import Plan, Truth
from fixtures.rigid import move
from pipeline.artifacts import FRAMES, POINTS
from pipeline.cli import app
from pipeline.line_cameras import calibrate_lines, points_of_lines
from pipeline.runner import run_campaign
from robcal.errors import InvalidInput
from robcal.files.line_cameras import read_line_cameras, write_line_cameras

Folder = tuple[Path, Truth]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Folder:
    place = tmp_path_factory.mktemp("lines")
    truth = write_line_campaign(place / "campaign", Plan(seed=3, poses=24, verify=6))
    here = place / "campaign"
    calibrate_lines(here / "calibration.csv", here / "places.csv", here / "system.yaml")
    return here, truth


def test_a_campaign_measures_frames_with_honest_covariance(folder: Folder, tmp_path: Path) -> None:
    here, truth = folder
    run = run_campaign(here, tmp_path / "run", until="frames").run
    points, frames = run.load(POINTS), run.load(FRAMES)
    e = points.p_world - move(truth.true_frames, np.broadcast_to(LEDS, (30, 5, 3)))[points.pose, points.target]
    nees = np.einsum("ni,nij,nj->n", e, np.linalg.inv(points.total_covariance), e)
    assert 0.6 < np.mean(nees) / 3.0 < 1.5  # one calibration alone
    assert len(frames.pose) == 30
    away = np.linalg.norm(frames.world_T_body[:, :3, 3] - truth.true_frames[frames.pose, :3, 3], axis=1)
    assert away.mean() < 3e-4


def test_points_without_a_campaign(folder: Folder, tmp_path: Path) -> None:
    here, _ = folder
    answer = points_of_lines(here / "lines.csv", here / "system.yaml", tmp_path / "points.csv")
    assert answer["points"] == 150
    assert not answer["lost"]
    with (tmp_path / "points.csv").open() as stream:
        assert {"pose", "target", "x_mm", "szz_mm2", "cameras"} <= set(next(csv.DictReader(stream)))


def test_a_system_is_written_and_read_without_loss(folder: Folder, tmp_path: Path) -> None:
    system = read_line_cameras(folder[0] / "system.yaml")
    write_line_cameras(tmp_path / "again.yaml", system)
    again = read_line_cameras(tmp_path / "again.yaml")
    np.testing.assert_allclose(again.covariance, system.covariance, rtol=1e-6, atol=1e-15)
    assert [c.f for c in again.cameras] == [c.f for c in system.cameras]
    assert again.cameras[0].calibrated == system.cameras[0].calibrated


def bad(text: str, old: str, new: str) -> str:
    assert old in text
    return text.replace(old, new, 1)


@pytest.mark.parametrize(
    ("file", "old", "new", "told"),
    [
        (
            "lines.csv",
            "p001,0,line1",
            "p001,0,lime1",
            "row 2: camera 'lime1' is not in the system: did you mean 'line1'",
        ),
        ("lines.csv", "p001,0,line2", "p001,0,line1", "row 3: pose p001, target 0, camera line1 stands twice"),
        ("lines.csv", "u_px", "v_px", "column 'u_px' is missing"),
        ("lines.csv", "p001,0,line1,", "p001,0,line1,-9", "deg off the axis of camera 'line1'"),
        ("system.yaml", "noise_px: 0.02", "noise_px: 0", "line 2"),
        ("system.yaml", "\n- [", "\n- [1.0, ", "27 rows of 27 numbers"),
        ("system.yaml", "  line1:", "  first:", "row 2: camera 'line1' is not in the system"),
    ],
)
def test_what_is_wrong_is_told_in_a_sentence(
    folder: Folder, tmp_path: Path, file: str, old: str, new: str, told: str
) -> None:
    for name in ("lines.csv", "system.yaml"):
        text = (folder[0] / name).read_text()
        (tmp_path / name).write_text(bad(text, old, new) if name == file else text)
    with pytest.raises(InvalidInput) as error:
        points_of_lines(tmp_path / "lines.csv", tmp_path / "system.yaml", tmp_path / "points.csv")
    assert told in str(error.value)
    assert not (tmp_path / "points.csv").exists()


@pytest.mark.parametrize(
    ("file", "old", "new", "told"),
    [
        ("places.csv", "c5,0,", "c5,1,", "target 0 of pose 'c5' has no known place in places.csv (1 such lights)"),
        ("places.csv", "x_mm", "x", "column 'x_mm' is missing"),
    ],
)
def test_a_calibration_that_cannot_be_is_refused(
    folder: Folder, tmp_path: Path, file: str, old: str, new: str, told: str
) -> None:
    for name in ("calibration.csv", "places.csv"):
        text = (folder[0] / name).read_text()
        (tmp_path / name).write_text(bad(text, old, new) if name == file else text)
    with pytest.raises(InvalidInput) as error:
        calibrate_lines(tmp_path / "calibration.csv", tmp_path / "places.csv", tmp_path / "system.yaml")
    assert told in str(error.value)


def test_readings_without_their_system_are_refused(folder: Folder, tmp_path: Path) -> None:
    text = (folder[0] / "campaign.yaml").read_text()
    for path in folder[0].iterdir():
        (tmp_path / path.name).write_bytes(path.read_bytes())
    lone = bad(text, "{file: lines.csv, line_cameras: system.yaml}", "lines.csv")
    (tmp_path / "campaign.yaml").write_text(lone)
    done = CliRunner().invoke(app, ["check", str(tmp_path), "--json"])
    assert done.exit_code == 1
    assert "write {file: lines.csv, line_cameras: system.yaml}" in done.output
