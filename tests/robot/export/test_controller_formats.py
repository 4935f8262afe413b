"""Controller programs carry the numbers exactly as the controllers read them."""

import re

import numpy as np
import pytest

from robcal.errors import InvalidInput
from robcal.robot.export.controller_formats import RESERVED, frame_program, joint_program, program_name, quaternion
from robcal.robot.model import Frame, RobotModel
from robcal.transforms import exp_so3, frame, frame_from_xyzrpy
from tests.programs.small_parser import PARSERS
from tests.robot.chains import kr_like

RNG = np.random.default_rng(0)
Q = RNG.uniform(-2, 2, (4, 6))
T = frame(exp_so3(RNG.uniform(-1.7, 1.7, (4, 3))), RNG.normal(size=(4, 3)))


def numbers(line: str) -> np.ndarray:
    return np.array([float(v) for v in re.findall(r"(?<![\w.])-?\d+\.\d+", line)])


def body(text: str, word: str) -> list[str]:
    return [line for line in text.splitlines() if word in line]


def test_joint_values_survive():
    model = kr_like()
    degree = 180 / np.pi
    for dialect, word, scale in (("krl", "E6AXIS", degree), ("rapid", "MoveAbsJ", degree), ("urscript", "movej", 1)):
        lines = body(joint_program(model, Q, dialect), word)
        assert len(lines) == 4
        for line, q in zip(lines, Q, strict=True):
            assert numbers(line)[:6] == pytest.approx(q * scale, abs=1e-6)


def test_frames_mean_the_same_in_every_dialect():
    for line, target in zip(body(frame_program(T, "krl"), "E6POS"), T, strict=True):
        x, y, z, a, b, c = numbers(line)
        assert frame_from_xyzrpy([x / 1e3, y / 1e3, z / 1e3, *np.deg2rad([c, b, a])]) == pytest.approx(target, abs=1e-6)
    for line, target in zip(body(frame_program(T, "urscript"), "movej"), T, strict=True):
        six = numbers(line)[:6]
        assert frame(exp_so3(six[3:]), six[:3]) == pytest.approx(target, abs=1e-8)
    for line, target in zip(body(frame_program(T, "rapid"), "MoveJ"), T, strict=True):
        x, y, z, w, *v = numbers(line)[:7]
        q = np.array(v)
        assert w * w + q @ q == pytest.approx(1.0, abs=1e-7)
        p = np.array([0.3, -0.2, 0.5])
        turned = p + 2 * np.cross(q, np.cross(q, p) + w * p)
        assert turned + np.array([x, y, z]) / 1e3 == pytest.approx((target @ [*p, 1.0])[:3], abs=1e-6)


def test_rapid_modules_declare_their_tool():
    program = frame_program(T, "rapid", flange_T_tool=frame(exp_so3([0.0, 0.0, np.pi / 2]), [0.1, -0.02, 0.3]))
    (line,) = [text for text in program.splitlines() if "tooldata" in text]
    assert line.strip().startswith("PERS tooldata tool_robcal := [TRUE,[[100.0000,-20.0000,300.0000],[0.707106781,0.0")
    assert line.count("[") == line.count("]")
    assert program.index("tooldata") < program.index("PROC main()") < program.index("ConfJ")


def test_quaternion_at_the_ends():
    assert quaternion(np.eye(3)) == pytest.approx([1, 0, 0, 0])
    assert np.abs(quaternion(exp_so3([0, 0, np.pi]))) == pytest.approx([0, 0, 0, 1], abs=1e-12)


def test_track_is_the_external_axis():
    model = RobotModel("on track", (Frame("track", "x", prismatic=True), *kr_like().frames))
    q = np.concatenate([[[1.25]], Q[:1]], axis=1)
    assert "E1 1250.0000" in joint_program(model, q, "krl")
    assert "[1250.0000,9E9" in joint_program(model, q, "rapid")
    with pytest.raises(InvalidInput, match="sliding"):
        joint_program(model, q, "urscript")


