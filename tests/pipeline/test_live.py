"""`pipeline live`: a campaign over TCP; a connection torn at any byte loses and doubles nothing."""

import csv
import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from fixtures.live_simulator import LiveSimulator, seen
from pipeline.campaign_reader import read_campaign
from pipeline.cli import app
from pipeline.live.link import NoAnswer, Pace
from pipeline.live.session import measure_live
from robcal.errors import InvalidInput

ROBOT = Path("configs/robots/kr150_class.yaml")
Q = np.array([[10.0, -20.0, 30.0, 5.0, 25.0, -8.0], [-15.0, -30.0, 60.0, 40.0, 20.0, 70.0], [0, -10, 20, 1, 2, 3]])
FAST = Pace(answer=5.0, again=0.0, tries=4, poll=0.0, still=0.0, move=5.0)


@pytest.fixture
def plan(tmp_path: Path) -> Path:
    path = tmp_path / "plan.csv"
    rows = [",".join(["pose", *(f"q{k}_deg" for k in range(1, 7)), "set"])]
    rows += [",".join([f"p{k}", *map(repr, q.tolist()), "verify" if k == 2 else "identify"]) for k, q in enumerate(Q)]
    path.write_text("\n".join(rows) + "\n")
    return path


def check(out: Path) -> None:
    """Every pose once, measured where it stands in the table."""
    with (out / "poses.csv").open() as stream:
        poses = list(csv.DictReader(stream))
    with (out / "frames.csv").open() as stream:
        frames = list(csv.DictReader(stream))
    assert [row["pose"] for row in poses] == [row["pose"] for row in frames] == ["p0", "p1", "p2"]
    assert [row["set"] for row in poses] == ["identify", "identify", "verify"]
    for pose, frame, q in zip(poses, frames, Q, strict=True):
        driven = np.array([float(pose[f"q{k}_deg"]) for k in range(1, 7)])
        assert driven == pytest.approx(q, abs=0.01)
        six = [float(frame[n]) for n in ("x_mm", "y_mm", "z_mm", "roll_deg", "pitch_deg", "yaw_deg")]
        assert six == pytest.approx(seen(driven), abs=0.3)


def test_a_campaign_is_measured(plan: Path, tmp_path: Path) -> None:
    with LiveSimulator() as simulator:
        answer = measure_live(plan, ROBOT, tmp_path / "campaign", simulator.address, pace=FAST)
    assert answer["poses"] == 3
    assert simulator.moves == simulator.measured == ["p0", "p1", "p2"]
    check(tmp_path / "campaign")
    assert read_campaign(tmp_path / "campaign").name == "campaign"


@pytest.mark.parametrize("pieces", [12, pytest.param(400, marks=pytest.mark.slow)])
def test_a_connection_torn_at_any_byte_loses_and_doubles_nothing(plan: Path, tmp_path: Path, pieces: int) -> None:
    with LiveSimulator() as simulator:
        measure_live(plan, ROBOT, tmp_path / "whole", simulator.address, pace=FAST)
    total = simulator.traffic
    assert total > 500
    for at in range(1, total, max(1, total // pieces)):
        out = tmp_path / f"torn{at}"
        with LiveSimulator(tears=(at, at // 2)) as simulator:
            measure_live(plan, ROBOT, out, simulator.address, pace=FAST)
        check(out)


def test_a_session_goes_on_where_it_was_interrupted(plan: Path, tmp_path: Path) -> None:
    out = tmp_path / "campaign"
    with LiveSimulator(tears=(1000, *[0] * 20)) as simulator, pytest.raises(NoAnswer, match="goes on from there"):
        measure_live(plan, ROBOT, out, simulator.address, pace=FAST)
    assert not (out / "campaign.yaml").exists()
    known = len((out / "live.jsonl").read_text().splitlines()) - 1
    assert known >= 1
    with (out / "live.jsonl").open("a") as stream:
        stream.write('{"pose": "p1", "time')  # killed while it wrote
    with LiveSimulator() as simulator:
        answer = measure_live(plan, ROBOT, out, simulator.address, pace=FAST)
    assert answer["resumed"] == known
    assert simulator.measured == [f"p{k}" for k in range(known, 3)]
    check(out)
    lines = [json.loads(line) for line in (out / "live.jsonl").read_text().splitlines()]
    assert [line["pose"] for line in lines[1:]] == ["p0", "p1", "p2"]


def test_a_journal_of_other_poses_is_not_mixed(plan: Path, tmp_path: Path) -> None:
    out = tmp_path / "campaign"
    with LiveSimulator() as simulator:
        measure_live(plan, ROBOT, out, simulator.address, pace=FAST)
        plan.write_text(plan.read_text().replace("10.0", "11.0", 1))
        with pytest.raises(InvalidInput, match="belongs to other poses"):
            measure_live(plan, ROBOT, out, simulator.address, pace=FAST)


def test_poses_beyond_the_limits_are_not_driven_to(plan: Path, tmp_path: Path) -> None:
    plan.write_text(plan.read_text().replace("10.0", "999.0", 1))
    with LiveSimulator() as simulator:
        with pytest.raises(InvalidInput):
            measure_live(plan, ROBOT, tmp_path / "campaign", simulator.address, pace=FAST)
        assert simulator.moves == []


def test_a_robot_that_stands_elsewhere_is_told(plan: Path, tmp_path: Path) -> None:
    pace = Pace(answer=5.0, again=0.0, tries=2, poll=0.0, still=0.0, move=0.2)
    with LiveSimulator(steps=100_000) as simulator, pytest.raises(InvalidInput, match=r"stands|come to a stop"):
        measure_live(plan, ROBOT, tmp_path / "campaign", simulator.address, pace=pace)


@pytest.mark.parametrize("address", ["somewhere", "host:0", ":80", "host:http"])
def test_bad_addresses_are_told(plan: Path, tmp_path: Path, address: str) -> None:
    result = CliRunner().invoke(
        app, ["live", str(plan), "--robot", str(ROBOT), "--controller", address, "--out", str(tmp_path / "c")]
    )
    assert result.exit_code == 1
    assert "is HOST:PORT" in result.output


class OtherController(LiveSimulator):
    def _answer(self, words: list[str]) -> bytes:
        return b"AT 1 2 3\n" if words[0] == "WHERE" else super()._answer(words)


def test_another_language_is_told(plan: Path, tmp_path: Path) -> None:
    with OtherController() as simulator, pytest.raises(InvalidInput, match="7 numbers were expected"):
        measure_live(plan, ROBOT, tmp_path / "campaign", simulator.address, pace=FAST)
