"""Tables and joint logs of other programs: the same numbers as in the project's own, or a sentence with the remedy."""

import csv
import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pipeline.campaign_reader import read_campaign
from robcal.errors import InvalidInput
from robcal.files.joint_logs import read_controller_log, standstills
from tests.pipeline.conftest import edit_yaml

XYZ = ("x_mm", "y_mm", "z_mm")
RPY = ("roll_deg", "pitch_deg", "yaw_deg")


def rows_of(path: Path) -> list[dict[str, str]]:
    with path.open(newline="", encoding="utf-8") as stream:
        return list(csv.DictReader(stream))


def _abc(R: Rotation) -> dict[str, float]:
    return dict(zip(("A", "B", "C"), R.as_euler("ZYX", degrees=True), strict=True))


def _quaternion(R: Rotation) -> dict[str, float]:
    return dict(zip(("q1", "q2", "q3", "q4"), R.as_quat()[[3, 0, 1, 2]], strict=True))


def _vector(R: Rotation) -> dict[str, float]:
    return dict(zip(("rx", "ry", "rz"), R.as_rotvec(), strict=True))


@pytest.mark.parametrize(
    ("orientation", "numbers", "columns"),
    [
        ("abc", _abc, {"a_deg": "A", "b_deg": "B", "c_deg": "C"}),
        ("quaternion", _quaternion, {"qw": "q1", "qx": "q2", "qy": "q3", "qz": "q4"}),
        ("rotation_vector", _vector, {"rx_rad": "rx", "ry_rad": "ry", "rz_rad": "rz"}),
    ],
)
def test_frames_with_decimal_commas_metres_and_other_angles(
    frame_campaign: Path, orientation: str, numbers: Callable[[Rotation], dict[str, float]], columns: dict[str, str]
) -> None:
    wanted = read_campaign(frame_campaign).measurements[0].values
    lines = ["Tracker export;;", "14.03.2025 10:11;;"]
    for row in rows_of(frame_campaign / "frames.csv"):
        R = Rotation.from_euler("xyz", [float(row[name]) for name in RPY], degrees=True)
        cells = {"Nr.": row["pose"]} | {f"{n[0].upper()} [m]": float(row[n]) / 1000 for n in XYZ} | numbers(R)
        if len(lines) == 2:
            lines.append(";".join(cells))
        lines.append(";".join(c if isinstance(c, str) else f"{c:.12f}".replace(".", ",") for c in cells.values()))
    (frame_campaign / "export.txt").write_bytes("\r\n".join(lines).encode("cp1252"))
    use = {"file": "export.txt", "sep": ";", "decimal": ",", "skip_rows": 2, "orientation": orientation}
    use["columns"] = {"pose": "Nr.", "x_m": "X [m]", "y_m": "Y [m]", "z_m": 4, **columns}
    edit_yaml(frame_campaign / "campaign.yaml", lambda d: d.update(measurements=use))
    (table,) = read_campaign(frame_campaign).measurements
    np.testing.assert_allclose(table.values, wanted, atol=1e-9)


def test_a_heading_that_is_not_there_and_rows_that_are_cut(frame_campaign: Path) -> None:
    path = frame_campaign / "frames.csv"
    use = {"file": "frames.csv", "columns": {"x_mm": "X"}}
    edit_yaml(frame_campaign / "campaign.yaml", lambda d: d.update(measurements=use))
    with pytest.raises(InvalidInput, match=r"frames.csv: there is no column 'X' for x_mm"):
        read_campaign(frame_campaign)
    path.write_text(path.read_text().replace(",", ";"))
    edit_yaml(frame_campaign / "campaign.yaml", lambda d: d.update(measurements={"file": "frames.csv", "sep": ";"}))
    assert len(read_campaign(frame_campaign).measurements[0])
    lines = path.read_text().splitlines()
    path.write_text("\n".join([*lines[:5], "p001;1", *lines[5:]]))
    with pytest.raises(InvalidInput, match=r"frames.csv, row 6: has 2 cells"):
        read_campaign(frame_campaign)


def _angles(campaign: Path) -> tuple[list[str], np.ndarray]:
    rows = rows_of(campaign / "poses.csv")
    return [r["pose"] for r in rows], np.array([[float(r[f"q{k}_deg"]) for k in range(1, 7)] for r in rows])


def kuka_dat(names: list[str], q: np.ndarray) -> str:
    text = '&ACCESS RVP\nDEFDAT  MEASURE\n;FOLD DECLARATIONS;%{PE}\nDECL BASIS_SUGG_T LAST_BASIS={POINT1[] "P1"}\n'
    for name, row in zip(names, q, strict=True):
        axes = ",".join(f"A{k} {v:.9f}" for k, v in enumerate(row, 1))
        text += f"DECL E6AXIS X{name}={{{axes},E1 0.0,E2 0.0,E3 0.0,E4 0.0,E5 0.0,E6 0.0}}\n"
        text += f'DECL FDAT F{name}={{TOOL_NO 1,BASE_NO 0,IPO_FRAME #BASE,POINT2[] " "}}\n'
    return text + "ENDDAT\n"


