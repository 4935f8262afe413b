"""Slips in the recording are named, with the proof; a healthy recording raises no suspicion."""

from dataclasses import replace
from itertools import combinations, permutations

import numpy as np
import pytest

from robcal.calibration.observations import FrameObservations, Observations, PointObservations
from robcal.calibration.recording_errors import (
    RecordingFault,
    empty_readings,
    find_faults,
    frozen_readings,
    outside_limits,
)
from robcal.calibration.recording_errors.joints import listed
from robcal.robot.kernel import Kernel
from robcal.robot.model import Frame, RobotModel
from robcal.transforms import exp_so3, frame, frame_from_xyzrpy, invert, log_so3, rotation_from_rpy, xyzrpy_from_frame
from tests.calibration.scenarios import Scenario, scenario
from tests.robot.chains import kr_like

SENSES = [c for size in range(1, 7) for c in combinations(range(6), size)]


@pytest.fixture(scope="module")
def sound() -> Scenario:
    return scenario(11, compliant=False)


@pytest.fixture(scope="module")
def measured(sound: Scenario) -> FrameObservations:
    return sound.frames(sound.poses)


def _points(frames: FrameObservations, targets: int = 1) -> list[Observations]:
    n = len(frames.pose)
    on_tool = np.array([[0, 0, 0], [0.2, 0, 0], [0, 0.3, 0.05], [0.1, 0.1, 0.2]])[:targets]
    p_world = np.einsum("nij,tj->nti", frames.world_T_tool[:, :3, :3], on_tool) + frames.world_T_tool[:, None, :3, 3]
    C = np.broadcast_to(25e-10 * np.eye(3), (n * targets, 3, 3))
    rows = np.repeat(frames.pose, targets)
    ids = np.tile(np.arange(targets), n)
    return [PointObservations(rows, np.tile(on_tool, (n, 1)), p_world.reshape(-1, 3), C, ids)]


def _found(
    s: Scenario, q: np.ndarray, observed: list[Observations], model: RobotModel | None = None
) -> list[RecordingFault]:
    return find_faults(model or s.model, s.poses.with_q(q), observed)


def _damage(q: np.ndarray, what: str) -> np.ndarray:
    out = q.copy()
    if what == "sign":
        out[:, 2] *= -1
    elif what == "exchange":
        out[:, [1, 3]] = q[:, [3, 1]]
    elif what == "slip":
        out = np.roll(q, 1, axis=0)
    elif what == "late slip":
        out[40:] = np.roll(q[40:], 1, axis=0)
    elif what == "radians":
        out = np.deg2rad(q)
    elif what == "degrees":
        out = np.rad2deg(q)
    return out


EXPECTED = {
    "sign": ("wrong_sign", "axis3"),
    "exchange": ("exchanged_columns", "axis2 and axis4"),
    "slip": ("slipped_rows", "all rows"),
    "late slip": ("slipped_rows", "from row 41"),
    "radians": ("wrong_unit", "all joints"),
    "degrees": ("wrong_unit", "all joints"),
}


@pytest.mark.parametrize("what", EXPECTED)
@pytest.mark.parametrize("targets", [0, 1, 4])
def test_slip_of_the_log_is_named(sound: Scenario, measured: FrameObservations, what: str, targets: int) -> None:
    observed: list[Observations] = _points(measured, targets) if targets else [measured]
    slips = _found(sound, _damage(sound.poses.q, what), observed)
    assert (slips[0].kind, slips[0].where) == EXPECTED[what]
    assert slips[0].rms_after < 0.25 * slips[0].rms_before
    assert "correcting" in slips[0].statement
    assert len(slips) == 1


@pytest.mark.parametrize(
    "wrong", [pytest.param(s, marks=[pytest.mark.slow] * (3 <= len(s) <= 5)) for s in SENSES], ids=str
)
def test_every_set_of_wrong_senses(sound: Scenario, measured: FrameObservations, wrong: tuple[int, ...]) -> None:
    q = sound.poses.q.copy()
    q[:, list(wrong)] *= -1
    named = {slip.where: slip for slip in _found(sound, q, [measured])}
    # all axes lie in one plane: a mirror image is the same as wrong senses of the joints across it
    assert set(named) - {"measurements"} == {listed([f"axis{k + 1}" for k in wrong])}
    assert ("measurements" in named) == (set(wrong) == {0, 3, 5})


