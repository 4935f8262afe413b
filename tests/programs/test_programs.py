"""Programs of every dialect: corrected right, by a second reader and the robot's own forward model, or refused."""

import re
from typing import Any

import numpy as np
import pytest

from fixtures.rigid import Array, frame_from_six
from robcal.files.robot_import import read_any_robot
from robcal.programs.correction import Corrected, GivenFrames, correct
from robcal.programs.dialects import COMMENTS, read_program
from robcal.programs.text import MARK, SHORT_MARK, Refusal, Source
from robcal.robot.chain import chain_of, forward
from robcal.robot.kernel import Kernel
from robcal.robot.model import Frame, RobotModel
from tests.programs import fanuc_programs, krl_programs, rapid_programs, urscript_programs
from tests.programs.scenes import DESCRIPTION, DEVIATIONS, FRAMES, Q, filled, nominal, true, turn, written
from tests.programs.small_parser import PARSERS, Motion

TOOLS = {"1": FRAMES["a"], "2": FRAMES["b"], "tOther": FRAMES["b"], "active": FRAMES["b"]}
BASES = {"1": FRAMES["c"], "2": FRAMES["c"], "3": FRAMES["d"], "wOther": FRAMES["d"]}
OF_FANUC = {"1": FRAMES["c"], "2": FRAMES["d"]}
EXACT = {"krl": 3e-7, "rapid": 3e-7, "urscript": 3e-7, "fanuc": 3e-5}
"""m and rad by which the written digits may miss."""


def _model() -> RobotModel:
    frames = tuple(
        Frame(
            f["name"],
            f["axis"],
            sign=f.get("sign", 1),
            limits=tuple(np.radians(f["range_deg"])) if "range_deg" in f else None,
            xyz=tuple(np.array(f["xyz_mm"]) / 1e3),
            rpy=tuple(np.radians(f.get("rpy_deg", [0, 0, 0]))),
            mass=f.get("mass_kg", 0.0),
            cog=tuple(np.array(f.get("cog_mm", [0, 0, 0])) / 1e3),
        )
        for f in DESCRIPTION["frames"]
    )
    return RobotModel("robot", frames, parameters=DEVIATIONS)


@pytest.fixture(scope="module")
def kernel() -> Kernel:
    return Kernel(_model(), "converged")


def correct_text(dialect: str, text: str, kernel: Kernel, dat: str = "", **given: Any) -> Corrected:
    source, data = Source("in", text), Source("in.dat", dat) if dat else None
    frames = GivenFrames(
        given.get("tools", TOOLS),
        given.get("bases", OF_FANUC if dialect == "fanuc" else BASES),
        given.get("robot_base", False),
    )
    return correct(read_program(dialect, source, data), kernel, frames, near=Q[0])


def commanded(motion: Motion, near: Array) -> Array:
    """Joint values that a controller finds which believes the nominal robot."""
    if motion.q is not None:
        return motion.q
    assert motion.T is not None
    wanted = motion.base @ motion.T @ np.linalg.inv(motion.tool)
    q = near.copy()
    for _ in range(8):
        T = nominal(np.concatenate([[q], q + 1e-6 * np.eye(6)]))
        miss = _twist(T[0], wanted)
        if np.max(np.abs(miss)) < 1e-10:
            break
        J = np.array([_twist(T[0], step) for step in T[1:]]).T / 1e-6
        q = q + np.linalg.solve(J, miss)
    return q


def _twist(a: Array, b: Array) -> Array:
    d = np.linalg.inv(a) @ b
    return np.array([*d[:3, 3], d[2, 1] - d[1, 2], d[0, 2] - d[2, 0], d[1, 0] - d[0, 1]]) * [1, 1, 1, 0.5, 0.5, 0.5]


