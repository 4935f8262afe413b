"""`pipeline cell`: files in, files out; bad input in one sentence with file, row and remedy."""

import json
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
import yaml
from typer.testing import CliRunner

from fixtures.campaigns import make_campaign
from fixtures.rigid import Array, frame_from_six, move
from fixtures.touching import spread_postures, touching
from fixtures.true_robot import TrueRobot
from pipeline.cli import app
from pipeline.runner import run_campaign
from robcal.files.cell_files import read_placed
from robcal.files.tables import read_table, write_table
from tests.pipeline.conftest import edit_rows, edit_yaml

MIDDLE = np.radians([20.0, 10.0, 60.0, 20.0, 50.0, 10.0])
TOOL = frame_from_six([0.08, -0.03, 0.25, 0.3, -0.4, 0.6])
OBJECT = frame_from_six([1.2, 0.1, 0.6, 0.1, -0.2, 0.3])
NOMINAL = np.array([[0, 0, 0], [0.4, 0, 0], [0.4, 0.3, 0], [0, 0.3, 0.0], [0.2, 0, -0.1], [0, 0.15, -0.1]])
CORNERS = {"origin": [0, 0, 0], "x": [0.4, 0, 0], "xy": [0.1, 0.3, 0]}

runner = CliRunner()


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, TrueRobot]:
    """A run, and a true robot that is exactly the identified one, in base coordinates."""
    folder = tmp_path_factory.mktemp("cell")
    make_campaign(folder / "campaign", seed=6, level="frames", poses=40, verify=8)
    edit_yaml(folder / "campaign" / "campaign.yaml", lambda d: d.update(diagnosis={"enabled": False}))
    run_campaign(folder / "campaign", folder / "run", until="identify")
    content = yaml.safe_load((folder / "run" / "robot_calibrated.yaml").read_text())
    return folder / "run", TrueRobot(content, {k: float(v) for k, v in content["parameters"].items()})


def table(path: Path, q: Array, points: Sequence[str], **more: Sequence[object]) -> Path:
    columns: dict[str, Sequence[object]] = {"pose": [f"t{i}" for i in range(len(q))]}
    columns |= {f"q{k + 1}_deg": [f"{v:.9f}" for v in np.degrees(q[:, k])] for k in range(q.shape[1])}
    write_table(path, {**columns, "point": points, **more})
    return path