@pytest.mark.parametrize(("k", "j"), list(permutations(range(6), 2)))
@pytest.mark.parametrize("by", [1.0, -1.0])
def test_couplings(sound: Scenario, measured: FrameObservations, k: int, j: int, by: float) -> None:
    q = sound.poses.q.copy()
    q[:, k] -= by * q[:, j]
    slips = _found(sound, q, [measured])
    assert slips[0].kind == "coupled_joints"
    assert f"its angle is q{k + 1} {'+' if by > 0 else '-'} q{j + 1}" in slips[0].statement


@pytest.mark.parametrize("what", ["coupling", "sense"])
def test_faults_that_few_poses_show_where_one_joint_moves_after_the_other(sound: Scenario, what: str) -> None:
    q = np.tile(np.radians([10.0, 20.0, -15.0, 30.0, 40.0, 50.0]), (42, 1))
    for joint in range(6):
        q[7 * joint : 7 * joint + 7, joint] += np.radians(np.linspace(-40, 40, 7))
    poses = sound.poses.subset(np.arange(42)).with_q(q)
    written = q.copy()
    if what == "coupling":
        written[:, 2] -= q[:, 1]
    else:
        written[:, 4] *= -1.0
    assert find_faults(sound.model, poses, [sound.frames(poses)]) == []
    fault = find_faults(sound.model, poses.with_q(written), [sound.frames(poses)])[0]
    assert fault.kind == ("coupled_joints" if what == "coupling" else "wrong_sign")
    assert fault.where == ("axis3 and axis2" if what == "coupling" else "axis5")


@pytest.mark.parametrize("offsets", [{1: 90.0}, {2: -90.0}, {4: 90.0}, {1: -90.0, 2: 90.0}, {2: 37.0}])
def test_zeros_of_any_size_are_told_with_start_values(
    sound: Scenario, measured: FrameObservations, offsets: dict[int, float]
) -> None:
    q = sound.poses.q.copy()
    for k, value in offsets.items():
        q[:, k] -= np.radians(value)
    (slip,) = _found(sound, q, [measured])
    assert slip.kind == "zero"
    assert slip.legitimate
    kinds = [f.joint_kind for f in sound.model.joints]
    assert set(slip.values) == {f"axis{k + 1}.{kinds[k]}" for k in offsets}
    for k, value in offsets.items():
        assert np.degrees(slip.values[f"axis{k + 1}.{kinds[k]}"]) == pytest.approx(value, abs=0.5)


@pytest.mark.parametrize("rows", [[(10, 50)], [(3, 4)], [(5, 70), (20, 21)]])
def test_exchanged_rows(sound: Scenario, measured: FrameObservations, rows: list[tuple[int, int]]) -> None:
    q = sound.poses.q.copy()
    for i, k in rows:
        q[[i, k]] = q[[k, i]]
    (slip,) = _found(sound, q, [measured])
    assert slip.kind == "exchanged_rows"
    for i, k in rows:
        assert f"{i + 1} and {k + 1}" in slip.statement


def test_a_few_shifted_rows(sound: Scenario, measured: FrameObservations) -> None:
    q = sound.poses.q.copy()
    q[60:68] = sound.poses.q[61:69]
    (slip,) = _found(sound, q, [measured])
    assert slip.kind == "slipped_rows"
    assert "rows 61 to 68" in slip.statement


@pytest.mark.parametrize(("at", "axis"), [(0, "x"), (1, "x"), (2, "z"), (3, "z"), (4, "x"), (5, "y")])
def test_axis_of_the_robot_file(sound: Scenario, measured: FrameObservations, at: int, axis: str) -> None:
    frames = list(sound.model.frames)
    right = frames[at].axis
    frames[at] = replace(frames[at], axis=axis)
    slips = _found(sound, sound.poses.q, [measured], replace(sound.model, frames=tuple(frames)))
    assert (slips[0].kind, slips[0].where) == ("axis", frames[at].name)
    assert f"moves about {right}, not {axis}" in slips[0].statement


