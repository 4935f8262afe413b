"""What reading a campaign refuses, and in which words."""

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from pipeline.campaign_reader import read_campaign
from pipeline.cli import app
from pipeline.runner import run_campaign
from robcal.errors import InvalidInput
from robcal.files.measurement_tables import MarksTable, check_marks
from tests.pipeline.conftest import Rows, edit_rows, edit_yaml


def refused(path: Path) -> str:
    """The sentence with which the command refuses a campaign before any stage runs."""
    out = path.parent / "refused"
    done = CliRunner().invoke(app, ["run", str(path), "--out", str(out), "-q"])
    assert done.exit_code == 1
    assert "Traceback" not in done.output
    assert not out.exists()
    (text,) = done.stderr.splitlines()
    assert text.startswith("error: ")
    return text


def test_units_sets_payloads_and_covariates(point_campaign: Path) -> None:
    campaign = read_campaign(point_campaign)
    assert campaign.poses is not None
    assert campaign.poses.q.shape == (48, 6)
    assert np.abs(campaign.poses.q).max() < 7
    assert campaign.poses.verify.sum() == 8
    assert set(campaign.poses.covariates) == {"time_s", "temp_arm_c", "temp_room_c"}
    assert campaign.robot is not None
    assert set(campaign.robot.payloads) == {"dumbbell", "plate_only"}
    (table,) = campaign.measurements
    assert table.kind == "points"
    np.testing.assert_allclose(table.covariance[0], np.eye(3) * (6e-5) ** 2)


def test_approach_is_inferred_and_said_to_be(point_campaign: Path) -> None:
    def drop(rows: Rows) -> Rows:
        return [{k: v for k, v in row.items() if not k.startswith("approach")} for row in rows]

    edit_rows(point_campaign / "poses.csv", drop)
    campaign = read_campaign(point_campaign)
    assert campaign.poses is not None
    assert campaign.poses.inferred
    assert "inferred from the order" in campaign.notes[0]
    q = campaign.poses.q
    assert campaign.poses.approach[1, 0] == np.sign(q[1, 0] - q[0, 0])


def test_empty_folder_and_missing_folder(tmp_path: Path) -> None:
    assert "no campaign.yaml" in refused(tmp_path)
    assert "no such folder" in refused(tmp_path / "nowhere")


def test_unknown_key_with_the_nearest_known_one(point_campaign: Path) -> None:
    path = point_campaign / "campaign.yaml"
    path.write_text(path.read_text() + "mesurements: points.csv\n")
    text = refused(point_campaign)
    assert "unknown key 'mesurements': did you mean 'measurements'?" in text
    assert "campaign.yaml" in text


def test_nested_unknown_key_names_its_line(image_campaign: Path) -> None:
    path = image_campaign / "campaign.yaml"
    text = path.read_text()
    line = next(i for i, row in enumerate(text.splitlines(), 1) if "scale_bars" in row)
    path.write_text(text.replace("scale_bars", "scalebars", 1))
    told = refused(image_campaign)
    assert "did you mean 'scale_bars'?" in told
    assert f"campaign.yaml, line {line}:" in told


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda d: d.pop("poses"), ["poses"]),
        (lambda d: d.pop("measurements"), ["nothing to work on"]),
        (lambda d: d.update(robot="none.yaml"), ["none.yaml", "no such file"]),
        (lambda d: d.update(name="a/b"), ["name", "slashes"]),
        (lambda d: d.update(format="robcal/robot-1"), ["'format'"]),
        (lambda d: d.update(body="ball"), ["there is no body 'ball'"]),
        (lambda d: d.update(payloads={"dumbbell": {"mass_kg": -1}}), ["payloads.dumbbell.mass_kg", "negative"]),
        (lambda d: d.update(quality={"distance_tolerance_mm": 0}), ["larger than zero"]),
        (lambda d: d.update(measurements=["points.csv", "none.csv"]), ["none.csv", "no such file"]),
    ],
)
def test_contradictions_in_campaign_yaml(point_campaign: Path, change, words: list[str]) -> None:
    edit_yaml(point_campaign / "campaign.yaml", change)
    told = refused(point_campaign)
    for word in words:
        assert word in told


def set_cell(row: int, name: str, value: str):
    def change(rows: Rows) -> None:
        rows[row][name] = value

    return change


def copy_first_row(rows: Rows) -> Rows:
    return [*rows, dict(rows[0])]