def test_bad_requests_are_refused():
    with pytest.raises(InvalidInput, match="krl, rapid or urscript"):
        joint_program(kr_like(), Q, "logo")  # type: ignore[arg-type]
    with pytest.raises(InvalidInput, match="program name"):
        frame_program(T, "krl", name="x(); halt")
    with pytest.raises(InvalidInput, match="finite"):
        joint_program(kr_like(), np.full((1, 6), np.nan), "krl")


TOOL = frame_from_xyzrpy([0.1, -0.02, 0.3, 0.2, -0.1, np.pi / 2])


def test_programs_of_frames_drive_the_calibrated_tool_from_a_known_configuration():
    model = kr_like()
    krl, rapid, script = (
        frame_program(T, d, flange_T_tool=TOOL, model=model, q=Q).splitlines() for d in ("krl", "rapid", "urscript")
    )
    (tool,) = [line for line in krl if line.startswith("$TOOL")]
    x, y, z, a, b, c = numbers(tool)
    assert frame_from_xyzrpy([x / 1e3, y / 1e3, z / 1e3, *np.deg2rad([c, b, a])]) == pytest.approx(TOOL, abs=1e-6)
    assert "$BASE = $ROBROOT" in krl
    moves = [line for line in krl if line.startswith("PTP")]
    assert [("E6AXIS" in line) for line in moves] == [True, False, False, False]
    assert numbers(moves[0]) == pytest.approx(np.rad2deg(Q[0]), abs=1e-6)
    assert krl.index(tool) < krl.index(moves[0])
    (tcp,) = [line for line in script if "set_tcp" in line]
    six = numbers(tcp)
    assert frame(exp_so3(six[3:]), six[:3]) == pytest.approx(TOOL, abs=1e-8)
    moves = [line for line in script if "movej" in line]
    assert [("p[" in line) for line in moves] == [False, True, True, True]
    moves = [line for line in rapid if "Move" in line]
    assert [("MoveAbsJ" in line) for line in moves] == [True, False, False, False]


def test_targets_of_a_robot_on_a_track_say_where_the_track_is():
    model = RobotModel("on track", (Frame("track", "x", prismatic=True), *kr_like().frames))
    q = np.concatenate([np.full((4, 1), 1.25), Q], axis=1)
    krl = frame_program(T, "krl", model=model, q=q)
    assert krl.count("E1 1250.0000") == 4
    assert "$BASE = $NULLFRAME" in krl
    assert frame_program(T, "rapid", model=model, q=q).count("[1250.0000,9E9") == 4
    with pytest.raises(InvalidInput, match="sliding"):
        frame_program(T, "urscript", model=model, q=q)


@pytest.mark.parametrize("text", ["prüf_frames", "main", "end", "2 parts", "Straße", "", "日本", "x" * 60, "PTP"])
def test_names_of_files_become_names_that_controllers_take(text):
    name = program_name(text)
    assert re.fullmatch(r"[A-Za-z][A-Za-z0-9_]{0,23}", name)
    assert name.lower() not in RESERVED
    for dialect in ("krl", "rapid", "urscript"):
        assert name in frame_program(T, dialect, name)


@pytest.mark.parametrize("name", ["prüf", "main", "End", "1a"])
def test_names_that_no_controller_takes_are_refused(name):
    with pytest.raises(InvalidInput, match="program name"):
        frame_program(T, "rapid", name)


def test_a_second_reader_finds_tool_base_and_targets():
    """The programs as another parser reads them: joint values first, then every target with the calibrated tool."""
    model = kr_like()
    for dialect in ("krl", "rapid", "urscript"):
        text = frame_program(T, dialect, flange_T_tool=TOOL, model=model, q=Q)
        parser = PARSERS[dialect]
        found = parser(text, np.eye(4)) if dialect == "urscript" else parser(text)
        assert found[0].q == pytest.approx(Q[0], abs=1e-6)
        assert len(found) == len(T)
        for motion, target in zip(found[1:], T[1:], strict=True):
            assert pytest.approx(target, abs=1e-6) == motion.T
            assert motion.tool == pytest.approx(TOOL, abs=1e-6)
            assert motion.base == pytest.approx(np.eye(4))
