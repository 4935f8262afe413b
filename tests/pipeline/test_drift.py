"""Commands of the drift control: files in, state kept whatever happens, the robot in force out."""

import json
import os
import shutil
import signal
import sqlite3
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from pipeline.cli import app
from robcal.files.tables import read_table
from tests.drift.scenes import Scene, make_scene, write_readings, write_run
from tests.pipeline.browser import needs_browser, opened


@pytest.fixture(scope="module")
def scene() -> Scene:
    return make_scene(hours=2.0)


@pytest.fixture(scope="module")
def made(scene: Scene, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with run, reference, readings of ten cycles in parts, and a state that knows the reference alone."""
    folder = tmp_path_factory.mktemp("drift")
    write_run(folder / "run", scene.robot)
    write_readings(folder / "reference.csv", [scene.readings(0)])
    for k in range(1, 11):
        half = range(0, 24, 2) if k % 2 else range(1, 24, 2)
        write_readings(folder / f"c{k:02d}.csv", [scene.readings(k, rows=list(half))], angles=k > 2)
    result = call("init", folder / "run", "--readings", folder / "reference.csv", "--state", folder / "cell.drift")
    assert result["measurements"] == 24
    return folder


@pytest.fixture
def state(made: Path, tmp_path: Path) -> Path:
    return Path(shutil.copy(made / "cell.drift", tmp_path / "cell.drift"))


def call(*words: object) -> dict[str, Any]:
    result = CliRunner().invoke(app, ["drift", *map(str, words), "-q", "--json"])
    assert result.exit_code == 0, result.output
    return dict(json.loads(result.stdout.splitlines()[-1]))


def refused(*words: object) -> str:
    result = CliRunner().invoke(app, ["drift", *map(str, words), "-q", "--json"])
    assert result.exit_code == 1, result.output
    return str(json.loads(result.stdout.splitlines()[-1])["error"])


def content(state: Path) -> dict[str, list[tuple[Any, ...]]]:
    """Everything that must not depend on how it came in, without times of writing."""
    with sqlite3.connect(state) as connection:
        queries = {
            "readings": "select cycle, pose, target, time_s, content, use from drift_reading order by 1, 2, 3",
            "models": "select version, cycle, time_s, change, covariance from drift_model order by 1",
            "force": "select cycle, version, reason from drift_in_force order by id",
            "alarms": "select cycle, kind, text from drift_alarm order by id",
        }
        return {name: connection.execute(query).fetchall() for name, query in queries.items()}


def files(made: Path) -> list[Path]:
    return sorted(made.glob("c*.csv"))


def test_readings_in_parts_give_models(made: Path, state: Path, tmp_path: Path, scene: Scene) -> None:
    answers = [call("add", state, file) for file in files(made)]
    assert [a["models"] for a in answers] == [0, 1] * 5
    stand = call("status", state)
    assert {"cycle", "model_version", "parameters", "sigma", "residual_mm", "uncorrected_mm", "corrected_mm"} <= set(
        stand
    )
    assert (stand["cycle"], stand["model_version"], stand["alarms"], stand["rejected"]) == (10, 6, [], [])
    assert stand["corrected_mm"] < 0.05 < stand["uncorrected_mm"]
    assert set(stand["sigma"]) == set(stand["parameters"])
    # the robot in force is where the true one is, at the poses of the sphere
    write_poses(tmp_path / "poses.csv", scene)
    errors = {}
    for cycle in (0, 10):
        out = tmp_path / f"{cycle}.csv"
        words = ["predict", str(state), "--poses", str(tmp_path / "poses.csv"), "--out", str(out)]
        result = CliRunner().invoke(app, [*words, "--at-cycle", str(cycle), "-q"])
        assert result.exit_code == 0, result.output
        errors[cycle] = np.linalg.norm(positions(out) - true_positions(scene, 10), axis=1).mean()
    assert errors[10] < 5e-5 < 1e-4 < errors[0]


def write_poses(path: Path, scene: Scene) -> None:
    lines = ["pose," + ",".join(f"q{k + 1}_deg" for k in range(6))]
    lines += [f"p{i}," + ",".join(f"{v:.9f}" for v in np.degrees(q)) for i, q in enumerate(scene.q)]
    path.write_text("\n".join(lines) + "\n")


def positions(path: Path) -> np.ndarray:
    table = read_table(path)
    return np.column_stack([table.numbers(f"{n}_mm") for n in "xyz"]) / 1000


def true_positions(scene: Scene, cycle: int) -> np.ndarray:
    from fixtures.warming import warm_tool

    deviation = scene.warming.deviations(scene.true, scene.heat, np.full(len(scene.q), cycle))
    return warm_tool(scene.true, scene.q, deviation)[:, :3, 3]


def test_doubled_and_late_files_change_nothing(made: Path, state: Path) -> None:
    first = files(made)[:4]
    for file in first:
        call("add", state, file)
    before = content(state)
    for file in (first[3], first[0]):
        assert call("add", state, file)["added"] == 0
    assert content(state) == before
    late = call("add", state, made / "c07.csv")
    assert late["added"] == 12
    assert call("add", state, made / "c05.csv")["added"] == 12  # older, but of the tour that is open
    assert call("status", state)["alarms"] == []


def test_a_reading_with_other_values_is_refused_as_a_whole(made: Path, state: Path, tmp_path: Path) -> None:
    call("add", state, made / "c01.csv")
    before = content(state)
    text = (made / "c01.csv").read_text().splitlines()
    fields = text[3].split(",")
    text[3] = ",".join([*fields[:4], "999.0", *fields[5:]])
    (tmp_path / "other.csv").write_text("\n".join(text) + "\n")
    assert "row 4: cycle 1, pose 'p4'" in refused("add", state, tmp_path / "other.csv")
    assert content(state) == before


@pytest.mark.parametrize(
    ("line", "value", "said"),
    [
        (0, "cycle,time_s,pose,target,x_mm,y_mm", "column 'z_mm' is missing"),
        (1, "1,360,p0,99,0,0,100", "target 99 is not in the reference"),
        (1, "1,360,p0,nan,0,0,100", "row 2: target is missing"),
        (1, "1,360,p0,1,0,0,90000", "row 2: a target 90 m off the sensor"),
        (1, "1.5,360,p0,1,0,0,100", "it must be a whole number"),
    ],
)
def test_bad_readings_are_told_with_their_row(state: Path, tmp_path: Path, line: int, value: str, said: str) -> None:
    rows = ["cycle,time_s,pose,target,x_mm,y_mm,z_mm", "1,360,p0,1,0,0,100"]
    rows[line] = value
    rows = [",".join(row.split(",")[: len(rows[0].split(","))]) for row in rows]
    (tmp_path / "bad.csv").write_text("\n".join(rows) + "\n")
    assert said in refused("add", state, tmp_path / "bad.csv")


def test_killed_at_any_moment_nothing_is_lost_or_doubled(made: Path, state: Path, tmp_path: Path) -> None:
    whole = Path(shutil.copy(state, tmp_path / "whole.drift"))
    for file in files(made)[:2]:
        call("add", whole, file)
    rng = np.random.default_rng(3)
    environment = {**os.environ, "PYTHONDONTWRITEBYTECODE": "1"}
    for file in files(made)[:2]:
        words = [sys.executable, "-m", "pipeline", "drift", "add", str(state), str(file), "-q"]
        process = subprocess.Popen(words, env=environment)
        time.sleep(float(rng.uniform(0.6, 1.6)))
        process.send_signal(signal.SIGKILL)
        process.wait()
        call("add", state, file)
    assert content(state) == content(whole)


def test_locked_gone_or_foreign_states_are_told(made: Path, state: Path, tmp_path: Path, monkeypatch: Any) -> None:
    monkeypatch.setattr("pipeline.drift.database.LOCK_SECONDS", 0.1)
    holder = sqlite3.connect(state, isolation_level=None)
    holder.execute("BEGIN IMMEDIATE")
    assert "another process works with it" in refused("add", state, made / "c01.csv")
    holder.execute("ROLLBACK")
    holder.close()
    assert "there is no such state" in refused("add", tmp_path / "none.drift", made / "c01.csv")
    (tmp_path / "text.drift").write_text("no database " * 100)
    assert "no state of a drift control" in refused("status", tmp_path / "text.drift")


def test_a_server_that_does_not_answer_is_told() -> None:
    pytest.importorskip("psycopg")
    assert "does not answer" in refused("status", "postgresql://nobody@127.0.0.1:1/none")


def test_a_driver_that_is_not_installed_is_told(monkeypatch: Any) -> None:
    monkeypatch.setitem(sys.modules, "psycopg", None)
    assert "install robcal[postgresql]" in refused("status", "postgresql://nobody@127.0.0.1:1/none")


def test_full_disk_is_told_and_takes_nothing_in(made: Path, state: Path) -> None:
    import sqlalchemy as sa

    before = content(state)

    def small(connection: Any, _: Any) -> None:
        connection.execute("PRAGMA max_page_count = 1")

    sa.event.listen(sa.engine.Engine, "connect", small)
    try:
        assert "the disk is full" in refused("add", state, made / "c01.csv")
    finally:
        sa.event.remove(sa.engine.Engine, "connect", small)
    assert content(state) == before
    assert call("add", state, made / "c01.csv")["added"] == 12


def test_watch_takes_each_file_once_and_goes_on_after_a_bad_one(made: Path, state: Path, tmp_path: Path) -> None:
    box = tmp_path / "box"
    box.mkdir()
    for file in files(made)[:3]:
        shutil.copy(file, box)
    (box / "c00_bad.csv").write_text("cycle\n1\n")
    first = call("watch", state, box, "--once")
    assert (first["files"], len(first["refused"])) == (3, 1)
    assert call("watch", state, box, "--once")["files"] == 0


def test_rollback_puts_an_earlier_model_in_force(made: Path, state: Path) -> None:
    for file in files(made)[:6]:
        call("add", state, file)
    newest = call("status", state)
    assert newest["model_version"] == 4
    call("rollback", state, "--to", 2)
    assert call("status", state)["model_version"] == 2
    assert "versions go from 1 to 4" in refused("rollback", state, "--to", 9)
    for file in files(made)[6:8]:
        call("add", state, file)
    assert call("status", state)["model_version"] == 5


def test_a_state_is_not_begun_twice_nor_without_a_run(made: Path, state: Path, tmp_path: Path) -> None:
    reference = made / "reference.csv"
    assert "holds a drift control already" in refused("init", made / "run", "--readings", reference, "--state", state)
    new = tmp_path / "new.drift"
    assert "is not a run folder" in refused("init", tmp_path, "--readings", reference, "--state", new)
    assert "has no joint angles" in refused("init", made / "run", "--readings", made / "c01.csv", "--state", new)
    assert "no parameter 'axis7.x'" in refused(
        "init", made / "run", "--readings", reference, "--state", new, "--parameters", "axis7.x"
    )
    assert not new.exists()


@pytest.mark.browser
@needs_browser
def test_the_page_opens_in_a_browser(made: Path, state: Path, tmp_path: Path) -> None:
    for file in files(made):
        call("add", state, file)
    page_file = tmp_path / "drift.html"
    call("status", state, "--page", page_file)
    page = opened(page_file)
    assert page["problems"] == page["outside"] == []
    assert int(page["plots"]) == int(page["drawn"]) == page["shown"] == 3
    assert "5 tours" in page["text"]
