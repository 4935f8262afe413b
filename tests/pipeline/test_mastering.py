"""`pipeline master`: offsets of a true robot of the fixtures, from frames, points, one pose or both directions."""

import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
import yaml
from typer.testing import CliRunner

from fixtures.campaigns import make_campaign, write_table
from fixtures.plan import Truth
from fixtures.rigid import Array, move, six_from_frame, small_motion
from pipeline.cli import app
from pipeline.runner import run_campaign
from pipeline.runs import open_run
from pipeline.stages.identify import load_calibrated
from robcal.calibration.joint_log import JointLog
from robcal.calibration.observations import FrameObservations
from robcal.cell.mastering import master
from robcal.files.tables import read_table
from robcal.files.tables import write_table as write_csv
from tests.pipeline.conftest import edit_rows, edit_yaml

OFFSETS = np.radians([0.4, -0.3, 0.25, 1.2, -0.8, 2.0])
AXES = [f"axis{k}" for k in range(1, 7)]
runner = CliRunner()


def made(folder: Path, level: str) -> tuple[Path, Path, Truth]:
    truth = make_campaign(folder / "campaign", seed=6, level=level, poses=60, verify=8)
    edit_yaml(folder / "campaign" / "campaign.yaml", lambda d: d.update(diagnosis={"enabled": False}))
    run_campaign(folder / "campaign", folder / "run", until="identify")
    return folder / "campaign", folder / "run", truth


@pytest.fixture(scope="module")
def by_frames(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path, Truth]:
    return made(tmp_path_factory.mktemp("frames"), "frames")


def joint_columns(q: Array) -> dict[str, list[str]]:
    return {f"q{k + 1}_deg": [f"{v:.9f}" for v in np.degrees(q[:, k])] for k in range(q.shape[1])}


def recorded(made: tuple[Path, Path, Truth], folder: Path, q: Array, lost: Array | float = 0.0, **more: object) -> Path:
    """A campaign of frames in which the robot has other zeros: true = indicated + offset."""
    campaign, _, truth = made
    shutil.copytree(campaign, folder)
    rng = np.random.default_rng(9)
    names = [f"m{i}" for i in range(len(q))]
    T = truth.robot.world_T_tool(q + OFFSETS + lost) @ small_motion(rng.normal(0, [5e-5] * 3 + [1e-4] * 3, (len(q), 6)))
    six = six_from_frame(T)
    frames: dict[str, object] = {"pose": names}
    for k, n in enumerate(("x_mm", "y_mm", "z_mm", "roll_deg", "pitch_deg", "yaw_deg")):
        frames[n] = list(six[:, k] * (1e3 if k < 3 else 180 / np.pi))
    frames |= {"sigma_mm": [0.05] * len(q), "sigma_deg": [np.degrees(1e-4)] * len(q)}
    write_table(folder / "frames.csv", frames)  # type: ignore[arg-type]
    write_csv(folder / "poses.csv", {"pose": names, **joint_columns(q), **more})  # type: ignore[dict-item]
    return folder


def call(*arguments: object) -> dict:
    result = runner.invoke(app, ["master", *map(str, arguments), "--json"])
    answer = json.loads(result.stdout)
    assert result.exit_code == (0 if answer["ok"] else 1), answer
    return answer


@pytest.mark.parametrize("poses", [1, 12])
def test_all_six_offsets(by_frames: tuple[Path, Path, Truth], tmp_path: Path, poses: int) -> None:
    q = by_frames[2].recorded.q[:poses]
    campaign = recorded(by_frames, tmp_path / "c", q)
    found = call(by_frames[1], campaign, "--out", tmp_path / "out")
    assert list(found["offsets_deg"]) == AXES
    error = np.array(list(found["offsets_deg"].values())) - np.degrees(OFFSETS)
    assert np.all(np.abs(error) < 4.5 * np.array(list(found["sigma_deg"].values())))
    assert np.abs(error).max() < (0.04 if poses == 1 else 0.008)
    assert json.loads((tmp_path / "out" / "mastering.json").read_text())["unobservable"] == []
    # the mastered robot predicts where its tool was
    rows = runner.invoke(
        app,
        ["predict", str(tmp_path / "out"), "--poses", str(campaign / "poses.csv"), "--out", str(tmp_path / "p.csv")],
    )
    assert rows.exit_code == 0, rows.stderr

    told, seen = (read_table(path) for path in (tmp_path / "p.csv", campaign / "frames.csv"))
    for n in ("x_mm", "y_mm", "z_mm"):
        np.testing.assert_allclose(told.numbers(n), seen.numbers(n), atol=0.3)


