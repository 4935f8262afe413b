"""`pipeline program`: files in, files out, and nothing written where anything is wrong."""

import json
from pathlib import Path

import numpy as np
import pytest
import yaml
from typer.testing import CliRunner

from fixtures.campaigns import make_campaign
from pipeline.cli import app
from pipeline.runner import run_campaign
from pipeline.runs import open_run
from pipeline.stages.identify import load_calibrated
from robcal.robot.chain import chain_of, forward
from robcal.transforms import frame, xyzrpy_from_frame
from tests.pipeline.conftest import edit_yaml

runner = CliRunner()
SRC = b"""&ACCESS RVP
DEF part()
BAS(#TOOL, 1)
BAS(#BASE, 2)
PTP XHOME
; gr\xf6\xdfe
LIN XP1
END
"""
DAT = b"""DEFDAT PART
DECL E6AXIS XHOME={A1 10,A2 -50,A3 90,A4 5,A5 30,A6 20}
DECL E6POS XP1={X %.3f,Y %.3f,Z %.3f,A %.4f,B %.4f,C %.4f}
ENDDAT
"""


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("programs")
    make_campaign(folder / "campaign", seed=6, level="frames", poses=40, verify=8)
    edit_yaml(folder / "campaign" / "campaign.yaml", lambda d: d.update(diagnosis={"enabled": False}))
    run_campaign(folder / "campaign", folder / "run", until="identify")
    return folder / "run"


@pytest.fixture
def files(run: Path, tmp_path: Path) -> Path:
    """The program, with a target near its first one, tool and base."""
    model = load_calibrated(open_run(run)).model
    flange = forward(chain_of(model), np.radians([[15.0, -55.0, 85.0, 10.0, 35.0, 10.0]]))[0]
    x, y, z, roll, pitch, yaw = xyzrpy_from_frame(flange @ frame(np.eye(3), [0.01, 0.0, 0.1]))
    numbers = (1e3 * x - 900.0, 1e3 * y, 1e3 * z - 500.0, *np.degrees([yaw, pitch, roll]))
    (tmp_path / "part.src").write_bytes(SRC)
    (tmp_path / "part.dat").write_bytes(DAT % numbers)
    places = {"tool": "flange_T_tool", "base": "base_T_object"}
    for name, key in places.items():
        six = {"xyz_mm": [10.0, 0.0, 100.0] if name == "tool" else [900.0, 0.0, 500.0], "rpy_deg": [0.0, 0.0, 0.0]}
        (tmp_path / f"{name}.yaml").write_text(yaml.safe_dump({"format": "robcal/cell-1", key: six}))
    return tmp_path


def program(run: Path, files: Path, *more: str, ok: bool = True) -> str:
    out = files / "corrected" / "part.src"
    result = runner.invoke(app, ["program", str(run), str(files / "part.src"), "--out", str(out), *more])
    assert (result.exit_code == 0) == ok, result.output
    return result.output


def frames(files: Path) -> list[str]:
    return ["--tool", f"1={files / 'tool.yaml'}", "--base", f"2={files / 'base.yaml'}"]


def test_a_program_and_its_data_are_corrected(run: Path, files: Path) -> None:
    answer = json.loads(program(run, files, *frames(files), "--json", "-q").splitlines()[-1])
    assert (answer["targets"], answer["joint_targets"], answer["cartesian_targets"]) == (2, 1, 1)
    assert answer["remaining_max_mm"] < 1e-6 < answer["uncorrected_mean_mm"]
    src, dat = (Path(path).read_bytes() for path in answer["out"])
    assert src.replace(b"; corrected by robcal for the calibrated robot: do not correct again\n", b"") == SRC
    assert dat != (files / "part.dat").read_bytes()
    assert dat.splitlines()[-1] == b"ENDDAT"


def test_files_that_hold_a_frame_alone_will_do(run: Path, files: Path) -> None:
    with_format = json.loads(program(run, files, *frames(files), "--json", "-q").splitlines()[-1])
    texts = [Path(path).read_bytes() for path in with_format["out"]]
    for name in ("tool", "base"):
        path = files / f"{name}.yaml"
        path.write_text("".join(line for line in path.read_text().splitlines(True) if not line.startswith("format")))
    program(run, files, *frames(files))
    assert [Path(path).read_bytes() for path in with_format["out"]] == texts
    (files / "tool.yaml").write_text("flange_T_tool: {xyz_mm: [1, 2]}\n")
    assert "xyz_mm must be three numbers" in program(run, files, *frames(files), ok=False)


def test_a_corrected_program_is_refused(run: Path, files: Path) -> None:
    program(run, files, *frames(files))
    (files / "part.src").write_bytes((files / "corrected" / "part.src").read_bytes())
    assert "corrected already" in program(run, files, *frames(files), ok=False)


@pytest.mark.parametrize(
    ("more", "says"),
    [
        ([], "--tool 1=FILE"),
        (["--tool", "1"], "--tool is NAME=FILE"),
        (["--tool", "1=missing.yaml"], "no such file"),
        (["--dialect", "logo"], "no dialect 'logo'"),
        (["--payload", "piano"], "no payload 'piano'"),
    ],
)
def test_bad_use_gets_a_sentence_and_writes_nothing(run: Path, files: Path, more: list[str], says: str) -> None:
    assert says in program(run, files, *more, ok=False)
    assert not (files / "corrected").exists()


def test_the_program_itself_is_kept(run: Path, files: Path) -> None:
    path = str(files / "part.src")
    result = runner.invoke(app, ["program", str(run), path, "--out", path])
    assert result.exit_code == 1
    assert "is the program itself" in result.output


def test_every_refused_line_is_told(run: Path, files: Path) -> None:
    (files / "part.src").write_bytes(SRC.replace(b"LIN XP1\n", b"LIN_REL {X 10}\nLIN XP1\nPTP_REL {A1 5}\n"))
    output = program(run, files, *frames(files), "--json", ok=False)
    answer = json.loads(output.splitlines()[-1])
    assert answer["error"] == answer["errors"][0]
    assert [f"line {n}" in sentence for n, sentence in zip((7, 9), answer["errors"], strict=True)] == [True, True]
    assert not (files / "corrected").exists()


def test_a_program_without_motions_is_refused(run: Path, files: Path) -> None:
    (files / "part.src").write_text("DEF part()\nBAS(#TOOL, 1)\nEND\n")
    assert "no motion to a target was found" in program(run, files, ok=False)
    assert not (files / "corrected").exists()
