"""Several instruments in one identification: truth recovered, priors, shared frames, honest covariances."""

from dataclasses import replace

import numpy as np
import pytest

from robcal import transforms as tf
from robcal.calibration.identification import IdentifyOptions, identify
from robcal.calibration.instruments import CellFrame, Instrument, identify_instruments
from robcal.calibration.instruments.evaluator import JointEvaluator, Part
from robcal.calibration.joint_log import JointLog
from robcal.calibration.measurements import RobotObservations, RobotRecording
from robcal.calibration.observations import DistanceObservations, FrameObservations
from robcal.calibration.problem import State
from robcal.calibration.wire import LIMITS
from tests.calibration.scenarios import Scenario, scenario

GEOMETRY = IdentifyOptions(parameters="geometry")
WIRE = tf.frame(np.eye(3), [-2.2, 1.4, -0.2])
SIGMA, TURN = 5e-5, 1e-4


def _log(s: Scenario) -> JointLog:
    n = len(s.poses)
    names, load = list(s.model.payloads), s.poses.load
    payload = tuple(names[int(np.argmax(row))] if row.any() else None for row in load)
    return JointLog(tuple(f"p{k}" for k in range(n)), s.poses.q, payload, np.zeros(n, bool), np.zeros(s.poses.q.shape))


def _instrument(name: str, made: RobotObservations, **frames: CellFrame) -> Instrument:
    return Instrument(
        name,
        RobotRecording((made,), (made,), True),
        frames.get("world", CellFrame(name, "base")),
        frames.get("tool", CellFrame(name, "tool")),
    )


def _frames(s: Scenario, rng: np.random.Generator) -> FrameObservations:
    noise = rng.standard_normal((len(s.poses), 6)) * np.repeat([SIGMA, TURN], 3)
    moved = tf.retract(s.truth.frames(s.theta, s.poses), noise)
    return FrameObservations.isotropic(moved, SIGMA, TURN)


def _lengths(s: Scenario, rng: np.random.Generator) -> DistanceObservations:
    places = (WIRE @ tf.invert(s.truth.world_T_base) @ s.truth.frames(s.theta, s.poses))[:, :3, 3]
    n = len(places)
    d = np.linalg.norm(places, axis=1) + SIGMA * rng.standard_normal(n)
    return DistanceObservations(np.arange(n), d, np.full(n, SIGMA))


def test_one_instrument_of_which_nothing_is_known_gives_the_same_robot_as_before() -> None:
    s = scenario(1, n=40)
    frames = _frames(s, np.random.default_rng(0))
    plain = identify(s.model, _log(s).inputs(s.kernel), [frames], GEOMETRY)
    found = identify_instruments(s.model, _log(s), [_instrument("a", frames)], GEOMETRY).placed["a"].robot
    assert found is not None
    assert set(found.names) == set(plain.names)
    assert np.allclose(found.model.world_T_base, plain.model.world_T_base, atol=1e-7)
    sigma = dict(zip(found.names, found.sigma, strict=True))
    assert np.allclose([sigma[n] for n in plain.names], plain.sigma, rtol=1e-3)


def test_derivatives_of_all_parameters_agree_with_differences() -> None:
    s = scenario(2, n=6)
    rng = np.random.default_rng(0)
    inputs = _log(s).inputs(s.kernel)
    by_angles = CellFrame("a", "base", (0.1, 0.2, 0.3, 0.2, -0.4, 0.5), (np.inf, 0.0, np.inf, np.inf, 1e-3, 0.0))
    tool = CellFrame("a", "tool", (0.1, 0.0, 0.2, 0.1, 0.2, 0.3), (1e-3,) * 3 + (1e-3,) * 3)
    parts = [
        Part("a", inputs, (_frames(s, rng),), by_angles, tool),
        Part("wire", inputs, (_lengths(s, rng),), CellFrame("wire", "base"), tool, tuple(LIMITS)),
    ]
    evaluator = JointEvaluator(s.kernel, parts)
    frames = [tf.frame_from_xyzrpy(e.given) for e in (by_angles, tool)]
    evaluator.theta0[-len(LIMITS) :] = [0.03, 2e-5, 3e-4, 5e-4, 2e-3]
    state = State(evaluator.theta0 + 0.0, np.array([frames[0], WIRE]), np.array([frames[1]]))
    at = evaluator(state)
    for name, k in evaluator.index.items():
        if ".elastic_" in name or name.startswith(("base.", "tool.")):
            continue
        moved = []
        for sign in (1.0, -1.0):
            theta = state.theta.copy()
            theta[k] += sign * 1e-6
            moved.append(evaluator(evaluator.fold(theta, state)))
        if ".wire." in name:  # no motion of the tool: only the count changes
            slope = np.einsum("ndk,nk->nd", at.B, at.J[:, :, k])
            assert np.allclose((moved[1].r - moved[0].r) / 2e-6, slope, rtol=1e-5, atol=1e-6), name
            continue
        difference = tf.difference(moved[1].T, moved[0].T) / 2e-6
        assert np.allclose(difference, at.J[:, :, k], atol=5e-6), name