def motions(dialect: str, text: str, dat: str) -> list[Motion]:
    parser: Any = PARSERS[dialect]
    tools, bases = {1: FRAMES["a"], 2: FRAMES["b"]}, {2: FRAMES["c"], 3: FRAMES["d"]}
    if dialect == "krl":
        return parser(text, dat, tools, bases)
    if dialect == "rapid":
        return parser(text, {"tOther": FRAMES["b"]}, {"wOther": FRAMES["d"]})
    if dialect == "fanuc":
        if "PR[5,6]" in text:
            tools = {1: frame_from_six([0.1, -0.02, 0.2505, 0, 0, np.pi / 2])}
        return parser(text, tools, {1: FRAMES["c"], 2: FRAMES["d"]})
    return parser(text, FRAMES["b"])


def check(dialect: str, name: str, text: str, dat: str, kernel: Kernel) -> None:
    """Every motion of the corrected program brings the real tool where the nominal robot's would have been."""
    found = correct_text(dialect, text, kernel, dat)
    before = motions(dialect, text, dat)
    after = motions(dialect, found.texts[0], found.texts[1] if dat else "")
    assert len(before) == len(after) >= 1
    moved = 0
    for old, new in zip(before, after, strict=True):
        assert new.tool == pytest.approx(old.tool, abs=1e-12)
        q = commanded(old, _near(old))
        assert _reached(new, q, nominal(q)[0] @ old.tool, old.tool) < EXACT[dialect]
        changed = new.T if new.T is not None else new.q
        moved += not np.allclose(changed, old.T if old.T is not None else old.q, atol=1e-6)
    assert moved == len(before)


def _near(motion: Motion) -> Array:
    """The posture whose flange is nearest to a target."""
    if motion.T is None:
        return Q[0]
    wanted = motion.base @ motion.T @ np.linalg.inv(motion.tool)
    return Q[int(np.argmin([np.linalg.norm(_twist(T, wanted)) for T in nominal(Q)]))]


def _reached(new: Motion, near: Array, wanted: Array, tool: Array) -> float:
    q = commanded(new, near)
    return float(np.max(np.abs(_twist(wanted, true(q)[0] @ tool)))) if np.all(np.isfinite(q)) else np.inf


def skeleton(text: str, comment: str) -> str:
    """A program without its numbers and without the mark."""
    lines = [line for line in text.splitlines(keepends=True) if SHORT_MARK not in line.partition(comment)[2]]
    return re.sub(r"(?<![\w.])[-+ ]*(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?", "#", "".join(lines))


CASES = [("krl", name, *parts) for name, parts in krl_programs.GOOD.items()]
CASES += [("rapid", name, text, "") for name, text in rapid_programs.GOOD.items()]
CASES += [("urscript", name, text, "") for name, text in urscript_programs.GOOD.items()]
CASES += [("fanuc", name, text, "") for name, text in fanuc_programs.GOOD.items()]
CASES = [(dialect, name, filled(text, dialect), filled(dat, dialect)) for dialect, name, text, dat in CASES]
REFUSED = [("krl", name, *parts) for name, parts in krl_programs.REFUSED.items()]
for _dialect, _module in (("rapid", rapid_programs), ("urscript", urscript_programs), ("fanuc", fanuc_programs)):
    REFUSED += [(_dialect, name, text, "", line, why) for name, (text, line, why) in _module.REFUSED.items()]
REPLACED = {"shifts", "offsets", "feature", "degrees"}
"""Programs with expressions that are replaced by numbers."""


@pytest.mark.parametrize(("dialect", "name", "text", "dat"), CASES, ids=[f"{c[0]}-{c[1]}" for c in CASES])
def test_every_motion_brings_the_real_tool_where_it_should_be(
    dialect: str, name: str, text: str, dat: str, kernel: Kernel
) -> None:
    check(dialect, name, text, dat, kernel)