def abb_module(names: list[str], q: np.ndarray) -> str:
    text = "MODULE Measure\n"
    for name, row in zip(names, q, strict=True):
        values = ",".join(f"{v:.9f}" for v in row)
        text += f"\tCONST jointtarget {name}:=[[{values}],[9E+09,9E9,9E9,9E9,9E9,9E9]]; ! a comment [[1,2]]\n"
    return text + "PROC main()\n\tMoveAbsJ p001\\NoEOffs,v200,fine,tool0;\nENDPROC\nENDMODULE\n"


def ur_script(names: list[str], q: np.ndarray) -> str:
    text = "def measure():\n  set_tcp(p[0,0,0.1,0,0,0])\n"
    for name, row in zip(names, q, strict=True):
        values = ", ".join(f"{math.radians(v):.12f}" for v in row)
        text += f"  global {name}_p=p[.1, .2, .3, 0, 0, 0]\n  global {name}_q=[{values}]\n"
        text += f"  movej(get_inverse_kin({name}_p, qnear={name}_q), a=1.4, v=1.05)\n"
    return text + "end\n"


@pytest.mark.parametrize(
    ("file", "written"), [("points.dat", kuka_dat), ("measure.mod", abb_module), ("measure.script", ur_script)]
)
def test_joint_logs_of_controllers(
    frame_campaign: Path, file: str, written: Callable[[list[str], np.ndarray], str]
) -> None:
    names, q = _angles(frame_campaign)
    (frame_campaign / file).write_text(written(names, q))
    edit_yaml(frame_campaign / "campaign.yaml", lambda d: (d.update(poses=file), d.pop("payloads", None)))
    poses = read_campaign(frame_campaign).poses
    assert poses is not None
    assert poses.names == tuple(names)
    np.testing.assert_allclose(np.degrees(poses.q), q, atol=1e-8)


def test_inline_targets_are_numbered_and_cartesian_ones_refused(tmp_path: Path) -> None:
    src = tmp_path / "a.src"
    src.write_text(
        "DEF a()\nPTP {A1 1,A2 -90.5,A3 90,A4 0,A5 0,A6 1E1} C_PTP\n;PTP {A1 5,A2 5}\nLIN {X 1,Y 2,Z 3}\nEND\n"
    )
    table = read_controller_log(src)
    assert table.columns["pose"] == ("1",)
    assert table.columns["q6_deg"] == ("10.0",)
    assert list(table.rows) == [2]
    script = tmp_path / "a.script"
    script.write_text("movej([0, 0, 0, 0, 0, 3.141592653589793], a=1.2)\nmovel(p[1,2,3,4,5,6])\np[1,2,3,4,5,6]\n")
    assert [float(v) for v in read_controller_log(script).columns["q6_deg"]] == [180.0]
    script.write_text("movel(p[1,2,3,4,5,6])\n")
    with pytest.raises(InvalidInput, match="no joint angles found"):
        read_controller_log(script)


def test_every_standstill_of_a_recording_is_a_pose(tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    stops = np.radians(rng.uniform(-90, 90, (5, 6)))
    rows, now = [], 100.0
    for k, stop in enumerate(stops):
        for _ in range(125):
            rows.append((now, stop + rng.normal(0, 2e-6, 6)))
            now += 0.008
        for share in np.linspace(0, 1, 60)[1:-1] if k + 1 < len(stops) else ():
            rows.append((now, stop + share * (stops[k + 1] - stop)))
            now += 0.008
    lines = ["timestamp " + " ".join(f"actual_q_{k}" for k in range(6)) + " runtime_state"]
    lines += [f"{t:.3f} " + " ".join(f"{v:.8f}" for v in q) + " 2" for t, q in rows]
    path = tmp_path / "robot_data.csv"
    path.write_text("\n".join(lines))
    table = read_controller_log(path)
    q = np.column_stack([[float(v) for v in table.columns[f"q{k}_deg"]] for k in range(1, 7)])
    np.testing.assert_allclose(q, np.degrees(stops), atol=1e-4)
    assert np.all(np.diff([float(v) for v in table.columns["time_s"]]) > 1.0)


def test_standstills_need_their_time() -> None:
    time = np.arange(100) * 0.1
    q = np.where(np.arange(100)[:, None] < 3, 1.0, 0.0)
    assert standstills(time, q) == [(3, 100)]
    assert standstills(time, np.arange(100)[:, None] * 0.01) == []