def test_each_instrument_is_weighted_as_it_scatters() -> None:
    s = scenario(3, n=60)
    rng = np.random.default_rng(1)
    frames, lengths = _frames(s, rng), _lengths(s, rng)
    wrong = replace(lengths, sigma=lengths.sigma / 4.0)
    found = identify_instruments(
        s.model, _log(s), [_instrument("tracker", frames), _instrument("wire", wrong)], IdentifyOptions()
    )
    assert found.placed["tracker"].variance == 1.0
    assert found.placed["wire"].sigma0 == pytest.approx(4.0, rel=0.3)
    weighted = found.placed["wire"].recording.observations[0]
    assert np.mean(weighted.sigma) == pytest.approx(SIGMA, rel=0.3)


def test_what_is_known_of_a_frame_holds_coordinate_by_coordinate() -> None:
    s = scenario(4, n=40)
    true = tf.xyzrpy_from_frame(s.truth.world_T_base)
    known = CellFrame("a", "base", (*true[:2], np.nan, np.nan, np.nan, np.nan), (0.0, 1e-6, *(np.inf,) * 4))
    frames = _frames(s, np.random.default_rng(2))
    placed = identify_instruments(s.model, _log(s), [_instrument("a", frames, world=known)], GEOMETRY).placed["a"]
    at = tf.xyzrpy_from_frame(placed.world_T_base)
    assert at[0] == pytest.approx(true[0], abs=1e-12)
    assert at[1] == pytest.approx(true[1], abs=1e-5)
    assert 1e-7 < abs(at[2] - true[2]) < 1e-2


def test_known_base_and_tool_leave_the_zero_offsets_of_all_joints() -> None:
    """``world_T_tool = world_T_base T(q + dq) flange_T_tool`` solved for dq over several poses (mastering)."""
    s = scenario(5, compliant=False, n=8, scale=0.0)
    sizes = (3e-3, -2e-3, 1e-3, 4e-3, -3e-3, 2e-3)
    zeros = {f"{f.name}.{f.joint_kind}": v for f, v in zip(s.model.joints, sizes, strict=True)}
    noise = np.random.default_rng(3).standard_normal((8, 6)) * np.repeat([SIGMA, TURN], 3)
    measured = tf.retract(s.truth.frames(s.truth.theta(zeros), s.poses), noise)
    frames = FrameObservations.isotropic(measured, SIGMA, TURN)
    ends = (("world", "base", s.truth.world_T_base), ("tool", "tool", s.truth.flange_T_tool))
    fixed = {key: CellFrame("a", end, tuple(tf.xyzrpy_from_frame(T)), (0.0,) * 6) for key, end, T in ends}
    options = IdentifyOptions(parameters=tuple(zeros), robust=False, covariance="stated")
    found = identify_instruments(s.model, _log(s), [_instrument("a", frames, **fixed)], options).placed["a"].robot
    assert found is not None
    assert set(found.names) == set(zeros)
    off = [(found.values[n] - v) / sigma for (n, v), sigma in zip(zeros.items(), found.sigma, strict=True)]
    assert np.abs(off).max() < 3.5
    assert found.sigma.max() < 1.5e-4


def test_instruments_share_a_tool_on_request() -> None:
    s = scenario(6, n=60)
    rng = np.random.default_rng(4)
    tool = CellFrame("tracker", "tool")
    both = [_instrument("tracker", _frames(s, rng), tool=tool), _instrument("wire", _lengths(s, rng), tool=tool)]
    found = identify_instruments(s.model, _log(s), both, GEOMETRY)
    assert np.array_equal(found.placed["wire"].flange_T_tool, found.placed["tracker"].flange_T_tool)
    assert found.placed["wire"].held == ("world_T_base.roll", "world_T_base.pitch", "world_T_base.yaw")


def test_priors_are_about_what_the_file_of_the_robot_says() -> None:
    s = scenario(6, n=30)
    model = s.model.with_parameters({"axis3.x": 7e-4})
    options = IdentifyOptions(("axis2.pitch", "axis3.x"), priors={"axis3.x": 1e-9}, robust=False)
    frames = _frames(s, np.random.default_rng(0))
    robot = identify_instruments(model, _log(s), [_instrument("a", frames)], options).placed["a"].robot
    assert robot is not None
    assert robot.values["axis3.x"] == pytest.approx(7e-4, abs=1e-6)