@pytest.mark.parametrize(("at", "along", "by"), [(2, 0, 0.27), (1, 0, -0.1), (4, 0, 0.08)])
def test_length_of_the_robot_file(sound: Scenario, measured: FrameObservations, at: int, along: int, by: float) -> None:
    frames = list(sound.model.frames)
    xyz = np.array(frames[at].xyz)
    xyz[along] += by
    frames[at] = replace(frames[at], xyz=tuple(xyz.tolist()))
    slips = _found(sound, sound.poses.q, [measured], replace(sound.model, frames=tuple(frames)))
    assert slips[0].kind == "length"
    assert slips[0].legitimate
    ((name, value),) = slips[0].values.items()
    assert name.endswith(f".{'xyz'[along]}")
    assert value == pytest.approx(-by, abs=5e-3)


def _rotation(order: str, angles: np.ndarray) -> np.ndarray:
    R = np.eye(3)
    for axis, angle in zip(order, angles, strict=True):
        R = R @ rotation_from_rpy([angle if axis == k else 0.0 for k in "xyz"])
    return R


def _angles(order: str, R: np.ndarray) -> np.ndarray:
    """Angles of R = R_1(a) R_2(b) R_3(c), in closed form for all twelve orders."""
    i, j, k = ("xyz".index(c) for c in order)
    proper = i == k
    third = 3 - i - j if proper else k
    sign = float((i - j) * (j - third) * (third - i)) / 2.0
    if proper:
        b = np.arccos(np.clip(R[i, i], -1, 1))
        return np.array([np.arctan2(R[j, i], -sign * R[third, i]), b, np.arctan2(R[i, j], sign * R[i, third])])
    b = np.arcsin(np.clip(sign * R[i, k], -1, 1))
    return np.array([np.arctan2(-sign * R[j, k], R[k, k]), b, np.arctan2(-sign * R[i, j], R[i, i])])


ORDERS = ["xyz", "xzy", "yxz", "yzx", "zxy", "zyx", "zyz", "zxz", "xyx", "xzx", "yxy", "yzy"]


@pytest.mark.parametrize("order", ORDERS)
@pytest.mark.parametrize("inverse", [False, True])
def test_orders_of_angles(sound: Scenario, measured: FrameObservations, order: str, inverse: bool) -> None:
    T = invert(measured.world_T_tool) if inverse else measured.world_T_tool
    angles = np.array([_angles(order, R) for R in T[:, :3, :3]])
    assert np.abs([_rotation(order, a) - R for a, R in zip(angles, T[:, :3, :3], strict=True)]).max() < 1e-9
    read = frame(rotation_from_rpy(angles), T[:, :3, 3])
    slips = _found(sound, sound.poses.q, [replace(measured, world_T_tool=read, stated_angles=angles)])
    told = f"of the order {' '.join(order.upper())} about moving axes"
    if inverse:
        assert slips[0].kind == "inverted_frames"
        assert "inverted" in slips[0].statement
        assert order == "zyx" or told in slips[0].statement
    else:
        assert slips[0].kind in ("orientation", "measured_columns")
        assert told in slips[0].statement or (order == "zyx" and "roll, yaw are exchanged" in slips[0].statement)


def test_rotation_vectors_transposed_and_inverse(sound: Scenario, measured: FrameObservations) -> None:
    T = measured.world_T_tool
    vectors = log_so3(T[:, :3, :3])
    assert np.allclose(exp_so3(vectors), T[:, :3, :3])
    transposed = xyzrpy_from_frame(frame(np.swapaxes(T[:, :3, :3], 1, 2), T[:, :3, 3]))
    for six, word in (
        (np.column_stack([T[:, :3, 3], vectors]), "rotation vectors"),
        (transposed, "transposed"),
        (xyzrpy_from_frame(invert(T)), "inverted"),
    ):
        read = replace(measured, world_T_tool=frame_from_xyzrpy(six), stated_angles=six[:, 3:])
        assert word in _found(sound, sound.poses.q, [read])[0].statement


