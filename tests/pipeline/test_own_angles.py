"""Readings that state their own joint angles are at these, whatever the table of poses says."""

from pathlib import Path

import numpy as np
import pytest

from fixtures.campaigns import write_table
from fixtures.instruments import Watcher, watch, write_watched
from fixtures.plan import Plan
from pipeline.campaign_reader import read_campaign
from robcal.errors import InvalidInput
from robcal.files.tables import read_table


def _campaign(folder: Path, turned: dict[int, float], **columns: list) -> Path:
    """Two trackers, 8 poses; readings of the first state their angles, some turned about axis 1 (deg)."""
    made = watch(Plan(seed=5, poses=6, verify=2, kept_out=2), {"a": Watcher(), "b": Watcher()})
    write_watched(folder, made)
    poses = read_table(folder / "poses.csv")
    table = {name: list(cells) for name, cells in read_table(folder / "a.csv").columns.items()}
    for k in range(1, 7):
        table[f"q{k}_deg"] = poses.numbers(f"q{k}_deg").tolist()
    for row, angle in turned.items():
        table["q1_deg"][row] += angle
    write_table(folder / "a.csv", table | columns)
    return folder


def test_angles_of_the_pose_change_nothing(tmp_path: Path) -> None:
    campaign = read_campaign(_campaign(tmp_path, {}))
    assert campaign.poses is not None
    assert len(campaign.poses) == 8


def test_readings_at_other_angles_are_a_pose_of_their_own(tmp_path: Path) -> None:
    plain = read_campaign(_campaign(tmp_path / "plain", {})).poses
    campaign = read_campaign(_campaign(tmp_path / "own", {2: 0.5, 5: -1.0}))
    log = campaign.poses
    assert plain is not None
    assert log is not None
    assert len(log) == 10
    assert log.names[2:4] == (plain.names[2], f"{plain.names[2]}#2")
    a, b = (campaign.instruments[name].tables[0] for name in "ab")
    assert np.allclose(np.degrees(log.q[a.pose] - plain.q)[:, 0], [0, 0, 0.5, 0, 0, -1.0, 0, 0], atol=1e-9)
    assert np.allclose(log.q[b.pose], plain.q)
    assert log.verify[a.pose].tolist() == plain.verify.tolist()
    assert [log.payload[k] for k in a.pose] == list(plain.payload)
    assert any("10 poses in place of 8" in note for note in campaign.notes)


def test_a_pose_whose_readings_all_state_others_gets_these(tmp_path: Path) -> None:
    folder = _campaign(tmp_path, {2: 0.5})
    table = {name: list(cells) for name, cells in read_table(folder / "b.csv").columns.items()}
    write_table(folder / "b.csv", {name: cells[:2] + cells[3:] for name, cells in table.items()})
    log = read_campaign(folder).poses
    assert log is not None
    assert len(log) == 8
    stated = read_table(folder / "poses.csv").numbers("q1_deg")
    assert np.degrees(log.q[2, 0]) - stated[2] == pytest.approx(0.5)


@pytest.mark.parametrize(
    ("columns", "sentence"),
    [
        ({"q3_deg": ["x"] * 8}, r"instrument 'a': .*a\.csv, row 2: q3_deg is 'x'"),
        ({"q2_deg": [170.0] * 8}, r"a\.csv, row 2: q2_deg = 170 lies outside the range of axis2: correct the angle"),
    ],
)
def test_impossible_angles_are_refused(tmp_path: Path, columns: dict, sentence: str) -> None:
    with pytest.raises(InvalidInput, match=sentence):
        read_campaign(_campaign(tmp_path, {}, **columns))


def test_angles_of_some_joints_only_are_refused(tmp_path: Path) -> None:
    folder = _campaign(tmp_path, {})
    table = {name: list(cells) for name, cells in read_table(folder / "a.csv").columns.items()}
    write_table(folder / "a.csv", {name: cells for name, cells in table.items() if name != "q4_deg"})
    with pytest.raises(InvalidInput, match=r"a\.csv.*'q4_deg' is missing"):
        read_campaign(folder)
