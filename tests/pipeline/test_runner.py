"""Skipping, resuming, locking, and what is told when something goes wrong."""

import dataclasses
import json
import multiprocessing
import os
import re
import signal
from pathlib import Path

import pytest

from pipeline import codec, runner
from pipeline.runner import STAGE_NAMES, run_campaign
from pipeline.runs import Run, RunLocked, StageRecord
from pipeline.stages.base import Context, Outcome, Stage
from pipeline.stages.registry import STAGES
from robcal.errors import InvalidInput
from robcal.files import storage
from tests.pipeline.conftest import edit_yaml


def results(folder: Path) -> dict[str, object]:
    """Everything a run says, without the times it took."""
    result = json.loads((folder / "result.json").read_text())
    result.pop("timing")
    result.get("identification", {}).pop("seconds", None)
    found: dict[str, object] = {"result": result}
    for pattern in ("*.csv", "*.yaml", "diagnosis.json", "bodies/*", "cameras/*", "colmap/*/*"):
        for path in sorted(folder.glob(pattern)):
            content = path.read_bytes()
            if path.suffix == ".json":
                content = re.sub(rb'"seconds": [0-9.e+-]+', b"", content)
            found[str(path.relative_to(folder))] = content
    return found


def test_contract_order_of_stages() -> None:
    order = (
        "detect",
        "survey",
        "orient",
        "measure",
        "frames",
        "identify",
        "diagnose",
        "adjust",
        "verify",
        "hand_eye",
        "report",
    )
    assert order == STAGE_NAMES


def test_second_run_skips_and_a_change_runs_what_depends_on_it(point_campaign: Path, tmp_path: Path) -> None:
    out = tmp_path / "run"
    first = run_campaign(point_campaign, out, until="verify")
    assert first.ran == ("measure", "frames", "identify", "verify")
    second = run_campaign(point_campaign, out, until="verify")
    assert second.ran == ()
    assert second.result == first.result
    edit_yaml(point_campaign / "campaign.yaml", lambda d: d.update(quality={"distance_tolerance_mm": 0.4}))
    third = run_campaign(point_campaign, out, until="verify")
    assert "measure" in third.skipped
    assert "frames" in third.ran


def test_from_runs_again_and_a_deleted_result_is_made_again(point_campaign: Path, tmp_path: Path) -> None:
    out = tmp_path / "run"
    run_campaign(point_campaign, out, until="verify")
    before = results(out)
    assert run_campaign(point_campaign, out, until="verify", start="identify").ran[0] == "identify"
    (out / "frames.csv").unlink()
    assert "frames" in run_campaign(point_campaign, out, until="verify").ran
    assert results(out) == before


def test_what_a_stage_no_longer_writes_is_removed(tmp_path: Path) -> None:
    run = Run(tmp_path)
    for name in ("old.csv", "kept.csv"):
        (tmp_path / name).write_text("x")
    before = StageRecord("s", "k", {"old.csv": "h", "kept.csv": "h", "../outside": "h"}, {})
    run.remove_stale(before, StageRecord("s", "k2", {"kept.csv": "h"}, {}))
    assert sorted(p.name for p in tmp_path.iterdir()) == ["kept.csv"]


def test_the_campaign_is_never_written_to(point_campaign: Path, tmp_path: Path) -> None:
    before = {p: p.read_bytes() for p in point_campaign.rglob("*") if p.is_file()}
    run_campaign(point_campaign, tmp_path / "run", until="verify")
    assert {p: p.read_bytes() for p in point_campaign.rglob("*") if p.is_file()} == before
    with pytest.raises(InvalidInput, match="never written to"):
        run_campaign(point_campaign, point_campaign)


def test_two_runs_in_one_folder(point_campaign: Path, tmp_path: Path) -> None:
    run = Run(tmp_path / "run")
    with run.lock(), pytest.raises(RunLocked, match="another run works in this folder"):
        run_campaign(point_campaign, run.folder, until="measure")


def test_a_folder_of_another_campaign_is_refused(
    point_campaign: Path, frame_campaign_source: Path, tmp_path: Path
) -> None:
    run_campaign(point_campaign, tmp_path / "run", until="measure")
    with pytest.raises(InvalidInput, match="another campaign"):
        run_campaign(frame_campaign_source, tmp_path / "run", until="identify")


