"""Exported C: compiled with all warnings as errors and compared with the kernel and the compensation in Python."""

import ctypes
import shutil
import subprocess
from dataclasses import replace

import casadi as ca
import numpy as np
import pytest

from robcal.errors import InvalidInput
from robcal.robot.chain import chain_of, forward
from robcal.robot.compensation import cell_frames, compensate
from robcal.robot.export.c_export import SOURCES, export_c
from robcal.robot.export.c_expressions import function_body, number
from robcal.robot.inverse import inverse_kinematics, select
from robcal.robot.kernel import Kernel
from robcal.robot.model import Frame, RobotModel, Term
from robcal.transforms import difference
from tests.robot.chains import TERMS, random_chain
from tests.robot.test_compensation import ONE_STEP, ROBOTS, real_robot, regular_poses
from tests.robot.test_inverse import random_wrist_arm

pytestmark = pytest.mark.skipif(shutil.which("gcc") is None, reason="needs gcc")
POINTER = ctypes.POINTER(ctypes.c_double)
STRICT = ["-std=c99", "-pedantic", "-Wall", "-Wextra", "-Werror"]
ARMS = ["parallel_23", "meeting_12", "parallel_12", "parallel_arm"]


class Compiled:
    """A shared library of an exported robot."""

    def __init__(self, model: RobotModel, folder, statics: str = "one_step") -> None:
        code = export_c(model, "bot", statics)
        (folder / code.header_name).write_text(code.header)
        (folder / code.source_name).write_text(code.source)
        command = ["gcc", *STRICT, "-O1", "-shared", "-fPIC", "-o", "bot.so", code.source_name, "-lm"]
        done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr[:2000]
        self.library = ctypes.CDLL(str(folder / "bot.so"))
        self.covariates = code.covariates
        self.n = model.n_joints

    def conditions(self, payload=(0.0, 0.0, 0.0, 0.0), covariates=()) -> np.ndarray:
        return np.array([*payload, *covariates, 0.0])

    def forward(self, q: np.ndarray, conditions: np.ndarray) -> np.ndarray:
        out = np.zeros(12)
        self.library.bot_forward(_p(q), _p(conditions), _p(out))
        return np.vstack([out.reshape(3, 4), [0, 0, 0, 1]])

    def command(self, kind: str, T: np.ndarray, conditions: np.ndarray, near: np.ndarray) -> tuple[int, np.ndarray]:
        q = np.zeros(self.n)
        last = [None, None] if kind == "exact" else [None]
        status = getattr(self.library, f"bot_{kind}")(_p(T[:3]), _p(conditions), _p(near), _p(q), *last)
        return status, q

    def nominal_inverse(self, T: np.ndarray, near: np.ndarray) -> tuple[int, np.ndarray]:
        q = np.zeros(self.n)
        return self.library.bot_nominal_inverse(_p(T[:3]), _p(near), _p(q)), q


def _p(a: np.ndarray):
    _p.keep = np.ascontiguousarray(a, dtype=float).ravel() if not a.flags["C_CONTIGUOUS"] else a
    _KEPT.append(_p.keep)
    del _KEPT[:-16]
    return _p.keep.ctypes.data_as(POINTER)


_KEPT: list[np.ndarray] = []


@pytest.mark.parametrize("name", ROBOTS)
def test_commands_agree_with_python(name, tmp_path):
    rng = np.random.default_rng(11)
    model = real_robot(name, rng)
    kernel = Kernel(model)
    bot = Compiled(model, tmp_path)
    q = regular_poses(model, 40, rng)
    load = model.payloads["load"]
    conditions = bot.conditions((load.mass, *load.cog))
    real = kernel.frames(kernel.theta0, kernel.poses(q, "load"))
    for k in range(len(q)):
        assert bot.forward(q[k], conditions) == pytest.approx(real[k], abs=1e-12)
    W, L = cell_frames(kernel)
    wanted = W @ forward(chain_of(model), q) @ L
    for kind, settings in (("first_order", ONE_STEP), ("exact", None)):
        expected = compensate(kernel, wanted, payload="load", near=q, settings=settings)
        answers = [bot.command(kind, wanted[k], conditions, q[k]) for k in range(len(q))]
        assert [status for status, _ in answers] == [0] * len(q)
        commanded = np.array([values for _, values in answers])
        there, here = (kernel.frames(kernel.theta0, kernel.poses(values, "load")) for values in (expected.q, commanded))
        assert np.abs(difference(there, here)).max() < 1e-9
        assert commanded == pytest.approx(expected.q, abs=3e-8)


@pytest.mark.parametrize("kind", ARMS)
def test_closed_form_inverse_of_arbitrary_arms(kind, tmp_path):
    rng = np.random.default_rng(12)
    model = random_wrist_arm(rng, kind)
    chain = chain_of(model)
    bot = Compiled(model, tmp_path)
    q = rng.uniform(-3, 3, (60, 6))
    near = q + 0.01 * rng.normal(size=q.shape)
    T = forward(chain, q)
    expected = select(inverse_kinematics(chain, T, near)).q
    for k in range(len(q)):
        status, values = bot.nominal_inverse(T[k], near[k])
        assert status == 0
        assert values == pytest.approx(expected[k], abs=1e-7)
    T[0, :3, 3] += 100.0
    assert bot.nominal_inverse(T[0], near[0])[0] == 2