def test_health_raises_no_suspicion_and_chaos_no_false_slip() -> None:
    s = scenario(12)
    observed = s.frames(s.poses)
    assert find_faults(s.model, s.poses, [observed]) == []
    chaos = s.poses.with_q(s.rng.permutation(s.poses.q))
    assert find_faults(s.model, chaos, [observed]) == []


def test_blunders_are_no_slip(sound: Scenario, measured: FrameObservations) -> None:
    T = measured.world_T_tool.copy()
    T[[3, 40, 60], :3, 3] += 0.5
    assert _found(sound, sound.poses.q, [replace(measured, world_T_tool=T)]) == []


def test_limits() -> None:
    frames = kr_like().frames
    model = kr_like(frames=(replace(frames[0], limits=(-1.0, 1.0)), *frames[1:]))
    kernel = Kernel(model)
    assert outside_limits(model, kernel.poses([[0.5] * 6, [1.5] + [0.0] * 5])) == [(1, "axis1", 1.5)]
    assert isinstance(frames[0], Frame)


def _read_wrongly(six: np.ndarray, what: str) -> np.ndarray:
    out = six.copy()
    if what == "x, y are exchanged":
        out[:, [0, 1]] = six[:, [1, 0]]
    elif what == "z has the wrong sign":
        out[:, 2] *= -1
    elif what == "x and z have the wrong sign":
        out[:, [0, 2]] *= -1
    elif what == "yaw has the wrong sign":
        out[:, 5] *= -1
    elif what == "radians":
        out[:, 3:] = np.deg2rad(six[:, 3:])
    elif what == "inches":
        out[:, :3] /= 25.4
    return out


@pytest.mark.parametrize(
    "what",
    [
        "x and y are exchanged",
        "z has the wrong sign",
        "x and z have the wrong sign",
        "yaw has the wrong sign",
        "radians",
        "inches",
    ],
)
def test_columns_of_measured_frames(sound: Scenario, measured: FrameObservations, what: str) -> None:
    key = "x, y are exchanged" if what.startswith("x and y") else what
    six = _read_wrongly(xyzrpy_from_frame(measured.world_T_tool), key)
    read = replace(measured, world_T_tool=frame_from_xyzrpy(six), stated_angles=six[:, 3:])
    slips = _found(sound, sound.poses.q, [read])
    assert slips[0].kind == ("measured_unit" if what in ("radians", "inches") else "measured_columns")
    assert what in slips[0].statement


@pytest.mark.parametrize("targets", [1, 4])
def test_mirrored_points(sound: Scenario, measured: FrameObservations, targets: int) -> None:
    (points,) = _points(measured, targets)
    assert isinstance(points, PointObservations)
    slips = _found(sound, sound.poses.q, [replace(points, p_world=points.p_world[:, [1, 0, 2]])])
    assert any(slip.kind == "measured_columns" and "mirror" in slip.statement for slip in slips)


def test_empty_readings() -> None:
    rows = np.array([[0, 0, 0], [1, 2, 3], [-999, -999, -999], [9999, 9999, 9999], [5, 5, 5], [0, 0, 1]])
    assert empty_readings(rows).tolist() == [True, False, True, True, False, False]
    assert empty_readings(np.array([[0.0], [999.0], [99999.0]])).tolist() == [True, False, True]


def test_frozen_readings() -> None:
    places = np.array([[0, 0, 0], [1, 0, 0], [1, 0, 0], [2, 0, 0.0]])
    readings = np.array([[1, 2, 3.0], [1, 2, 3], [4, 5, 6], [4, 5, 6]])
    assert frozen_readings(np.arange(4), readings, places).tolist() == [False, True, False, True]
    # the robot stood still: an exact repeat
    assert not frozen_readings(np.array([1, 2]), readings[:2], places).any()
