"""`pipeline check`: everything at once, faults apart from doubts, nothing written."""

import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from pipeline.campaign_reader import read_campaign
from pipeline.checking.joints import joint_doubts
from pipeline.checking.measured import measured_doubts
from pipeline.cli import app
from tests.pipeline.conftest import Rows, edit_rows, edit_yaml

runner = CliRunner()


def check(campaign: Path) -> tuple[int, list[str], list[str]]:
    """Exit code, errors and warnings; the campaign is left as it was."""
    before = {path: path.stat().st_mtime_ns for path in campaign.rglob("*")}
    done = runner.invoke(app, ["check", str(campaign)])
    assert done.exception is None or isinstance(done.exception, SystemExit), done.exception
    assert {path: path.stat().st_mtime_ns for path in campaign.rglob("*")} == before
    lines = done.stdout.splitlines()
    errors = [line for line in lines if line.startswith("error: ")]
    assert done.exit_code == (1 if errors else 0)
    return done.exit_code, errors, [line for line in lines if line.startswith("warning: ")]


def told(lines: list[str], *words: str) -> bool:
    return any(all(word in line for word in words) for line in lines)


def test_a_sound_campaign_has_nothing_to_tell(point_campaign: Path, frame_campaign_source: Path) -> None:
    assert check(point_campaign) == (0, [], [])
    assert check(frame_campaign_source) == (0, [], [])


def test_faults_of_all_files_in_one_run(point_campaign: Path) -> None:
    def poses(rows: Rows) -> None:
        rows[1]["q2_deg"] = "nan"
        rows[4]["payload"] = "dumbell"
        rows[6]["set"] = "check"

    def points(rows: Rows) -> Rows:
        rows[0]["z_mm"], rows[9]["pose"], rows[30]["target"] = "x", "p999", "4"
        return [*rows, dict(rows[60])]

    def plate(data: dict) -> None:
        data["targets"].append(dict(data["targets"][0]))
        data["targets"][1]["diameter"] = 12

    edit_rows(point_campaign / "poses.csv", poses)
    edit_rows(point_campaign / "points.csv", points)
    edit_yaml(point_campaign / "plate.yaml", plate)
    path = point_campaign / "campaign.yaml"
    path.write_text(path.read_text() + "qualty: {distance_tolerance_mm: 1}\nmodel: {robust: true, robost: 1}\n")
    code, errors, _ = check(point_campaign)
    assert code == 1
    for words in (
        ("campaign.yaml", "did you mean 'quality'?"),
        ("campaign.yaml", "did you mean 'robust'?"),
        ("poses.csv, row 3", "q2_deg"),
        ("poses.csv, row 6", "did you mean 'dumbbell'?"),
        ("poses.csv, row 8", "'identify' or 'verify'"),
        ("points.csv, row 2", "z_mm", "not a number"),
        ("points.csv, row 11", "p999"),
        ("points.csv", "stands twice"),
        ("plate.yaml", "diameter"),
    ):
        assert told(errors, *words), (words, errors)
    assert not told(errors, "p002")  # a pose whose row is faulty is none that its measurements lack
    assert len(errors) == len(set(errors))


def test_rows_of_another_length_and_unlisted_targets(point_campaign: Path) -> None:
    edit_rows(point_campaign / "points.csv", lambda rows: rows[3].update(target="4"))
    table = point_campaign / "points.csv"
    lines = table.read_text().splitlines()
    lines[6] += ",1"
    table.write_text("\n".join([*lines, "p001,1"]) + "\n")
    _, errors, _ = check(point_campaign)
    assert told(errors, "points.csv, row 7:", "cells")
    assert told(errors, f"points.csv, row {len(lines) + 1}:", "cells")
    assert told(errors, "points.csv, row 5:", "target 4 is in no body")


def scaled(factor: float, *names: str):
    def change(rows: Rows) -> None:
        for row in rows:
            row.update({name: repr(float(row[name]) * factor) for name in names})

    return change


JOINTS = tuple(f"q{k}_deg" for k in range(1, 7))


def test_radians_and_metres(frame_campaign: Path) -> None:
    edit_rows(frame_campaign / "poses.csv", scaled(np.pi / 180, *JOINTS))
    _, errors, warnings = check(frame_campaign)
    assert told(errors, "radians stand where degrees are expected", "lowers the residual")
    assert told(warnings, "poses.csv", "look like radians")
    edit_rows(frame_campaign / "poses.csv", scaled(180 / np.pi, *JOINTS))
    edit_rows(frame_campaign / "frames.csv", scaled(1e-3, "x_mm", "y_mm", "z_mm"))
    _, errors, warnings = check(frame_campaign)
    assert told(errors, "millimetres")
    assert told(warnings, "frames.csv", "check the units")


def test_headings_of_a_controller(point_campaign: Path) -> None:
    edit_rows(
        point_campaign / "poses.csv",
        lambda rows: [{k.replace("q", "A").replace("_deg", ""): v for k, v in r.items()} for r in rows],
    )
    _, errors, _ = check(point_campaign)
    for k in range(1, 7):
        assert told(errors, "poses.csv, row 1", f"'q{k}_deg'", f"'A{k}'"), errors