@pytest.mark.parametrize("statics", ["one_step", "converged"])
def test_terms_covariates_and_payload_are_exported(statics, tmp_path):
    rng = np.random.default_rng(13)
    model = replace(random_chain(rng), terms=TERMS)
    geometric = [f"{f.name}.{k}" for f in model.frames for k in ("x", "y", "z", "roll", "pitch", "yaw")]
    values = {n: 1e-3 * rng.normal() for n in geometric}
    model = model.with_parameters({**values, "f2.elastic_roll": 1e-6, "gravity.tilt_x": 0.01, "payload.load.mass": 2.0})
    kernel = Kernel(model, statics)
    bot = Compiled(model, tmp_path, statics)
    assert set(bot.covariates) == {"time_s", "approach1"}
    q = rng.uniform(-1, 1, (5, model.n_joints))
    table = {"time_s": rng.uniform(0, 1e4, 5), "approach1": np.array([-1.0, 1.0, 0.0, 1.0, -1.0])}
    expected = kernel.frames(kernel.theta0, kernel.poses(q, "load", table))
    load = model.payloads["load"]
    for k in range(5):
        conditions = bot.conditions((load.mass + 2.0, *load.cog), [table[name][k] for name in bot.covariates])
        assert bot.forward(q[k], conditions) == pytest.approx(expected[k], abs=1e-12)


def test_a_table_of_parameters_replaces_another_at_run_time(tmp_path) -> None:
    model = real_robot("kr150_class", np.random.default_rng(4))
    bot = Compiled(model, tmp_path)
    names = [
        n for n in Kernel(model).names if n in model.parameters and not n.startswith(("payload.", "base.", "tool."))
    ]
    changed = replace(model, parameters={**model.parameters, "axis2.x": 0.0012, "axis3.pitch": -0.003})
    table = (ctypes.c_double * len(names)).in_dll(bot.library, "bot_parameters")
    table[:] = [changed.parameters[name] for name in names]
    kernel = Kernel(changed)
    q = regular_poses(model, 5, np.random.default_rng(1))
    expected = kernel.frames(kernel.theta0, kernel.poses(q))
    for k in range(len(q)):
        assert bot.forward(q[k], bot.conditions()) == pytest.approx(expected[k], abs=1e-12)


def test_every_function_of_the_term_language_reaches_c(tmp_path):
    text = (
        "1e-3*(sin(q1)+cos(q1)+tan(q1/9)+asin(q1/9)+acos(q1/9)+atan(q1)+atan2(q1,2)+sinh(q1)+cosh(q1)+tanh(q1)+exp(q1)"
        "+log(q1**2+1)+sqrt(q1**2+1)+abs(q1)+sign(q1)+minimum(q1,0.5)+maximum(q1,0.5)+where(q1<0.2,q1,2)+step(q1)"
        "+(q1>=0.1)+q1**3+1/(2+q1**2))"
    )
    model = RobotModel("odd", (Frame("a", "z"), Frame("end", xyz=(1, 0, 0))), terms=(Term("t", "a", "q", text),))
    kernel = Kernel(model)
    bot = Compiled(model, tmp_path)
    for value in (-0.7, 0.0, 0.15, 1.3):
        q = np.array([value])
        expected = kernel.frames(kernel.theta0, kernel.poses(q[None]))[0]
        assert bot.forward(q, bot.conditions()) == pytest.approx(expected, abs=1e-13)


def test_hostile_names_stay_inside_comments():
    model = RobotModel("bad */ #error name", (Frame("a", "z"), Frame("end", xyz=(1, 0, 0))))
    code = export_c(model)
    assert "*/ #error" not in code.source
    assert "*/ #error" not in code.header
    with pytest.raises(InvalidInput, match="prefix"):
        export_c(model, "no name")


def test_numbers_that_are_not_finite_are_refused():
    with pytest.raises(InvalidInput, match="not finite"):
        number(float("nan"))
    x = ca.SX.sym("x")
    with pytest.raises(InvalidInput, match="not finite"):
        function_body(ca.Function("f", [x], [x * float("inf")]), ("x",), ("y",))


@pytest.mark.parametrize("kind", [*ARMS, "scara_600", "palletiser"])
def test_c_sources_compile_and_pass_the_linter_as_they_lie_in_the_package(kind, tmp_path):
    """The files in ``c/`` through their own includes, without the export's amalgamation."""
    robot = _arm(kind) if kind in ARMS else real_robot(kind, np.random.default_rng(1))
    code = export_c(robot, "bot")
    (tmp_path / "bot.h").write_text(code.header)
    (tmp_path / "robot_data.h").write_text(code.data)
    places = [f"-I{tmp_path}", f"-I{SOURCES}"]
    places += [f'-D{macro}="{name}"' for macro, name in code.choices.items()]
    commands = [["gcc", *STRICT, "-fsyntax-only"]]
    if shutil.which("cppcheck"):
        quiet = ["--suppress=missingIncludeSystem", "--suppress=unusedFunction", "--inline-suppr"]
        commands.append(["cppcheck", "-q", "--std=c99", "--enable=warning,portability", *quiet, "--error-exitcode=1"])
    for command in commands:
        done = subprocess.run(
            [*command, *places, str(SOURCES / "commands.c")], capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, done.stdout[:2000] + done.stderr[:2000]
    assert 'include "' not in code.source.replace('#include "bot.h"', "")


def test_every_c_source_is_reached_by_some_robot():
    robots = [_arm(kind) for kind in ARMS]
    robots += [real_robot(name, np.random.default_rng(1)) for name in ("scara_600", "palletiser")]
    exported = "".join(export_c(robot, "bot").source for robot in robots)
    for path in SOURCES.iterdir():
        if path.name.endswith((".c", ".h")):
            assert path.read_text().splitlines()[0] in exported, path.name


def _arm(kind: str) -> RobotModel:
    return random_wrist_arm(np.random.default_rng(12), kind)