@pytest.mark.parametrize(("dialect", "name", "text", "dat"), CASES, ids=[f"{c[0]}-{c[1]}" for c in CASES])
def test_all_else_stays_byte_for_byte(dialect: str, name: str, text: str, dat: str, kernel: Kernel) -> None:
    found = correct_text(dialect, text, kernel, dat)
    marked = 0
    for old, new in zip([text, dat], found.texts, strict=False):
        extra = new.count("\n") - old.count("\n")
        assert extra in (0, 1)
        marked += extra
        assert new.count("\r\n") == (new.count("\n") if "\r\n" in old else 0)
        if name not in REPLACED:
            assert skeleton(new, COMMENTS[dialect]) == skeleton(old, COMMENTS[dialect])
    assert marked >= 1
    with pytest.raises(Refusal, match="corrected already"):
        correct_text(dialect, found.texts[0], kernel, dat)


@pytest.mark.parametrize(
    ("dialect", "name", "text", "dat", "line", "why"), REFUSED, ids=[f"{c[0]}-{c[1]}" for c in REFUSED]
)
def test_what_cannot_be_corrected_right_is_refused_with_its_line(
    dialect: str, name: str, text: str, dat: str, line: int, why: str, kernel: Kernel
) -> None:
    with pytest.raises(Refusal) as caught:
        correct_text(dialect, filled(text, dialect), kernel, filled(dat, dialect))
    assert f"line {line}:" in str(caught.value), str(caught.value)
    assert why in str(caught.value)


@pytest.mark.parametrize(
    ("dialect", "text", "says"),
    [
        ("krl", "DEF a()\nBAS(#TOOL,1)\nBAS(#BASE,2)\nLIN {@F0:a:c@}\nEND\n", ["--tool 1=FILE", "--base 2=FILE"]),
        ("krl", "DEF a()\nLIN {@F0@}\nEND\n", ["sets no tool", "--tool active=FILE", "--base active=FILE"]),
        ("rapid", rapid_programs.GOOD["tool_of_another_module"], ["--tool tOther=FILE", "--base wOther=FILE"]),
        ("urscript", "movel(p[@F0@])\n", ["--tool active=FILE"]),
        ("fanuc", fanuc_programs.GOOD["two_tools"], ["--tool 2=FILE", "--base 2=FILE"]),
    ],
)
def test_frames_that_the_program_only_names_are_asked_for(
    dialect: str, text: str, says: list[str], kernel: Kernel
) -> None:
    with pytest.raises(Refusal) as caught:
        correct_text(dialect, filled(text, dialect), kernel, tools={}, bases={})
    assert all(part in str(caught.value) for part in says), str(caught.value)


def test_bases_may_be_the_robots_own(kernel: Kernel) -> None:
    text = filled("DEF a()\nBAS(#TOOL,1)\nLIN {@F0:a@}\nEND\n", "krl")
    found = correct_text("krl", text, kernel, bases={}, robot_base=True)
    named = correct_text("krl", text, kernel, bases={"active": np.eye(4)})
    assert found.texts == named.texts


def test_status_and_turn_follow_an_axis_over_zero(kernel: Kernel) -> None:
    """A target whose axis 4 the correction takes over zero would else be driven to by a whole turn."""
    q = np.radians([20, -50, 95, 0.0, 40, -60])
    for sign in (1, -1):
        q[3] = sign * 2e-4
        T = nominal(q)[0]
        text = f"DEF a()\n$TOOL=$NULLFRAME\n$BASE=$NULLFRAME\nPTP {{{written(T, 'krl')}, S 2, T {turn(q)}}}\nEND\n"
        found = correct_text("krl", text, kernel)
        body = re.search(r"PTP .*", found.texts[0])
        assert body is not None
        new = commanded(motions("krl", found.texts[0], "")[0], q)
        assert f"T {turn(new)}}}" in body[0]


