"""Raw readings of laser sensors: calibrated from a file, in a campaign, and refused in one sentence."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import yaml

from fixtures.campaigns import write_table, write_yaml
from fixtures.laser_sensors import raw
from pipeline.campaign_reader import read_campaign
from pipeline.laser_sensors import calibrate_from, points_from
from robcal.errors import InvalidInput, RobcalError
from robcal.files.tables import read_table

BODY = Path(__file__).parents[2] / "configs" / "bodies" / "sphere_200.yaml"
ROBOT = BODY.parents[1] / "robots" / "kr150_class.yaml"
COLUMNS = {"spot": ("u_px", "x_px", "y_px"), "point": ("u_px",)}


def _moved(path: Path, kind: str, count: int = 40, **columns: list) -> Path:
    """Readings of a target that was moved to known places."""
    rng = np.random.default_rng(7)
    p = rng.uniform([-0.03, -0.03, 0.15], [0.03, 0.03, 0.25], (count, 3))
    readings = raw(kind, p, 0.1, rng)
    table = {name: readings[:, k].tolist() for k, name in enumerate(COLUMNS[kind])}
    table |= {f"{axis}_mm": (1e3 * p[:, k]).tolist() for k, axis in enumerate("xyz")}
    write_table(path, table | columns)
    return path


def _campaign(folder: Path, kind: str, **columns: list) -> tuple[Path, np.ndarray]:
    """A campaign of five readings of a sensor in the hand, and the true points in it."""
    calibrate_from(_moved(folder / "moved.csv", kind), kind, folder / "sensor.yaml", 0.5)
    rng = np.random.default_rng(8)
    ids = [t["id"] for t in yaml.safe_load(BODY.read_text())["targets"]][:5]
    p = rng.uniform([-0.01, -0.01, 0.18], [0.01, 0.01, 0.22], (5, 3))
    readings = raw(kind, p, 0.1, rng)
    names = [f"p{k}" for k in range(5)]
    write_table(folder / "poses.csv", {"pose": names, **{f"q{k}_deg": [10.0 * k] * 5 for k in range(1, 7)}})
    table = {"pose": names, "target": ids, "cycle": [0] * 5}
    table |= {name: readings[:, k].tolist() for k, name in enumerate(COLUMNS[kind])}
    write_table(folder / "raw.csv", table | columns)
    eye = {"measurements": {"file": "raw.csv", "sensor": "sensor.yaml"}, "mounted": "hand", "body": "sphere"}
    content = {
        "format": "robcal/campaign-1",
        "name": "raw",
        "robot": str(ROBOT),
        "poses": "poses.csv",
        "bodies": {"sphere": {"targets": str(BODY)}},
        "instruments": {"eye": eye},
    }
    write_yaml(folder / "campaign.yaml", content)
    return folder, p


@pytest.mark.parametrize("kind", ["spot", "point"])
def test_raw_readings_of_a_campaign_are_points_in_the_sensor(tmp_path: Path, kind: str) -> None:
    folder, p = _campaign(tmp_path, kind)
    (table,) = read_campaign(folder).instruments["eye"].tables
    assert table.kind == "sensor_points"
    assert table.covariance is not None
    told = [0, 1, 2] if kind == "spot" else [2]
    sigma = np.sqrt(table.covariance[:, told, told])
    assert np.all(np.abs(table.values - p)[:, told] < 4.5 * sigma)
    assert np.all(sigma < 1e-4)
    assert table.shared is not None
    assert np.all(np.diagonal(table.covariance - table.shared.noise, axis1=1, axis2=2)[:, told] > 0)


def test_points_are_written_with_their_covariance(tmp_path: Path) -> None:
    folder, p = _campaign(tmp_path, "spot")
    answer = points_from(folder / "raw.csv", folder / "sensor.yaml", folder / "points.csv")
    assert answer["points"] == 5
    table = read_table(folder / "points.csv")
    assert np.allclose(np.column_stack([table.numbers(f"{a}_mm") for a in "xyz"]) / 1e3, p, atol=2e-4)
    assert np.all(table.numbers("szz_mm2") > 0)


@pytest.mark.parametrize(
    ("columns", "sentence"),
    [
        (
            {"u_px": [9e4] * 5},
            r"raw\.csv, row 2: the reading \(u_px = 90000, .*lies beyond those of the sensor's calib",
        ),
        ({"x_px": ["wide"] * 5}, r"raw\.csv, row 2: x_px is 'wide'"),
        ({"pose": ["q0"] * 5}, r"raw\.csv, row 2: pose 'q0' is not in the table of poses"),
        ({"target": ["a"] * 5}, r"raw\.csv, row 2: target 'a' is not a whole number"),
    ],
)
def test_impossible_readings_are_refused(tmp_path: Path, columns: dict, sentence: str) -> None:
    folder, _ = _campaign(tmp_path, "spot", **columns)
    with pytest.raises(InvalidInput, match=sentence):
        read_campaign(folder)


def test_a_reading_that_stands_twice_is_refused(tmp_path: Path) -> None:
    folder, _ = _campaign(tmp_path, "spot")
    lines = (folder / "raw.csv").read_text().splitlines()
    (folder / "raw.csv").write_text("\n".join([*lines, lines[1]]) + "\n")
    with pytest.raises(InvalidInput, match=r"raw\.csv, row 7"):
        read_campaign(folder)


@pytest.mark.parametrize(
    ("old", "new", "sentence"),
    [
        ("kind: spot", "kind: section", r"sensor\.yaml, line \d+: numbers of a sensor of kind 'section' are g0"),
        ("kind: spot", "kind: sonar", r"sensor\.yaml, line \d+: kind: must be 'point', 'section', 'spot' or 'axial'"),
        ("format: robcal/sensor-1", "format: robcal/robot-1", r"sensor\.yaml: 'format' is 'robcal/robot-1'"),
        ("H_m:", "G_m:", r"sensor\.yaml, line \d+: numbers of a sensor of kind 'spot' are H_m"),
    ],
)
def test_faulty_sensor_files_are_refused(tmp_path: Path, old: str, new: str, sentence: str) -> None:
    folder, _ = _campaign(tmp_path, "spot")
    text = (folder / "sensor.yaml").read_text()
    assert old in text
    (folder / "sensor.yaml").write_text(text.replace(old, new))
    with pytest.raises(InvalidInput, match=sentence):
        read_campaign(folder)


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"z_mm": [-200.0] * 40}, r"moved\.csv, row 2: z_mm = -200 lies behind the sensor"),
        ({"z_mm": [200.0] * 40}, r"moved\.csv: the places (lie in a plane|do not differ)"),
        ({"u_px": [3.0] * 40}, r"moved\.csv: the readings of u_px are all the same"),
    ],
)
def test_faulty_calibrations_are_refused(tmp_path: Path, change: dict, sentence: str) -> None:
    with pytest.raises(RobcalError, match=sentence):
        calibrate_from(_moved(tmp_path / "moved.csv", "spot", **change), "spot", tmp_path / "out.yaml", 0.0)
    assert not (tmp_path / "out.yaml").exists()


def test_a_sensor_that_tells_depth_alone_needs_an_aim(tmp_path: Path) -> None:
    with pytest.raises(InvalidInput, match=r"moved\.csv: .*state how far beside the target it may look \(aim_mm\)"):
        calibrate_from(_moved(tmp_path / "moved.csv", "point"), "point", tmp_path / "out.yaml", 0.0)


def test_a_table_of_two_systems_is_refused(tmp_path: Path) -> None:
    folder, _ = _campaign(tmp_path, "spot")
    text = (folder / "campaign.yaml").read_text()
    (folder / "campaign.yaml").write_text(text.replace("sensor: sensor.yaml", "sensor: s.yaml, line_cameras: l.yaml"))
    if "line_cameras" not in (folder / "campaign.yaml").read_text():
        pytest.fail("the campaign does not state a sensor in place")
    with pytest.raises(InvalidInput, match="state one of them"):
        read_campaign(folder)
