"""Predictions and compensations of a finished run against the fixtures' true robot and against each other."""

import csv
from pathlib import Path

import numpy as np
import pytest

from fixtures.campaigns import make_campaign
from pipeline.prediction import CompensateOptions, compensate_run, predict_run
from pipeline.runner import run_campaign
from robcal.errors import InvalidInput
from robcal.files.tables import read_table
from tests.pipeline.conftest import edit_yaml


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    folder = tmp_path_factory.mktemp("prediction")
    make_campaign(folder / "campaign", seed=11, level="frames", poses=60, verify=20)
    edit_yaml(folder / "campaign" / "campaign.yaml", lambda d: d.update(diagnosis={"enabled": False}))
    run_campaign(folder / "campaign", folder / "run", until="verify")
    return folder / "campaign", folder / "run"


def positions(path: Path) -> dict[str, np.ndarray]:
    table = read_table(path)
    xyz = np.column_stack([table.numbers(f"{n}_mm") for n in "xyz"])
    return dict(zip(table.texts("pose"), xyz, strict=True))


def test_predictions_agree_with_measurements_and_nominal_ones_do_not(
    finished: tuple[Path, Path], tmp_path: Path
) -> None:
    campaign, run = finished
    measured = positions(campaign / "frames.csv")
    errors = {}
    for nominal in (False, True):
        out = tmp_path / f"{nominal}.csv"
        predict_run(run, campaign / "poses.csv", out, nominal=nominal)
        found = positions(out)
        errors[nominal] = np.sqrt(np.mean([np.sum((found[p] - measured[p]) ** 2) for p in measured]))
    noise = 0.06 * np.sqrt(3)
    assert errors[False] < 1.15 * noise
    assert errors[True] > 10 * errors[False]


def write_rows(path: Path, header: list[str], rows: list[list[object]]) -> None:
    with path.open("w", newline="") as stream:
        writer = csv.writer(stream)
        writer.writerow(header)
        writer.writerows(rows)


def test_defaults_of_poses_to_predict(finished: tuple[Path, Path], tmp_path: Path) -> None:
    """Only pose and joint angles: no payload, approach 0."""
    _, run = finished
    header = ["pose", *(f"q{k}_deg" for k in range(1, 7))]
    write_rows(tmp_path / "p.csv", header, [["a", 0, 10, 20, 30, 40, 50], ["b", 0, 10, 20, 30, 40, 50]])
    predict_run(run, tmp_path / "p.csv", tmp_path / "o.csv")
    found = positions(tmp_path / "o.csv")
    np.testing.assert_array_equal(found["a"], found["b"])
    write_rows(tmp_path / "p.csv", [*header, "payload"], [["a", 0, 10, 20, 30, 40, 50, "dumbbell"]])
    predict_run(run, tmp_path / "p.csv", tmp_path / "o.csv")
    assert positions(tmp_path / "o.csv")["a"][2] < found["a"][2] - 0.1  # the load bends the arm


def test_commands_bring_the_predicted_tool_to_the_wanted_frame(finished: tuple[Path, Path], tmp_path: Path) -> None:
    campaign, run = finished
    predict_run(run, campaign / "poses.csv", tmp_path / "wanted.csv")
    done = compensate_run(run, tmp_path / "wanted.csv", tmp_path / "q.csv", CompensateOptions(skip_unreachable=True))
    assert done["frames"] > 0.9 * 80
    predict_run(run, tmp_path / "q.csv", tmp_path / "reached.csv")
    wanted, reached = positions(tmp_path / "wanted.csv"), positions(tmp_path / "reached.csv")
    worst = max(float(np.linalg.norm(reached[name] - wanted[name])) for name in reached)
    assert worst < 1e-3


def test_corrected_targets_make_the_nominal_robot_take_the_same_joint_angles(
    finished: tuple[Path, Path], tmp_path: Path
) -> None:
    campaign, run = finished
    predict_run(run, campaign / "poses.csv", tmp_path / "wanted.csv")
    compensate_run(run, tmp_path / "wanted.csv", tmp_path / "q.csv", CompensateOptions(skip_unreachable=True))
    compensate_run(
        run, tmp_path / "wanted.csv", tmp_path / "f.csv", CompensateOptions(as_frames=True, skip_unreachable=True)
    )
    targets = positions(tmp_path / "f.csv")
    wanted = positions(tmp_path / "wanted.csv")
    shift = [np.linalg.norm(targets[name] - wanted[name]) for name in targets]
    assert np.mean(shift) > 1.0  # an uncalibrated robot needs millimetres of correction


def test_an_unreachable_frame_is_named_with_its_reason(finished: tuple[Path, Path], tmp_path: Path) -> None:
    _, run = finished
    header = ["pose", "x_mm", "y_mm", "z_mm", "roll_deg", "pitch_deg", "yaw_deg"]
    write_rows(tmp_path / "w.csv", header, [["far", 9000, 0, 0, 0, 0, 0]])
    with pytest.raises(InvalidInput, match=r"cannot reach frame 'far'.*outside the workspace"):
        compensate_run(run, tmp_path / "w.csv", tmp_path / "q.csv")
    assert not (tmp_path / "q.csv").exists()
    write_rows(tmp_path / "w.csv", [*header, "payload"], [["far", 900, 0, 0, 0, 0, 0, "sack"]])
    with pytest.raises(InvalidInput, match="row 2: payload 'sack' is not known"):
        compensate_run(run, tmp_path / "w.csv", tmp_path / "q.csv")


def test_poses_beyond_the_ranges_are_predicted_with_a_warning(finished: tuple[Path, Path], tmp_path: Path) -> None:
    _, run = finished
    header = ["pose", *(f"q{k}_deg" for k in range(1, 7))]
    write_rows(tmp_path / "p.csv", header, [["a", 0, 10, 20, 30, 40, 50], ["b", 900, 10, 20, 30, 40, 50]])
    told = predict_run(run, tmp_path / "p.csv", tmp_path / "o.csv")
    (warning,) = told["warnings"]
    assert "p.csv, row 3" in warning
    assert "q1_deg = 900 deg lies outside" in warning
    assert predict_run(run, tmp_path / "p.csv", tmp_path / "n.csv", nominal=True)["poses"] == 2
