"""What a run exports: C that says what predict says, also of terms of a diagnosis; programs of controllers."""

import csv
import ctypes
import json
import re
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from fixtures.campaigns import make_campaign
from pipeline.artifacts import IDENTIFIED
from pipeline.exports import Wanted, export_run
from pipeline.prediction import CompensateOptions, compensate_run, predict_run
from pipeline.runner import run_campaign
from pipeline.runs import open_run
from pipeline.stages.identify import load_calibrated
from robcal.errors import InvalidInput
from robcal.files.tables import read_table
from robcal.robot.chain import chain_of, forward
from robcal.robot.compensation import cell_frames
from robcal.robot.model import Term
from tests.pipeline.conftest import edit_yaml

TERMS = (
    Term("axis2.hysteresis", "axis2", "q", "-0.5*width*approach2", {"width": 2e-4}),
    Term("axis1.drift", "axis1", "q", "rate*(temp_arm_c - 20)", {"rate": 1e-5}),
    Term("axis3.ripple", "axis3", "q", "a*cos(17*q3) + b*sin(17*q3)", {"a": 1e-4, "b": -2e-4}),
    Term("axis2.lost", "axis2", "q", "a*tanh(torque2/800)", {"a": 1e-4}),
)


@pytest.fixture(scope="module", params=["one_step", "converged"])
def finished(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A run whose robot carries terms such as a diagnosis adds."""
    folder = tmp_path_factory.mktemp("exports")
    make_campaign(folder / "campaign", seed=11, level="frames", poses=40, verify=10)
    edit_yaml(
        folder / "campaign" / "campaign.yaml",
        lambda d: d.update(diagnosis={"enabled": False}, model={"statics": request.param}),
    )
    run_campaign(folder / "campaign", folder / "run", until="identify")
    run = open_run(folder / "run")
    found = run.load(IDENTIFIED)
    assert found.statics == request.param
    run.save(IDENTIFIED, replace(found, model=found.model.with_terms(TERMS)))
    return folder / "campaign", folder / "run"


@pytest.mark.skipif(shutil.which("gcc") is None, reason="needs gcc")
def test_compiled_forward_model_says_what_predict_says(finished: tuple[Path, Path], tmp_path: Path) -> None:
    campaign, run = finished
    written, _ = export_run(run, Wanted(c=tmp_path, urdf=tmp_path / "robot.urdf"))
    source = next(p for p in written if p.suffix == ".c")
    header = source.with_suffix(".h").read_text()
    flags = ["-std=c99", "-pedantic", "-Wall", "-Wextra", "-Werror", "-O1", "-shared", "-fPIC"]
    subprocess.run(["gcc", *flags, "-o", "bot.so", source.name, "-lm"], cwd=tmp_path, check=True)
    library = ctypes.CDLL(str(tmp_path / "bot.so"))
    covariates = re.search(r"COVARIATES \d+ /\* (.*?) \*/", header)
    assert covariates is not None
    names = covariates[1].split(", ")
    assert set(names) == {"approach2", "temp_arm_c"}
    loads = {
        name: [float(v) for v in re.findall(r"[-+.\de]+", text)]
        for name, text in re.findall(r"_payload_(\w+) (\{.*)", header)
    }
    predict_run(run, campaign / "poses.csv", tmp_path / "predicted.csv")
    table = read_table(tmp_path / "predicted.csv")
    expected = np.column_stack([table.numbers(f"{n}_mm") for n in "xyz"])
    pointer = ctypes.POINTER(ctypes.c_double)
    with (campaign / "poses.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    for row, place in zip(rows, expected, strict=True):
        q = np.radians([float(row[f"q{k}_deg"]) for k in range(1, 7)])
        conditions = np.array([*loads.get(row["payload"], [0.0] * 4), *(float(row[n]) for n in names)])
        T = np.zeros(12)
        getattr(library, f"{source.stem}_forward")(*(v.ctypes.data_as(pointer) for v in (q, conditions, T)))
        # the table is written with six decimals of a millimetre: 1e-9 m
        assert T[[3, 7, 11]] == pytest.approx(place * 1e-3, abs=1.1e-9)
    first = rows[0]["temp_arm_c"]
    assert re.search(rf"conditions_default {{{{0.0, {{0.0, 0.0, 0.0}}}}, {{.*{float(first)}.*}}}}", header)


@pytest.mark.parametrize(("dialect", "word"), [("krl", "PTP"), ("rapid", "Move"), ("urscript", "movej")])
@pytest.mark.parametrize("as_frames", [False, True])
def test_programs_of_controllers(
    finished: tuple[Path, Path], tmp_path: Path, dialect: str, word: str, as_frames: bool
) -> None:
    campaign, run = finished
    predict_run(run, campaign / "poses.csv", tmp_path / "wanted.csv")
    out = tmp_path / "2 parts.txt"
    answer = compensate_run(run, tmp_path / "wanted.csv", out, CompensateOptions(as_frames=as_frames, program=dialect))
    assert sum(word in line for line in out.read_text().splitlines()) == answer["frames"] == 50
    assert "robcal_2_parts" in out.read_text()


def test_an_unknown_controller_is_refused(finished: tuple[Path, Path], tmp_path: Path) -> None:
    campaign, run = finished
    predict_run(run, campaign / "poses.csv", tmp_path / "wanted.csv")
    with pytest.raises(InvalidInput, match="krl, rapid or urscript"):
        compensate_run(run, tmp_path / "wanted.csv", tmp_path / "o", CompensateOptions(program="karel"))


def test_targets_of_programs_are_base_coordinates_whatever_the_frames_were_given_in(
    finished: tuple[Path, Path], tmp_path: Path
) -> None:
    """The commanded joint values and the Cartesian targets of a program mean the same place for the controller."""
    campaign, run = finished
    predict_run(run, campaign / "poses.csv", tmp_path / "wanted.csv")
    compensate_run(run, tmp_path / "wanted.csv", tmp_path / "q.csv")
    out = tmp_path / "part.script"
    compensate_run(run, tmp_path / "wanted.csv", out, CompensateOptions(as_frames=True, program="urscript"))
    robot = load_calibrated(open_run(run))
    table = read_table(tmp_path / "q.csv")
    q = np.radians(np.column_stack([table.numbers(f"q{k}_deg") for k in range(1, 7)]))
    believed = forward(chain_of(robot.model), q) @ cell_frames(robot.kernel)[1]
    poses = [line for line in out.read_text().splitlines() if "movej(p[" in line]
    places = np.array([[float(v) for v in line.split("p[")[1].split("]")[0].split(",")][:3] for line in poses])
    assert places == pytest.approx(believed[1:, :3, 3], abs=1e-6)


def test_parameters_leave_as_plain_data(finished: tuple[Path, Path], tmp_path: Path) -> None:
    _, run = finished
    robot = load_calibrated(open_run(run))
    export_run(run, Wanted(data=tmp_path / "data"))
    data = json.loads((tmp_path / "data" / "robot.json").read_text())
    table = read_table(tmp_path / "data" / "parameters.csv")
    values = dict(zip(table.texts("parameter"), table.numbers("value"), strict=True))
    for name, value in robot.values.items():
        if not name.startswith(("base.", "tool.")):
            assert values[name] == data["parameters"][name]["value"] == pytest.approx(value)
    assert data["covariance"]["names"] == list(robot.names)


def test_ros_and_tables_of_the_cell(finished: tuple[Path, Path], tmp_path: Path) -> None:
    source = finished[1]
    run = Path(shutil.copytree(source, tmp_path / "run"))
    (run / "cameras").mkdir()
    camera = "format: robcal/camera-1\nwidth: 640\nheight: 480\nfx: 800\nfy: 801\ncx: 320\ncy: 240\nk1: -0.1\n"
    (run / "cameras" / "left.yaml").write_text(camera + "world_T_camera: {xyz_mm: [1, 2, 3], rpy_deg: [0, 0, 90]}\n")
    (run / "bodies").mkdir(exist_ok=True)
    targets = "[{id: 17, code: ring12, xyz_mm: [1, 2, 3], sigma_mm: 0.01}, {id: 18, code: null, xyz_mm: null}]"
    (run / "bodies" / "plate.yaml").write_text(f"format: robcal/body-1\ntargets: {targets}\n")
    written, _ = export_run(run, Wanted(ros=tmp_path / "ros", data=tmp_path / "data"))
    assert all(path.is_file() for path in written)

    lines = (tmp_path / "ros" / "static_transform.sh").read_text().splitlines()
    (told,) = [line for line in lines if "--child-frame-id left_optical_frame" in line]
    assert "--x 0.001000000 --y 0.002000000 --z 0.003000000" in told
    assert "--qz 0.707106781 --qw 0.707106781" in told
    base = cell_frames(load_calibrated(open_run(run)).kernel)[0]
    assert any(f"--x {base[0, 3]:.9f}" in line and "--child-frame-id base_link" in line for line in lines)
    assert '<link name="base_link"' in (tmp_path / "ros" / "robot.urdf").read_text()
    assert "camera_info_left.yaml" in {path.name for path in written}

    assert read_table(tmp_path / "data" / "cameras.csv").columns["yaw_deg"] == ("90.000000000",)
    body = read_table(tmp_path / "data" / "body_plate.csv").columns
    assert body["x_mm"] == ("1.000000", "")
    assert body["sx_mm"] == ("0.010000", "")