def test_one_orientation_a_resting_joint_and_few_poses(frame_campaign: Path) -> None:
    kept = {f"p{k:03d}" for k in range(1, 9)}
    edit_rows(frame_campaign / "poses.csv", lambda rows: [r | {"q5_deg": "10"} for r in rows if r["pose"] in kept])
    edit_rows(
        frame_campaign / "frames.csv",
        lambda rows: [r | {"roll_deg": "0", "pitch_deg": "90", "yaw_deg": "5"} for r in rows if r["pose"] in kept],
    )
    campaign = read_campaign(frame_campaign)
    warnings = [*measured_doubts(campaign)[1], *joint_doubts(campaign)[1]]
    assert told(warnings, "frames.csv", "one orientation")
    assert told(warnings, "frames.csv", "pitch near 90 deg")
    assert told(warnings, "poses.csv", "axis5", "never moved")
    assert told(warnings, "poses.csv", "poses to identify from are few")


def test_images_of_another_plate_stop_with_both_lists(image_campaign: Path) -> None:
    def other_ids(data: dict) -> None:
        ids = iter([1, 3, 5, 7, 9, 11, 13, 15, 17, 19, 21, 23, 25, 27, 29, 31])
        for target in data["targets"]:
            if target["code"] == "ring12":
                target["id"] = next(ids)

    listed = {t["id"] for t in _targets(image_campaign) if t["code"] == "ring12"}
    edit_yaml(image_campaign / "plate.yaml", other_ids)
    edit_yaml(image_campaign / "campaign.yaml", lambda d: d["bodies"]["plate"]["survey"].pop("scale_bars", None))
    code, errors, _ = check(image_campaign)
    assert code == 1
    assert told(errors, "do not show the targets of", "plate.yaml", "listed but not read", str(min(listed)))


def _targets(campaign: Path) -> list[dict]:
    import yaml

    return yaml.safe_load((campaign / "plate.yaml").read_text())["targets"]


def test_images_and_poses_that_lack_each_other_and_files_that_are_no_images(image_campaign: Path) -> None:
    left = image_campaign / "station" / "left"
    images = sorted(left.iterdir())
    images[0].rename(left / f"stranger{images[0].suffix}")
    images[1].write_text("no image at all")
    images[2].write_bytes(images[2].read_bytes()[:2000])
    cv2.imwrite(str(images[3]), np.zeros((100, 200), np.uint8))
    edit_yaml(image_campaign / "plate.yaml", lambda d: [t.update(xyz_mm=None) for t in d["targets"]])
    edit_yaml(image_campaign / "campaign.yaml", lambda d: d["bodies"]["plate"]["survey"].pop("scale_bars"))
    _, errors, warnings = check(image_campaign)
    assert told(warnings, "no pose 'stranger'")
    assert told(warnings, f"pose '{images[0].stem}' has no image of camera 'left'")
    assert told(errors, images[1].name, "is not a PNG")
    assert told(errors, images[2].name, "truncated")
    assert told(errors, "campaign.yaml, line", "nothing gives the scale")


def test_answer_for_programs(point_campaign: Path, tmp_path: Path) -> None:
    edit_rows(point_campaign / "poses.csv", lambda rows: rows[1].update(q2_deg="nan"))
    done = runner.invoke(app, ["check", str(point_campaign), "--json"])
    assert done.exit_code == 1
    (line,) = done.stdout.splitlines()
    answer = json.loads(line)
    assert answer["ok"] is False
    (fault,) = answer["faults"]
    assert fault["file"].endswith("poses.csv")
    assert fault["row"] == 3
    assert runner.invoke(app, ["check", str(tmp_path / "nowhere")]).exit_code == 1
    shutil.rmtree(point_campaign)


@pytest.mark.parametrize("text", ["", "{", "format: robcal/campaign-1\n", "a: [1, 2]\n", "\x00"])
def test_files_that_are_no_campaign(tmp_path: Path, text: str) -> None:
    (tmp_path / "campaign.yaml").write_text(text)
    code, errors, _ = check(tmp_path)
    assert code == 1
    assert errors


@pytest.mark.parametrize("name", ["CON", "nul.txt", "cell 7.", "com3"])
def test_names_that_windows_takes_for_no_folder(point_campaign: Path, name: str) -> None:
    edit_yaml(point_campaign / "campaign.yaml", lambda d: d.update(name=name))
    assert told(check(point_campaign)[1], "campaign.yaml", "cannot be a folder on Windows")


def test_rows_of_poses_are_looked_at_although_the_robot_is_faulty(point_campaign: Path) -> None:
    robot = point_campaign / "robot.yaml"
    robot.write_text(robot.read_text(encoding="utf-8").replace("axis: x", "axis: w", 1), encoding="utf-8")

    def spoil(rows: Rows) -> Rows:
        rows[2]["q2_deg"] = "abc"
        rows[4]["payload"] = "ghost"
        return rows

    edit_rows(point_campaign / "poses.csv", spoil)
    _, errors, _ = check(point_campaign)
    assert told(errors, "robot.yaml", "'w'"), errors
    assert told(errors, "poses.csv, row 4", "q2_deg", "abc")
    assert told(errors, "poses.csv, row 6", "ghost")
    assert len(errors) == 3, errors  # a wrong entry is not told again as one that is missing