def test_full_disk_and_missing_permission_are_told(
    point_campaign: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(storage.os, "fsync", full)
    with pytest.raises(storage.StorageError, match="disk is full"):
        run_campaign(point_campaign, tmp_path / "run", until="measure")
    monkeypatch.undo()
    (tmp_path / "file").write_text("")
    with pytest.raises(storage.StorageError, match="a file stands where a folder is needed"):
        run_campaign(point_campaign, tmp_path / "file" / "run", until="measure")


def _killed(campaign: Path, out: Path, stage: str, when: str, until: str) -> None:
    """Run in a child process that kills itself with -9 in a stage: at its first write, or before its record."""

    def kill(*_: object) -> None:
        os.kill(os.getpid(), signal.SIGKILL)

    def dying(original: Stage) -> Stage:
        def work(context: Context) -> Outcome:
            if when == "first write":
                storage.os.replace = kill  # type: ignore[assignment]
            outcome = original.work(context)
            kill()
            return outcome

        return dataclasses.replace(original, work=work)

    runner.STAGES = tuple(dying(s) if s.name == stage else s for s in STAGES)
    run_campaign(campaign, out, until=until, workers=1)


def kill_in(campaign: Path, out: Path, stage: str, when: str, until: str = "verify") -> None:
    child = multiprocessing.get_context("fork").Process(target=_killed, args=(campaign, out, stage, when, until))
    child.start()
    child.join(120)
    assert child.exitcode == -signal.SIGKILL


@pytest.fixture(scope="module")
def whole(point_campaign_source: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, object]:
    """Results of a run that nothing disturbed."""
    out = tmp_path_factory.mktemp("whole") / "run"
    run_campaign(point_campaign_source, out, until="verify", workers=1)
    return results(out)


@pytest.mark.parametrize("when", ["first write", "before the record"])
@pytest.mark.parametrize("stage", ["measure", "frames", "identify", "verify"])
def test_kill_minus_nine_and_resume_gives_the_same_result(
    point_campaign: Path, whole: dict[str, object], tmp_path: Path, stage: str, when: str
) -> None:
    kill_in(point_campaign, tmp_path / "killed", stage, when)
    assert Run(tmp_path / "killed").record(stage) is None
    resumed = run_campaign(point_campaign, tmp_path / "killed", until="verify", workers=1)
    assert resumed.ran[0] == stage
    assert results(tmp_path / "killed") == whole


@pytest.mark.slow
def test_killed_in_diagnosis_verification_and_report(frame_campaign: Path, tmp_path: Path) -> None:
    edit_yaml(frame_campaign / "campaign.yaml", lambda d: d.pop("diagnosis"))
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    run_campaign(frame_campaign, whole, workers=1)
    for stage, when in (("diagnose", "before the record"), ("verify", "first write"), ("report", "first write")):
        kill_in(frame_campaign, killed, stage, when, until="report")
        assert Run(killed).record(stage) is None
    resumed = run_campaign(frame_campaign, killed, workers=1)
    assert resumed.ran == ("report",)
    assert results(killed) == results(whole)
    assert "diagnosis.json" in results(whole)
    assert timeless(killed / "report.html") == timeless(whole / "report.html")


def timeless(report: Path) -> list[str]:
    """Words of a report without what differs from run to run: times, places."""
    text = report.read_text(encoding="utf-8")
    return [word for word in re.sub(r"<[^>]*>", " ", text).split() if not re.search(r"\d\.\d|/|\d:\d", word)]


def test_images_killed_in_every_stage_and_resumed(image_campaign: Path, image_run: Path, detected: Path) -> None:
    kill_in(image_campaign, detected, "detect", "first write")
    for stage in ("survey", "orient", "measure", "frames", "identify", "verify"):
        kill_in(image_campaign, detected, stage, "first write")
    run_campaign(image_campaign, detected, until="verify", workers=1)
    assert results(detected) == results(image_run)


def test_detection_killed_goes_on_with_the_next_image(image_campaign: Path, tmp_path: Path) -> None:
    for camera in ("left", "right"):
        for path in sorted((image_campaign / "station" / camera).iterdir())[2:]:
            path.unlink()
    out = tmp_path / "run"
    child = multiprocessing.get_context("fork").Process(target=_kill_at_third_write, args=(image_campaign, out))
    child.start()
    child.join(120)
    assert child.exitcode == -signal.SIGKILL
    done = list((out / "cache" / "detections").glob("*.npz"))
    times = {path: path.stat().st_mtime_ns for path in done}
    assert len(done) == 2
    run_campaign(image_campaign, out, until="detect", workers=1)
    assert {path: path.stat().st_mtime_ns for path in done} == times


def _kill_at_third_write(campaign: Path, out: Path) -> None:
    save = codec.save
    count = 0

    def counted(path: Path, value: object) -> None:
        nonlocal count
        count += 1
        if count == 3:
            os.kill(os.getpid(), signal.SIGKILL)
        save(path, value)

    codec.save = counted
    run_campaign(campaign, out, until="detect", workers=1)


def test_damaged_state_is_written_anew(point_campaign: Path, tmp_path: Path) -> None:
    run_campaign(point_campaign, tmp_path / "run", until="frames")
    (tmp_path / "run" / "state" / "run.json").write_bytes(b"garbage")
    (tmp_path / "run" / "state" / "frames.json").write_bytes(b"garbage")
    done = run_campaign(point_campaign, tmp_path / "run", until="frames")
    assert done.ran == ("frames",)
