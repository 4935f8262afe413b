"""Inputs as people really make them, each through the command; a folder of its own beside the project holds them."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from pipeline.cli import app
from robcal.files.images import read_image

CASES = Path(__file__).parents[2].parent / "shared" / "cases"
pytestmark = pytest.mark.skipif(not CASES.is_dir(), reason="the folder of cases is not there")


def _run(tmp_path: Path, base: str, changed: dict[str, str]) -> tuple[int, str, dict]:
    """Exit code, what was told, and result.json of a sound campaign with some of its files replaced."""
    folder, out = tmp_path / "campaign", tmp_path / "run"
    folder.mkdir()
    for path in (CASES / base).iterdir():
        shutil.copyfile(path, folder / path.name)
    for name, source in changed.items():
        shutil.copyfile(CASES / source, folder / name)
    done = CliRunner().invoke(app, ["run", str(folder), "--out", str(out), "-q"])
    result = out / "result.json"
    return done.exit_code, done.output, json.loads(result.read_text()) if result.is_file() else {}


REFUSED = {
    "senses": (
        "00-base-points",
        {"poses.csv": "01-kuka-signs/poses.csv", "robot.yaml": "01-kuka-signs/robot.yaml"},
        ["joints 1, 4 and 6", "wrong sign", "change 'sign'", "mirror images"],
    ),
    "axis": (
        "00-base-points",
        {"robot.yaml": "03-wrong-robot-file/robot_axis4_about_z.yaml"},
        ["joint 4 (axis4) moves about x, not z as in the robot file"],
    ),
    "marks with y upwards": (
        "00-base-marks",
        {name: f"04-marks-y-up/{name}" for name in ("left.csv", "right.csv", "survey.csv")},
        ["survey.csv", "image axes are mirrored", "given coordinates", "the robot misses"],
    ),
    "mirrored coordinates": (
        "00-base-marks",
        {"plate.yaml": "05-given-coordinates/plate_mirrored.yaml"},
        ["plate.yaml", "given coordinates are mirrored"],
    ),
    "order of angles": (
        "00-base-frames",
        {"frames.csv": "13-frame-conventions/frames_intrinsic_xyz.csv"},
        ["angles are of the order X Y Z about moving axes"],
    ),
    "inverted frames": (
        "00-base-frames",
        {"frames.csv": "13-frame-conventions/frames_inverse.csv"},
        ["frames are inverted"],
    ),
}


@pytest.mark.parametrize("case", REFUSED)
def test_refused_with_the_reason(case: str, tmp_path: Path) -> None:
    base, changed, words = REFUSED[case]
    code, told, _ = _run(tmp_path, base, changed)
    assert code == 1
    for word in words:
        assert word in told


def test_a_wrong_length_is_told_and_no_good_verdict(tmp_path: Path) -> None:
    changed = {"robot.yaml": "03-wrong-robot-file/robot_1520_for_1250.yaml"}
    code, _, result = _run(tmp_path, "00-base-points", changed)
    assert code == 0
    assert any("x of axis3 is 125" in note and "1520.0 mm in the robot file" in note for note in result["notes"])
    assert result["verdict"]["grade"] == "care"
    assert any("axis3.x -2" in reason for reason in result["verdict"]["reasons"])


def test_gravity_upwards_is_no_good_verdict(tmp_path: Path) -> None:
    changed = {"robot.yaml": "03-wrong-robot-file/robot_gravity_up.yaml"}
    code, _, result = _run(tmp_path, "00-base-points", changed)
    assert code == 0
    assert result["verdict"]["grade"] == "care"
    assert any("below zero" in reason and "elastic" in reason for reason in result["verdict"]["reasons"])


def test_one_given_coordinate_off(tmp_path: Path) -> None:
    changed = {"plate.yaml": "05-given-coordinates/plate_one_target_50mm.yaml"}
    code, _, result = _run(tmp_path, "00-base-marks", changed)
    assert code == 0
    assert any("target 31" in note and "50.1 mm (sigma 0.3 mm)" in note for note in result["notes"])
    assert any("target 31" in reason for reason in result["verdict"]["reasons"])


def test_one_bad_pose_changes_no_figure(tmp_path: Path) -> None:
    code, _, result = _run(tmp_path, "00-base-points", {"points.csv": "06-before-figure/points_one_bad_pose.csv"})
    assert code == 0
    assert result["verification"]["nominal"]["0"]["mean"] == pytest.approx(1.97, abs=0.01)


def test_rows_of_zeros_change_no_figure(tmp_path: Path) -> None:
    code, told, result = _run(tmp_path, "00-base-frames", {"frames.csv": "06-before-figure/frames_three_zero_rows.csv"})
    assert code == 0
    assert "3 rows hold no reading" in told
    assert result["verification"]["nominal"]["0"]["mean"] == pytest.approx(4.59, abs=0.05)


def test_a_pitch_of_90_degrees(tmp_path: Path) -> None:
    code, _, result = _run(tmp_path, "00-base-frames", {"frames.csv": "08-gimbal-lock/frames.csv"})
    assert code == 0
    assert result["identification"]["sigma0"] == pytest.approx(1.0, abs=0.2)


def test_orientation_of_tiff_is_ignored_and_white_may_be_zero() -> None:
    folder = CASES / "09-tiff-orientation"
    assert np.array_equal(read_image(folder / "upside_down.tif"), read_image(folder / "untagged.tif"))
    for bits in (8, 16):
        image = read_image(CASES / "10-tiff-white-is-zero" / f"bright_dot_{bits}bit.tif")
        assert image[image.shape[0] // 2, image.shape[1] // 2] > 10 * float(image[0, 0]) + 100