def test_some_joints_and_both_directions(by_frames: tuple[Path, Path, Truth], tmp_path: Path) -> None:
    """Rows of equal angles, approached from both sides: the offset is that of their mean."""
    q = np.repeat(by_frames[2].recorded.q[:6], 2, axis=0)
    sides = np.tile([1.0, -1.0], 6)
    lost = np.zeros_like(q)
    lost[:, 2] = np.radians(0.05) * sides
    more = {f"approach{k + 1}": list(sides if k == 2 else np.zeros(12)) for k in range(6)}
    campaign = recorded(by_frames, tmp_path / "c", q, lost, **more)
    found = call(by_frames[1], campaign, "--out", tmp_path / "out")
    assert found["offsets_deg"]["axis3"] == pytest.approx(np.degrees(OFFSETS[2]), abs=0.008)
    assert list(found["reversal_deg"]) == ["axis3"]
    assert found["reversal_deg"]["axis3"]["half_width"] == pytest.approx(0.05, abs=0.006)
    some = call(by_frames[1], campaign, "--out", tmp_path / "some", "--joints", "axis3,axis5")
    assert list(some["offsets_deg"]) == ["axis3", "axis5"]


def test_one_point_tells_three_offsets_and_names_the_others(tmp_path: Path) -> None:
    made_ = made(tmp_path, "points")
    truth = made_[2]
    q = truth.recorded.q[:1]
    folder = tmp_path / "c"
    shutil.copytree(made_[0], folder)
    target = yaml.safe_load((folder / "plate.yaml").read_text())["targets"][0]
    p = move(truth.robot.world_T_tool(q + OFFSETS), np.array([target["xyz_mm"]]) / 1e3)[0]
    point = {f"{n}_mm": [float(p[0, k]) * 1e3] for k, n in enumerate("xyz")}
    write_csv(folder / "points.csv", {"pose": ["a"], "target": [target["id"]], **point, "sigma_mm": [0.03]})
    write_csv(folder / "poses.csv", {"pose": ["a"], **joint_columns(q)})
    found = call(made_[1], folder, "--out", tmp_path / "out")
    assert len(found["offsets_deg"]) == 3
    left = {entry["axis"]: entry["tied_to"] for entry in found["unobservable"]}
    assert set(left) | set(found["offsets_deg"]) == set(AXES)
    assert all(set(tied) <= set(found["offsets_deg"]) and tied for tied in left.values())


def test_another_instrument_leaves_the_first_and_last_axis_open(by_frames: tuple[Path, Path, Truth]) -> None:

    _, run, truth = by_frames
    robot = load_calibrated(open_run(run))
    q = truth.recorded.q[:30]
    log = JointLog(tuple(map(str, range(30))), q, (None,) * 30, np.zeros(30, bool), np.zeros_like(q))
    T = small_motion(np.array([0.3, 0.2, 0.1, 0.1, -0.2, 0.9])) @ truth.robot.world_T_tool(q + OFFSETS)
    seen = FrameObservations.isotropic(T @ small_motion(np.array([0.1, 0.0, 0.05, 0.2, 0.1, 0.0])), 5e-5, 1e-4)
    found = master(robot, log, [seen], free=("base", "tool"))
    assert set(found.unobservable) >= {"axis1", "axis6"}
    assert any("base" in name for name in found.unobservable["axis1"])
    assert any("tool" in name for name in found.unobservable["axis6"])
    error = np.degrees(found.offsets - [OFFSETS[AXES.index(name)] for name in found.joints])
    assert np.all(np.abs(error) < 4 * np.degrees(found.sigma))


def test_notch(tmp_path: Path) -> None:
    rng, errors, sigmas = np.random.default_rng(3), [], []
    path = tmp_path / "signal.csv"
    for _ in range(20):
        place = rng.uniform(-0.3, 0.3)
        q = np.linspace(-2, 2, 400)
        signal = 5.0 - 2.0 * np.exp(-(((q - place) / 0.4) ** 2)) + 0.02 * rng.standard_normal(400)
        write_csv(path, {"q_deg": list(q), "signal": list(signal)})
        answer = call("--notch", path)
        errors.append((answer["q_deg"] - place) / answer["sigma_deg"])
        sigmas.append(answer["sigma_deg"])
    assert np.sqrt(np.mean(np.square(errors))) < 1.7
    assert np.mean(sigmas) < 0.01
    write_csv(path, {"q_deg": list(q), "signal": list(rng.standard_normal(400))})
    assert "signal.csv: the signal shows no notch" in call("--notch", path)["error"]
    write_csv(path, {"q_deg": list(q[:200]), "signal": list(signal[:200])})
    assert re.search("signal.csv: the (notch lies at the edge|signal shows no)", call("--notch", path)["error"])
    path.write_text("q,signal\n1,2\n")
    assert "row 1: column 'q_deg' is missing" in call("--notch", path)["error"]


def run_command(*arguments: object) -> dict:
    result = runner.invoke(app, [*map(str, arguments), "--json"])
    answer = json.loads(result.stdout)
    assert result.exit_code == (0 if answer["ok"] else 1), answer
    return answer