@pytest.mark.parametrize(
    ("file", "change", "words"),
    [
        ("poses.csv", set_cell(3, "q2_deg", "nan"), ["poses.csv, row 5", "q2_deg"]),
        ("poses.csv", set_cell(3, "q2_deg", "ten"), ["poses.csv, row 5", "not a number"]),
        ("poses.csv", set_cell(2, "payload", "dumbell"), ["row 4", "did you mean 'dumbbell'?"]),
        ("poses.csv", set_cell(2, "set", "check"), ["row 4", "'identify' or 'verify'"]),
        ("poses.csv", set_cell(2, "approach3", "2"), ["row 4", "approach3", "-1, 0 or +1"]),
        ("poses.csv", set_cell(2, "temp_arm_c", ""), ["row 4", "temp_arm_c"]),
        ("poses.csv", copy_first_row, ["row 50", "stands twice"]),
        ("poses.csv", lambda rows: [{k.replace("q4_deg", "q4"): v for k, v in r.items()} for r in rows], ["'q4_deg'"]),
        ("poses.csv", lambda rows: [{**r, "q7_deg": "0"} for r in rows], ["q7_deg", "6 joints"]),
        ("points.csv", set_cell(7, "z_mm", "NaN"), ["points.csv, row 9", "z_mm"]),
        ("points.csv", set_cell(7, "pose", "p999"), ["points.csv, row 9", "p999"]),
        ("points.csv", set_cell(7, "target", "4"), ["points.csv, row 9", "target 4 is in no body"]),
        ("points.csv", set_cell(7, "target", "left"), ["points.csv, row 9", "integer"]),
        ("points.csv", set_cell(7, "sigma_mm", "0"), ["points.csv, row 9", "larger than zero"]),
        ("points.csv", set_cell(7, "x_mm", "1e12"), ["points.csv, row 9", "unit"]),
        ("points.csv", copy_first_row, ["points.csv", "stands twice"]),
    ],
)
def test_bad_rows_are_told_with_file_and_row(point_campaign: Path, file: str, change, words: list[str]) -> None:
    edit_rows(point_campaign / file, change)
    told = refused(point_campaign)
    for word in words:
        assert word in told


def test_a_pose_without_measurement_is_a_warning(point_campaign: Path) -> None:
    edit_rows(point_campaign / "points.csv", lambda rows: [r for r in rows if r["pose"] != "p003"])
    campaign = read_campaign(point_campaign)
    assert any("p003" in warning for warning in campaign.warnings)


def test_image_folders(image_campaign: Path) -> None:
    left = image_campaign / "station" / "left"
    images = sorted(left.iterdir())
    images[0].rename(left / f"stranger{images[0].suffix}")
    campaign = read_campaign(image_campaign)
    assert any("stranger" in w and "no pose 'stranger'" in w for w in campaign.warnings)
    assert any(f"pose '{images[0].stem}' has no image of camera 'left'" in w for w in campaign.warnings)

    shutil.copy(images[1], images[1].with_suffix(".bmp"))
    assert "has two images" in refused(image_campaign)
    images[1].with_suffix(".bmp").unlink()

    for path in left.iterdir():
        path.rename(left / f"x{path.name}")
    assert "no image of camera 'left' has the name of a pose" in refused(image_campaign)

    for path in left.iterdir():
        path.unlink()
    assert "no images in this folder" in refused(image_campaign)

    left.rmdir()
    told = refused(image_campaign)
    assert "camera 'left'" in told
    assert "no such folder" in told


def test_a_ring_id_that_no_ring_shows(image_campaign: Path) -> None:
    def spoil(data: dict) -> None:
        data["targets"][0]["id"] = 302

    edit_yaml(image_campaign / "plate.yaml", spoil)
    assert "302 is no ring12 id" in refused(image_campaign)


def test_a_normal_that_is_no_direction(point_campaign: Path) -> None:
    edit_yaml(point_campaign / "plate.yaml", lambda d: d["targets"][1].update(normal=[0.0, 0.0, 0.0]))
    assert "it is a direction of length 1" in refused(point_campaign)


def test_bodies_of_contradictory_targets(point_campaign: Path) -> None:
    edit_yaml(point_campaign / "plate.yaml", lambda d: d["targets"].append(dict(d["targets"][0])))
    assert "stands twice" in refused(point_campaign)


def test_poses_beyond_the_ranges_are_told_with_row_and_joint(point_campaign: Path) -> None:
    """The run refuses them, after it has looked for a slip that explains them."""
    edit_rows(point_campaign / "poses.csv", set_cell(0, "q1_deg", "300"))
    poses = read_campaign(point_campaign).poses
    assert poses is not None
    for word in ("poses.csv, row 2", "outside the range", "axis1", "(1 such poses)"):
        assert word in poses.outside
    with pytest.raises(InvalidInput, match=r"row 2: q1_deg = 300 deg lies outside.*the range in the robot file$"):
        run_campaign(point_campaign, point_campaign.parent / "run")


@pytest.mark.parametrize(
    ("shift", "sides", "words"),
    [
        ((-320, -256), (1, 1), "counted from the centre"),
        ((-320, 256), (1, -1), "counted from the centre"),
        ((0, 0), (1, -1), "y seems to be counted upwards"),
        ((0, 0), (5, 5), "check columns and image size"),
    ],
)
def test_marks_that_lie_in_no_image(shift: tuple[int, int], sides: tuple[int, int], words: str) -> None:
    xy = np.random.default_rng(1).uniform([20, 20], [620, 490], (60, 2))
    marks = MarksTable(Path("left.csv"), ("p1",) * 60, np.arange(60), xy, np.ones(60), False)
    check_marks(marks, (640, 512))
    with pytest.raises(InvalidInput, match=words):
        check_marks(replace(marks, xy=xy * sides + shift), (640, 512))