def test_the_mark_stands_at_the_top(kernel: Kernel) -> None:
    top = {"frames_in_place": 0, "names_in_data": 3}
    for name, line in top.items():
        text, dat = (filled(t, "krl") for t in krl_programs.GOOD[name])
        assert correct_text("krl", text, kernel, dat).texts[0].splitlines()[line] == f"; {MARK}"
    rapid = correct_text("rapid", filled(rapid_programs.GOOD["named"], "rapid"), kernel)
    assert rapid.texts[0].startswith(f"! {MARK}\n")
    fanuc = correct_text("fanuc", filled(fanuc_programs.GOOD["crlf"], "fanuc"), kernel)
    assert f"/MN\r\n    :  !{SHORT_MARK} ;\r\n   1:J" in fanuc.texts[0]


@pytest.mark.parametrize("dialect", ["krl", "rapid"])
def test_the_configuration_that_a_target_states_is_kept(dialect: str, kernel: Kernel) -> None:
    """A flipped wrist, far from where the robot was before, as turn or quadrants say."""
    q = np.radians([20, -50, 95, -145, -40, 120])
    quarters = [int(np.floor(v / (np.pi / 2))) for v in q[[0, 3, 5]]]
    place = written(nominal(q)[0], dialect)
    free = ",".join(["9E9"] * 6)
    text = (
        f"DEF a()\n$TOOL=$NULLFRAME\n$BASE=$NULLFRAME\nPTP {{{place}, S 6, T {turn(q)}}}\nEND\n"
        if dialect == "krl"
        else f"MoveJ [{place},[{quarters[0]},{quarters[1]},{quarters[2]},0],[{free}]],v100,fine,tool0;\n"
    )
    found = correct_text(dialect, text, kernel)
    new = commanded(motions(dialect, found.texts[0], "")[0], q)
    assert found.notes == ()
    assert np.max(np.abs(_twist(nominal(q)[0], true(new)[0]))) < EXACT[dialect]


@pytest.mark.parametrize(
    ("name", "q", "external"),
    [
        ("scara_600", [0.3, 0.8, 0.05, 0.2], ""),
        ("kr150_class_on_track", [1, 0.3, -0.9, 1.6, 0.5, 0.6, -0.7], ", E1 1000"),
    ],
)
def test_other_arms(name: str, q: list[float], external: str) -> None:
    """An arm of four joints, and one on a track that stands where the target says."""
    model = read_any_robot(f"configs/robots/{name}.yaml")
    T = forward(chain_of(model), np.array([q]))[0]
    text = f"$TOOL=$NULLFRAME\n$BASE=$NULLFRAME\nLIN {{{written(T, 'krl')}{external}}}\n"
    off = Kernel(model.with_parameters({f"{model.joints[1].name}.x": 1e-3}))
    found = correct(read_program("krl", Source("in", text)), off, GivenFrames({}, {}), near=q)
    assert np.linalg.norm(found.before[0, :3]) == pytest.approx(1e-3, abs=1e-5)
    assert np.max(np.abs(found.remaining[0, :3])) < 1e-8
    assert external in found.texts[0]


def test_numbers_beyond_all_measure_are_refused(kernel: Kernel) -> None:
    with pytest.raises(Refusal, match="line 2: the number 1e999"):
        correct_text("krl", "DEF a()\nPTP {A1 1e999,A2 0,A3 0,A4 0,A5 0,A6 0}\nEND\n", kernel)


def test_columns_of_numbers_stay_columns(kernel: Kernel) -> None:
    text = filled(fanuc_programs.GOOD["motions"], "fanuc")
    new = correct_text("fanuc", text, kernel).texts[0].splitlines()
    for line in text.splitlines():
        if " mm," in line or " deg," in line:
            assert any([m.end() for m in re.finditer(r"(mm|deg)", other)] == [m.end() for m in re.finditer(r"(mm|deg)", line)] for other in new)  # fmt: skip  # noqa: E501


def test_routines_that_call_each_other_many_times_are_read_at_once() -> None:
    calls = "  part()\n" * 30
    read = read_program(
        "urscript", Source("part.script", f"def part():\n{calls}  movej([0, 0, 0, 0, 1, 0])\n{calls}end\n")
    )
    assert len(read.targets) == 1
