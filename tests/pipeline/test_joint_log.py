"""Faults of the joint log are named, with the fit after mending as proof."""

import math
from collections.abc import Callable
from pathlib import Path

import pytest

from fixtures.campaigns import make_campaign
from pipeline.runner import run_campaign
from robcal.errors import InvalidInput, NotIdentifiable, RobcalError
from tests.pipeline.conftest import Rows, edit_rows, edit_yaml

JOINTS = [f"q{k}_deg" for k in range(1, 7)]


def radians(rows: Rows) -> None:
    for row in rows:
        row.update({name: str(math.radians(float(row[name]))) for name in JOINTS})


def slipped(rows: Rows) -> None:
    values = [[row[name] for name in JOINTS] for row in rows]
    for row, value in zip(rows, [*values[1:], values[0]], strict=True):
        row.update(zip(JOINTS, value, strict=True))


def wrong_sign(rows: Rows) -> None:
    for row in rows:
        row["q5_deg"] = str(-float(row["q5_deg"]))


def exchanged(rows: Rows) -> None:
    for row in rows:
        row["q4_deg"], row["q6_deg"] = row["q6_deg"], row["q4_deg"]


@pytest.mark.parametrize(
    ("fault", "words"),
    [
        (radians, ["wrong unit", "write degrees"]),
        (slipped, ["slipped by 1 row"]),
        (wrong_sign, ["axis5", "wrong sign", "change 'sign'"]),
        (exchanged, ["joints 4 and 6 are exchanged"]),
    ],
)
def test_fault_is_named_with_proof(
    frame_campaign: Path, tmp_path: Path, fault: Callable[[Rows], None], words: list[str]
) -> None:
    edit_rows(frame_campaign / "poses.csv", fault)
    with pytest.raises(InvalidInput) as error:
        run_campaign(frame_campaign, tmp_path / "run", until="identify")
    told = str(error.value)
    for word in ["poses.csv", "do not belong together", *words]:
        assert word in told


def wrong_sign_beyond_limits(rows: Rows) -> None:
    for row in rows:
        row["q2_deg"] = str(-float(row["q2_deg"]))


def exchanged_beyond_limits(rows: Rows) -> None:
    for row in rows:
        row["q1_deg"], row["q2_deg"] = row["q2_deg"], row["q1_deg"]


@pytest.mark.parametrize(
    ("fault", "words"),
    [
        (wrong_sign_beyond_limits, "joint 2 (axis2) is counted with the wrong sign"),
        (exchanged_beyond_limits, "the columns of joints 1 and 2 are exchanged"),
    ],
)
def test_a_slip_that_leaves_the_ranges_is_named_as_well(
    frame_campaign: Path, tmp_path: Path, fault: Callable[[Rows], None], words: str
) -> None:
    edit_rows(frame_campaign / "poses.csv", fault)
    with pytest.raises(InvalidInput, match="outside the range") as error:
        run_campaign(frame_campaign, tmp_path / "run", until="identify")
    assert f"a likely cause: {words}" in str(error.value) or f"a likely cause: the {words}" in str(error.value)
    assert "correcting it lowers the residual" in str(error.value)


def test_a_small_slip_is_looked_for_where_the_fit_fails(tmp_path: Path) -> None:
    """A draw-wire hardly notices the last joint: its wrong sign moves the end by less than robots are off."""
    make_campaign(tmp_path / "campaign", seed=5, level="distances", poses=110, verify=12)

    def change(rows: Rows) -> None:
        for row in rows:
            row["q6_deg"] = str(-float(row["q6_deg"]))

    edit_rows(tmp_path / "campaign" / "poses.csv", change)
    with pytest.raises(InvalidInput, match=r"axis6.*wrong sign.*correcting it lowers"):
        run_campaign(tmp_path / "campaign", tmp_path / "run", until="identify")


def test_a_log_of_another_recording_is_refused(frame_campaign: Path, tmp_path: Path) -> None:
    kept = range(0, 48, 2)

    def only_the_first_joint(rows: Rows) -> Rows:
        return [rows[k] | {name: rows[0][name] for name in JOINTS[1:]} for k in kept]

    edit_rows(frame_campaign / "poses.csv", only_the_first_joint)
    edit_rows(frame_campaign / "frames.csv", lambda rows: [rows[k] for k in kept])
    with pytest.raises(InvalidInput, match=r"even the identified robot misses .* no single fault"):
        run_campaign(frame_campaign, tmp_path / "run", until="identify")