def test_exchange_and_transfer(by_frames: tuple[Path, Path, Truth], tmp_path: Path) -> None:
    """The new robot is the old one with other zeros."""
    _, run, truth = by_frames
    every = truth.recorded.q
    new = recorded(by_frames, tmp_path / "c", every[:12])
    told = run_command("exchange", run, new, "--out", tmp_path / "new")
    assert told["poses"] == 12
    assert set(told["offsets_deg"]) >= {"axis2", "axis3", "axis4", "axis5"}
    write_csv(tmp_path / "taught.csv", {"pose": list(map(str, range(30))), **joint_columns(every[20:50])})
    answer = run_command(
        "transfer", tmp_path / "new", "--from", run, "--poses", tmp_path / "taught.csv", "--out", tmp_path / "q.csv"
    )
    table = read_table(tmp_path / "q.csv")
    q = np.radians(np.column_stack([table.numbers(f"q{k}_deg") for k in range(1, 7)]))
    wanted = truth.robot.world_T_tool(every[20:50])
    after = np.linalg.norm((truth.robot.world_T_tool(q + OFFSETS) - wanted)[:, :3, 3], axis=1)
    before = np.linalg.norm((truth.robot.world_T_tool(every[20:50] + OFFSETS) - wanted)[:, :3, 3], axis=1)
    assert after.mean() < 0.05 * before.mean()
    assert answer["untransferred_mean_mm"] == pytest.approx(1e3 * before.mean(), rel=0.05)
    assert np.sqrt(np.mean((1e3 * after / table.numbers("sigma_mm")) ** 2)) < 2.0
    edit_rows(tmp_path / "taught.csv", lambda rows: rows[3].update(q2_deg="x"))
    answer = run_command("transfer", tmp_path / "new", "--from", run, "--poses", tmp_path / "taught.csv", "--out", "q")
    assert "taught.csv, row 5: q2_deg" in answer["error"]


def test_one_pose_exchanges_a_robot_within_what_it_states(by_frames: tuple[Path, Path, Truth], tmp_path: Path) -> None:
    _, run, truth = by_frames
    every = truth.recorded.q
    new = recorded(by_frames, tmp_path / "c", every[:1])
    told = run_command("exchange", run, new, "--out", tmp_path / "new")
    assert (told["poses"], told["parameters"]) == (1, 6)
    found = np.array([told["offsets_deg"][a] for a in AXES])
    sigma = np.array([told["sigma_deg"][a] for a in AXES])
    assert np.all(np.abs(found - np.degrees(OFFSETS)) < 3.0 * sigma)
    assert "tell zero offsets alone" in told["warnings"][0]
    write_csv(tmp_path / "taught.csv", {"pose": list(map(str, range(30))), **joint_columns(every[20:50])})
    taught = ("--poses", tmp_path / "taught.csv", "--out", tmp_path / "q.csv")
    run_command("transfer", tmp_path / "new", "--from", run, *taught)
    table = read_table(tmp_path / "q.csv")
    q = np.radians(np.column_stack([table.numbers(f"q{k}_deg") for k in range(1, 7)]))
    wanted = truth.robot.world_T_tool(every[20:50])
    after = 1e3 * np.linalg.norm((truth.robot.world_T_tool(q + OFFSETS) - wanted)[:, :3, 3], axis=1)
    before = 1e3 * np.linalg.norm((truth.robot.world_T_tool(every[20:50] + OFFSETS) - wanted)[:, :3, 3], axis=1)
    assert after.mean() < 0.3 * before.mean()
    assert 0.2 < np.sqrt(np.mean((after / table.numbers("sigma_mm")) ** 2)) < 2.0


def test_bad_exchanges(by_frames: tuple[Path, Path, Truth], tmp_path: Path) -> None:
    campaign, run, truth = by_frames
    other = recorded(by_frames, tmp_path / "other", truth.recorded.q[:12])
    edit_yaml(other / "robot.yaml", lambda d: d["frames"][2].update(xyz_mm=[1300.0, 0.0, 0.0]))
    told = run_command("exchange", run, other, "--out", tmp_path / "o2")
    assert "is of another type than the reference" in told["error"]
    assert "is not a run folder" in run_command("exchange", campaign, other, "--out", tmp_path / "o3")["error"]


def test_bad_input_is_one_sentence(by_frames: tuple[Path, Path, Truth], tmp_path: Path) -> None:
    campaign = recorded(by_frames, tmp_path / "c", by_frames[2].recorded.q[:2])
    run = by_frames[1]
    assert "no joint 'axis9'" in call(run, campaign, "--out", tmp_path / "o", "--joints", "axis9")["error"]
    assert "is not a run folder" in call(campaign, campaign, "--out", tmp_path / "o2")["error"]
    (campaign / "frames.csv").write_text("pose,x_mm\n")
    assert "frames.csv" in call(run, campaign, "--out", tmp_path / "o3")["error"]
    assert runner.invoke(app, ["master", str(run)]).exit_code == 2
    assert runner.invoke(app, ["master", str(run), "--notch", "x.csv"]).exit_code == 2
