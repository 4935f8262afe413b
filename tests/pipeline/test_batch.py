"""Many campaigns: batch on cores and on a Dask cluster, fleet, history."""

import json
import os
import signal
import threading
import time
from pathlib import Path

import pytest
import sqlalchemy as sa
from typer.testing import CliRunner

from fixtures.campaigns import make_campaign
from pipeline import history
from pipeline.batch import campaigns_in, run_batch, without_times
from pipeline.cli import app
from robcal.errors import InvalidInput
from tests.pipeline.conftest import edit_yaml

runner = CliRunner()


def make_fleet(folder: Path, count: int, poses: int = 30) -> Path:
    for k in range(count):
        campaign = folder / f"supplier{k % 2}" / f"robot{k}"
        make_campaign(campaign, seed=100 + k, level="frames", poses=poses, verify=6)
        edit_yaml(campaign / "campaign.yaml", lambda d: d.update(diagnosis={"enabled": False}))
    return folder


@pytest.fixture(scope="module")
def campaigns(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_fleet(tmp_path_factory.mktemp("fleet"), 3)


@pytest.fixture(scope="module")
def runs(campaigns: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("runs")
    run_batch(campaigns, out, workers=1)
    return out


def results(out: Path) -> dict[str, bytes]:
    found = {}
    for path in sorted(out.rglob("result.json")):
        data = without_times(json.loads(path.read_text()))
        found[path.parent.relative_to(out).as_posix()] = json.dumps(data).encode()
    return found


@pytest.mark.slow
def test_one_process_after_the_other_gives_the_same_bytes_as_two_at_once(
    campaigns: Path, runs: Path, tmp_path: Path
) -> None:
    run_batch(campaigns, tmp_path / "two", workers=2)
    assert results(tmp_path / "two") == results(runs)
    assert (tmp_path / "two" / "batch.json").read_bytes() == (runs / "batch.json").read_bytes()


def test_a_campaign_that_fails_leaves_the_others_done(campaigns: Path, tmp_path: Path) -> None:
    (tmp_path / "in").mkdir()
    for k, name in enumerate(("good", "bad")):
        source = campaigns / f"supplier{k}" / f"robot{k}"
        (tmp_path / "in" / name).mkdir()
        for file in source.iterdir():
            (tmp_path / "in" / name / file.name).write_bytes(file.read_bytes())
    (tmp_path / "in" / "bad" / "poses.csv").write_text("pose\n")
    result = runner.invoke(app, ["batch", str(tmp_path / "in"), "--out", str(tmp_path / "out"), "--workers", "1", "-q"])
    assert result.exit_code == 1
    assert "1 of 2 campaigns gave no result" in result.output
    entries = json.loads((tmp_path / "out" / "batch.json").read_text())["campaigns"]
    assert entries["good"]["error"] is None
    assert "poses.csv" in entries["bad"]["error"]


def test_bad_places_are_told(tmp_path: Path, campaigns: Path) -> None:
    with pytest.raises(InvalidInput, match="holds no campaign"):
        campaigns_in(tmp_path, tmp_path / "runs")
    with pytest.raises(InvalidInput, match="is no folder"):
        campaigns_in(tmp_path / "missing", tmp_path / "runs")
    with pytest.raises(InvalidInput, match="lies within a campaign"):
        campaigns_in(campaigns, campaigns / "supplier0" / "robot0" / "runs")
    result = runner.invoke(app, ["batch", str(campaigns), "--workers", "2", "--cluster", "tcp://127.0.0.1:9"])
    assert result.exit_code == 2
    assert "exclude each other" in result.output


@pytest.mark.slow
def test_a_cluster_that_is_not_there_is_told(tmp_path: Path, campaigns: Path) -> None:
    with pytest.raises(InvalidInput, match="no Dask scheduler answers"):
        run_batch(campaigns, tmp_path / "r", cluster="tcp://127.0.0.1:9")


def test_runs_are_listed_in_the_order_of_their_names(runs: Path) -> None:
    names = ["supplier0/robot0", "supplier0/robot2", "supplier1/robot1"]
    assert list(json.loads((runs / "batch.json").read_text())["campaigns"]) == names


@pytest.mark.slow
def test_a_cluster_that_loses_a_worker_loses_nothing(campaigns: Path, runs: Path, tmp_path: Path) -> None:
    """A real scheduler and two workers on loopback; one is killed while it works."""
    distributed = pytest.importorskip("distributed")
    out = tmp_path / "cluster"
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None, host="127.0.0.1"
    ) as cluster:
        victim = next(iter(cluster.workers.values())).pid

        def kill() -> None:
            for _ in range(600):
                if any(out.rglob(".lock")):
                    break
                time.sleep(0.05)
            os.kill(victim, signal.SIGKILL)

        killer = threading.Thread(target=kill)
        killer.start()
        answer = run_batch(campaigns, out, cluster=cluster.scheduler_address)
        killer.join()
    assert answer["campaigns"] == 3
    assert results(out) == results(runs)


def test_too_small_a_fleet_is_told(runs: Path, tmp_path: Path) -> None:
    result = runner.invoke(app, ["fleet", str(runs), "--out", str(tmp_path / "fleet.html")])
    assert result.exit_code == 1
    assert "too few to tell what is usual" in result.output


def test_a_fleet_is_reported(runs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("robcal.fleet.statistics.FEWEST", 3)
    out = tmp_path / "fleet.html"
    result = runner.invoke(app, ["fleet", str(runs), "--out", str(out), "--json", "-q"])
    assert result.exit_code == 0, result.output
    data = json.loads((tmp_path / "fleet.json").read_text())
    assert data["robots"] == 3
    assert data["batches"] == {"supplier0": 2, "supplier1": 1}
    for name, p in data["parameters"].items():
        assert p["unit"] in ("mm", "deg", "deg/kNm")
        assert not name.startswith(("base.", "tool."))
        assert p["median"] == pytest.approx(sorted(p["values"].values())[len(p["values"]) // 2])
    page = out.read_text()
    assert page.count("<figure>") == len(data["parameters"])
    assert "<script" not in page


def test_history_keeps_runs_once_and_compares_them(runs: Path, tmp_path: Path) -> None:
    database = str(tmp_path / "h.db")
    folders = [runs / "supplier0" / "robot0", runs / "supplier1" / "robot1"]
    first, second = (history.import_run(folder, database, robot="cell-7") for folder in folders)
    again = history.import_run(folders[0], database, robot="cell-7", note="x")
    assert (first["new"], second["new"], again["new"]) == (True, True, False)
    assert again["id"] == first["id"]
    listed = history.list_runs(database)
    assert sorted(row["id"] for row in listed) == [1, 2]
    assert history.show_run(database, "1")["folder"] == str(folders[0].resolve())
    told = history.compare_runs(database, "1", "2")
    assert told["p_value"] < 1e-6
    assert told["statement"].startswith("changed: ")
    assert history.compare_runs(database, str(folders[0]), "1")["p_value"] == pytest.approx(1.0)
    assert history.compare_runs(database, "1", "1")["statement"].startswith("nothing changed")
    assert history.changes_of(database, "cell-7", 365)["statement"].startswith("changed: ")
    result = runner.invoke(app, ["history", "compare", "1", "2", "--database", database])
    assert result.exit_code == 0
    assert "changed: " in result.output


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["show", "9"], "holds no run 9"),
        (["compare", "a", "b"], "is no number of a run"),
        (["changes", "piano"], "holds no run of robot 'piano'"),
        (["import", "nowhere"], "is not a run folder"),
    ],
)
def test_bad_questions_get_a_sentence(tmp_path: Path, arguments: list[str], says: str) -> None:
    result = runner.invoke(app, ["history", *arguments, "--database", str(tmp_path / "h.db")])
    assert result.exit_code == 1
    assert says in result.output


def test_a_history_of_the_first_schema_is_brought_up_to_date(runs: Path, tmp_path: Path) -> None:
    database = str(tmp_path / "old.db")
    history.import_run(runs / "supplier0" / "robot0", database)
    engine = sa.create_engine(f"sqlite:///{database}")
    with engine.begin() as connection:
        connection.exec_driver_sql("ALTER TABLE history_run DROP COLUMN note")
        connection.exec_driver_sql("UPDATE history_meta SET version = 1")
    assert history.list_runs(database)[0]["note"] == ""
    with engine.begin() as connection:
        connection.exec_driver_sql("UPDATE history_meta SET version = 99")
    with pytest.raises(InvalidInput, match="newer program"):
        history.list_runs(database)