@pytest.fixture(scope="module")
def touches(finished: tuple[Path, TrueRobot], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder with touches of a tip, of the corners of an object, and of its nominal points."""
    folder, rng = tmp_path_factory.mktemp("touches"), np.random.default_rng(1)
    robot = finished[1].replaced(flange_T_tool=TOOL)

    def at(places: Array, offset: Sequence[float] = (0, 0, 0)) -> Array:
        return touching(robot, spread_postures(rng, len(places), MIDDLE), places, offset)

    tip = OBJECT[None, :3, 3]
    offsets = [(0, 0, 0)] * 5 + [(0.1, 0, 0), (0.03, 0.09, 0)]
    table(folder / "tip.csv", np.concatenate([at(tip, o) for o in offsets]), ["tip"] * 5 + ["x", "xy"])
    table(folder / "corners.csv", at(move(OBJECT, np.array(list(CORNERS.values())))), list(CORNERS))
    table(folder / "object.csv", at(move(OBJECT, np.tile(NOMINAL, (2, 1)))), list("abcdef") * 2)
    xyz = {f"{n}_mm": NOMINAL[:, k] * 1e3 for k, n in enumerate("xyz")}
    write_table(folder / "nominal.csv", {"point": list("abcdef"), **xyz, "hold": ["z", "z", "z", "x", "y", ""]})
    write_table(folder / "few.csv", {"point": list("abcde"), **{k: v[:5] for k, v in xyz.items()}})
    return folder


def call(*arguments: object) -> dict:
    result = runner.invoke(app, ["cell", *map(str, arguments), "--json"])
    answer = json.loads(result.stdout)
    assert result.exit_code == (0 if answer["ok"] else 1)
    return answer


def test_tool_then_object_then_points(finished: tuple[Path, TrueRobot], touches: Path, tmp_path: Path) -> None:
    run, tool = finished[0], tmp_path / "tool.yaml"
    found = call("tcp", run, touches / "tip.csv", "--out", tool)
    np.testing.assert_allclose(found["flange_T_tool"]["xyz_mm"], TOOL[:3, 3] * 1e3, atol=1e-3)
    assert set(found["residuals_mm"]) == {"tip", "x", "xy"}
    assert read_placed(tool, "flange_T_tool").with_robot.shape[1] > 10
    for name, more in {"corners": (), "object": ("--nominal", touches / "nominal.csv")}.items():
        out = tmp_path / f"{name}.yaml"
        found = call("object", run, touches / f"{name}.csv", "--tool", tool, "--out", out, *more)
        np.testing.assert_allclose(read_placed(out, "base_T_object").T, OBJECT, atol=5e-6)
        assert max(found["residuals_mm"].values()) < 0.005
    call("measure", run, touches / "object.csv", "--tool", tool, "--out", tmp_path / "points.csv")
    points = read_table(tmp_path / "points.csv")
    xyz = np.column_stack([points.numbers(f"{n}_mm") for n in "xyz"]) / 1e3
    np.testing.assert_allclose(xyz, move(OBJECT, NOMINAL), atol=5e-6)
    assert (points.numbers("sxx_mm2", positive=True) > 0).all()


def test_base_and_probe(finished: tuple[Path, TrueRobot], tmp_path: Path) -> None:
    run, robot = finished
    rng = np.random.default_rng(2)
    q = spread_postures(rng, 6, MIDDLE)
    six = np.array([1.0, 2.0, -1.0, 0.1, 0.2, 1.0])
    tool = yaml.safe_load((run / "robot_calibrated.yaml").read_text())["flange_T_tool"]
    own = frame_from_six([*np.array(tool["xyz_mm"]) / 1e3, *np.radians(tool["rpy_deg"])])
    T = frame_from_six(six) @ robot.replaced(flange_T_tool=own).world_T_tool(q)
    columns = frame_columns(T)
    table(tmp_path / "pairs.csv", q, ["-"] * 6, **columns)
    found = call("base", run, tmp_path / "pairs.csv", "--out", tmp_path / "base.yaml")
    np.testing.assert_allclose(found["world_T_base"]["xyz_mm"], six[:3] * 1e3, atol=1e-2)
    turns = frame_from_six(np.concatenate([np.zeros((5, 3)), rng.uniform(-0.5, 0.5, (5, 3))], axis=1))
    turns[:, :3, 3] = -turns[:, :3, :3] @ [0.01, 0.02, 0.2]
    write_table(tmp_path / "probe.csv", {"pose": list("abcde"), **frame_columns(turns)})
    found = call("probe", tmp_path / "probe.csv", "--out", tmp_path / "probe.yaml")
    np.testing.assert_allclose(found["flange_T_tool"]["xyz_mm"], [10, 20, 200], atol=1e-3)


def frame_columns(T: Array) -> dict[str, list[float]]:
    from fixtures.rigid import six_from_frame

    six = six_from_frame(T)
    names = ["x_mm", "y_mm", "z_mm", "roll_deg", "pitch_deg", "yaw_deg"]
    return {n: list(six[:, k] * (1e3 if k < 3 else 180 / np.pi)) for k, n in enumerate(names)}


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["tcp", "{run}", "{t}/none.csv", "--out", "{o}"], r"none\.csv: no such file"),
        (["tcp", "{t}", "{t}/tip.csv", "--out", "{o}"], "is not a run folder"),
        (["tcp", "{run}", "{t}/corners.csv", "--out", "{o}"], r"corners\.csv, row 2: point 'origin' is none of tip, x"),
        (["tcp", "{run}", "{t}/nominal.csv", "--out", "{o}"], r"nominal\.csv, row 1: column 'pose' is missing"),
        (["object", "{run}", "{t}/object.csv", "--out", "{o}"], r"object\.csv, row 2: point 'a' is none of origin"),
        (
            ["object", "{run}", "{t}/object.csv", "--nominal", "{t}/few.csv", "--out", "{o}"],
            r"object\.csv, row 7: point 'f' is not in .*few\.csv: list it",
        ),
        (["object", "{run}", "{t}/corners.csv", "--tool", "{t}/tip.csv", "--out", "{o}"], r"tip\.csv.*YAML"),
        (["measure", "{run}", "{t}/object.csv", "--out", "{o}"], "the tool of the run is not the one on the flange"),
        (["base", "{run}", "{t}/object.csv"], r"object\.csv, row 1: column 'x_mm' is missing"),
        (["probe", "{t}/object.csv", "--out", "{o}"], r"object\.csv, row 1: column 'x_mm' is missing"),
    ],
)
def test_bad_input_is_one_sentence(
    arguments: list[str], message: str, finished: tuple[Path, TrueRobot], touches: Path, tmp_path: Path
) -> None:
    words = [a.format(run=finished[0], t=touches, o=tmp_path / "out") for a in arguments]
    result = runner.invoke(app, ["cell", *words])
    assert result.exit_code == 1
    (line,) = result.stderr.strip().splitlines()
    assert re.search(message, line), line
    assert not (tmp_path / "out").exists()


def test_bad_cells_of_tables(finished: tuple[Path, TrueRobot], touches: Path, tmp_path: Path) -> None:
    run = finished[0]
    bad = tmp_path / "nominal.csv"
    bad.write_text((touches / "nominal.csv").read_text())
    edit_rows(bad, lambda rows: rows[1].update(hold="w"))
    answer = call("object", run, touches / "object.csv", "--nominal", bad, "--out", tmp_path / "o")
    assert "row 3: hold is 'w'" in answer["error"]
    tip = tmp_path / "tip.csv"
    tip.write_text((touches / "tip.csv").read_text())
    edit_rows(tip, lambda rows: rows[2].update(point=""))
    assert "row 4: point is empty" in call("tcp", run, tip, "--out", tmp_path / "o")["error"]
    edit_rows(tip, lambda rows: rows[:1] * 1 + rows[5:])
    assert "touched 1 times" in call("tcp", run, tip, "--out", tmp_path / "o")["error"]


def test_bad_tool_files(finished: tuple[Path, TrueRobot], touches: Path, tmp_path: Path) -> None:
    tool = tmp_path / "tool.yaml"
    for content, message in {
        "format: robcal/cell-1\n": "holds no flange_T_tool",
        "format: robcal/cell-1\nflange_T_tool: {xyz: [0, 0, 0]}\n": "unknown key 'xyz': did you mean 'xyz_mm'",
        "format: robcal/cell-1\nflange_T_tool: {covariance: [[1.0]]}\n": "symmetric 6x6",
        "format: robcal/robot-1\n": "must be a file of the format 'robcal/cell-1'",
    }.items():
        tool.write_text(content)
        answer = call("measure", finished[0], touches / "object.csv", "--tool", tool, "--out", tmp_path / "o")
        assert message in answer["error"]
