import dataclasses
from pathlib import Path

import numpy as np
import pytest

from robcal.errors import InvalidInput
from robcal.files.robot_file import read_robot, robot_text, write_robot
from robcal.robot.model import Term
from robcal.transforms import frame_from_xyzrpy

ROBOTS = sorted((Path(__file__).parents[2] / "configs" / "robots").glob("*.yaml"))

GOOD = """format: robcal/robot-1
name: two
frames:
- {name: axis1, axis: z, sign: -1, range_deg: [-90, 90], xyz_mm: [0, 0, 500], mass_kg: 10, cog_mm: [1, 2, 3]}
- {name: slide, axis: x, type: prismatic, range_mm: [0, 800], xyz_mm: [100, 0, 0]}
- {name: flange, axis: null, xyz_mm: [0, 0, 50]}
parameters: {axis1.yaw: 1e-3}
"""


def text_of(folder: Path, text: str) -> Path:
    path = folder / "robot.yaml"
    path.write_text(text, encoding="utf-8")
    return path


def test_units_and_signs(tmp_path: Path) -> None:
    robot = read_robot(text_of(tmp_path, GOOD))
    first, slide, _ = robot.frames
    assert first.sign == -1
    assert first.limits == pytest.approx((-np.pi / 2, np.pi / 2))
    assert slide.prismatic
    assert slide.limits == pytest.approx((0.0, 0.8))
    assert first.cog == pytest.approx((0.001, 0.002, 0.003))
    assert robot.parameters == {"axis1.yaw": 1e-3}


@pytest.mark.parametrize("path", ROBOTS, ids=lambda p: p.stem)
def test_calibrated_robots_survive_writing(path: Path, tmp_path: Path) -> None:
    robot = read_robot(path)
    joint = robot.joints[0].name
    term = Term(f"{joint}_backlash", joint, "q", "w*sign(torque1)", {"w": 1e-4}, {"w": "rad"}, {"w": 1e-3}, "backlash")
    full = dataclasses.replace(
        robot.with_parameters({f"{joint}.x": 1.23456789e-4, f"{joint}.elastic_yaw": 1.5e-7}),
        terms=(term,),
        world_T_base=frame_from_xyzrpy([1.0, -2.0, 0.5, 0.1, 0.2, -3.0]),
        flange_T_tool=frame_from_xyzrpy([0.1, 0.0, 0.3, 0.0, 1.2, 0.4]),
    )
    write_robot(tmp_path / "r.yaml", full)
    back = read_robot(tmp_path / "r.yaml")
    assert back.parameters == full.parameters
    assert back.terms == full.terms
    assert robot_text(back) == robot_text(full)
    np.testing.assert_allclose(back.world_T_base, full.world_T_base, atol=1e-13)
    for a, b in zip(full.frames, back.frames, strict=True):
        np.testing.assert_allclose(a.xyz + a.rpy + a.cog, b.xyz + b.rpy + b.cog, atol=1e-13)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("axis: z, sign: -1", "axis: z, sgn: -1", ["line 4", "unknown key 'sgn'", "did you mean 'sign'?"]),
        ("sign: -1", "sign: 2", ["line 4", "sign must be 1 or -1"]),
        ("name: slide", "name: axis1", ["line 5", "stands twice"]),
        ("axis: z, sign: -1", "axis: w, sign: -1", ["line 4", "'w'"]),
        ("range_deg: [-90, 90]", "range_deg: [90, -90]", ["line 4", "is empty"]),
        ("range_mm: [0, 800]", "range_deg: [0, 800]", ["line 5", "use range_mm"]),
        ("xyz_mm: [0, 0, 500]", "xyz_mm: [0, 0]", ["line 4"]),
        ("xyz_mm: [0, 0, 500]", "xyz_mm: [0, 0, .nan]", ["line 4", "finite"]),
        ("xyz_mm: [0, 0, 500]", "xyz_mm: [0, 0, '500']", ["line 4", "must be a number"]),
        ("mass_kg: 10", "mass_kg: -10", ["line 4", "negative"]),
        ("axis1.yaw", "axis1.jaw", ["line 7", "did you mean 'yaw'?"]),
        ("axis1.yaw", "axis9.yaw", ["line 7", "no frame 'axis9'"]),
        ("robcal/robot-1", "robcal/body-1", ["'format'", "robcal/robot-1"]),
        ("axis: z, sign: -1, range_deg: [-90, 90]", "axis: null", ["line 5"]),
        ("name: two", "name: two\ngravity_m_s2: [0, 0, -9806]", ["line 3", "m/s2"]),
    ],
)
def test_contradictions_are_told_with_line_and_remedy(tmp_path: Path, old: str, new: str, words: list[str]) -> None:
    assert old in GOOD
    text = GOOD.replace(old, new)
    if new == "axis: null":
        text = text.replace("axis: x, type", "axis: null, type")
    with pytest.raises(InvalidInput, match=r"robot\.yaml") as error:
        read_robot(text_of(tmp_path, text))
    for word in words:
        assert word in str(error.value)
    assert "\n" not in str(error.value)


def test_chain_without_joints(tmp_path: Path) -> None:
    text = "format: robcal/robot-1\nname: fixed\nframes:\n- {name: flange, axis: null}\n"
    with pytest.raises(InvalidInput, match="no joints"):
        read_robot(text_of(tmp_path, text))