def test_distances_in_metres(tmp_path: Path) -> None:
    make_campaign(tmp_path / "campaign", seed=5, level="distances", poses=60, verify=6)

    def metres(rows: Rows) -> None:
        for row in rows:
            row["distance_mm"] = str(float(row["distance_mm"]) / 1000)

    edit_rows(tmp_path / "campaign" / "distances.csv", metres)
    with pytest.raises(InvalidInput, match="must be in millimetres"):
        run_campaign(tmp_path / "campaign", tmp_path / "run", until="identify")


def test_two_poses_are_too_few_and_nothing_else_is_suspected(frame_campaign: Path, tmp_path: Path) -> None:
    kept: set[str] = set()

    def two(rows: Rows) -> Rows:
        kept.update(row["pose"] for row in rows[:2])
        return rows[:2]

    edit_rows(frame_campaign / "poses.csv", two)
    edit_rows(frame_campaign / "frames.csv", lambda rows: [row for row in rows if row["pose"] in kept])
    edit_rows(frame_campaign / "poses.csv", lambda rows: [{**row, "set": "identify"} for row in rows])
    with pytest.raises(NotIdentifiable, match="measure"):
        run_campaign(frame_campaign, tmp_path / "run", until="identify")


def test_a_sound_log_passes(frame_campaign: Path, tmp_path: Path) -> None:
    done = run_campaign(frame_campaign, tmp_path / "run", until="identify")
    assert done.ran == ("identify",)


def test_metres_under_a_heading_of_millimetres(frame_campaign: Path, tmp_path: Path) -> None:
    def metres(rows: Rows) -> None:
        for row in rows:
            row.update({n: str(float(row[n]) / 1000) for n in ("x_mm", "y_mm", "z_mm")})

    edit_rows(frame_campaign / "frames.csv", metres)
    with pytest.raises(InvalidInput, match="must be in millimetres"):
        run_campaign(frame_campaign, tmp_path / "run", until="identify")


def test_fewer_poses_than_parameters(frame_campaign: Path, tmp_path: Path) -> None:
    edit_rows(frame_campaign / "poses.csv", lambda rows: rows[:4])
    edit_rows(frame_campaign / "frames.csv", lambda rows: rows[:4])
    with pytest.raises(NotIdentifiable, match="measure more poses or choose fewer parameters"):
        run_campaign(frame_campaign, tmp_path / "run", until="identify")


def test_all_poses_alike(frame_campaign: Path, tmp_path: Path) -> None:
    def alike(rows: Rows) -> None:
        for row in rows:
            row.update({name: rows[0][name] for name in row if name not in ("pose", "set")})

    for name in ("poses.csv", "frames.csv"):
        edit_rows(frame_campaign / name, alike)
    with pytest.raises(RobcalError) as error:
        run_campaign(frame_campaign, tmp_path / "run", until="identify")
    assert "internal error" not in str(error.value)


def test_unknown_parameter_name(frame_campaign: Path, tmp_path: Path) -> None:
    edit_yaml(frame_campaign / "campaign.yaml", lambda d: d.update(model={"parameters": ["axis2.pich"]}))
    with pytest.raises(InvalidInput, match=r"axis2\.pich"):
        run_campaign(frame_campaign, tmp_path / "run", until="identify")


def metres(rows: Rows) -> None:
    for row in rows:
        row.update({name: str(float(row[name]) / 1000) for name in ("x_mm", "y_mm", "z_mm")})


def mirror(rows: Rows) -> None:
    for row in rows:
        row["x_mm"], row["y_mm"] = row["y_mm"], row["x_mm"]


@pytest.mark.parametrize(("fault", "words"), [(metres, ["0.001 times", "millimetres"]), (mirror, ["mirror image"])])
def test_faults_of_all_points(
    point_campaign: Path, tmp_path: Path, fault: Callable[[Rows], None], words: list[str]
) -> None:
    edit_rows(point_campaign / "points.csv", fault)
    with pytest.raises(InvalidInput) as error:
        run_campaign(point_campaign, tmp_path / "run", until="identify")
    assert "points.csv" in str(error.value)
    for word in words:
        assert word in str(error.value)
