"""Identification: truth recovered, honest statistics, named eliminations, mixtures, outliers, clear refusals."""

import numpy as np
import pytest

from robcal import transforms as tf
from robcal.calibration.identification import IdentifyOptions, identify
from robcal.calibration.observations import (
    DistanceObservations,
    FrameObservations,
    PointObservations,
    SensorPointObservations,
)
from robcal.errors import InvalidInput, NotIdentifiable
from robcal.robot.kernel import Kernel
from robcal.robot.model import Term
from tests.calibration.scenarios import Scenario, scenario, tool_residual
from tests.robot.chains import kr_like


def _points(s: Scenario, sigma: float = 5e-5) -> PointObservations:
    T = s.truth.frames(s.theta, s.poses)
    n = len(T)
    p = T[:, :3, 3] + sigma * s.rng.normal(size=(n, 3))
    return PointObservations(
        np.arange(n), np.zeros((n, 3)), p, np.broadcast_to(sigma**2 * np.eye(3), (n, 3, 3)), np.zeros(n)
    )


def test_exact_data_are_reproduced_to_rounding() -> None:
    s = scenario(0)
    exact = FrameObservations.isotropic(s.truth.frames(s.theta, s.poses), 5e-5, 1e-4)
    robot = identify(s.model, s.poses, [exact], kernel=s.kernel)
    assert robot.summary.converged
    # parameters left at nominal (parallel axes) cost less than a tenth of the stated noise
    assert tool_residual(robot.predict(s.kept_out)[0], s.truth.frames(s.theta, s.kept_out)) < 5e-6


@pytest.mark.parametrize("compliant", [False, True])
def test_as_good_as_an_oracle_that_knows_the_form(compliant: bool) -> None:
    ours, oracle = [], []
    for seed in range(4):
        s = scenario(seed, compliant)
        observed = s.frames(s.poses)
        truth = s.truth.frames(s.theta, s.kept_out)
        form = [n for n in s.kernel.names if s.theta[s.kernel.index[n]] != 0]
        for options, out in ((IdentifyOptions(), ours), (IdentifyOptions(parameters=form), oracle)):
            robot = identify(s.model, s.poses, [observed], options, s.kernel)
            out.append(tool_residual(robot.predict(s.kept_out)[0], truth))
            assert robot.summary.converged
    assert np.mean(ours) < 1.08 * np.mean(oracle)
    assert np.mean(ours) < 3.5e-5


def test_statistics_are_honest() -> None:
    """Normalised errors of parameters and predictions over some seeds; the long battery is a benchmark."""
    inside, total, chi2 = 0, 0, []
    for seed in range(6):
        s = scenario(seed, n=50)
        robot = identify(s.model, s.poses, [s.frames(s.poses)], IdentifyOptions(parameters="standard"), s.kernel)
        T, C = robot.predict(s.kept_out)
        delta = tf.difference(T, s.truth.frames(s.theta, s.kept_out))
        z = np.einsum("ni,nij,nj->n", delta[:, :3], np.linalg.inv(C[:, :3, :3]), delta[:, :3])
        inside += int(np.sum(z < 7.815))
        total += len(z)
        chi2.append(robot.sigma0)
    assert 0.85 < inside / total <= 1.0
    assert 0.9 < np.mean(chi2) < 1.1


def test_eliminated_parameters_are_named_with_ties() -> None:
    s = scenario(1, compliant=False)
    robot = identify(s.model, s.poses, [s.frames(s.poses)], IdentifyOptions(parameters="geometry"), s.kernel)
    known = set(robot.names) | set(robot.eliminated)
    assert {f"{f.name}.{k}" for f in s.model.frames for k in ("x", "y", "z", "roll", "pitch", "yaw")} <= known
    assert robot.eliminated["axis1.z"].tied_to == pytest.approx({"base.z": 1.0}, abs=0.05)
    assert robot.eliminated["axis3.y"].reason in ("dependent", "weak")
    assert "axis2.y" in robot.eliminated["axis3.y"].tied_to or "base.y" in robot.eliminated["axis3.y"].tied_to
    assert robot.condition < 100
    assert set(robot.observability) == {"O1", "O2", "O3", "O4", "O5"}
    assert robot.redundancy == 480 - len(robot.names)
    np.testing.assert_allclose(robot.redundancy_numbers.sum(), robot.redundancy, rtol=1e-6)
    np.testing.assert_allclose(robot.leverage.sum() * 6, len(robot.names), rtol=1e-6)


def test_a_point_alone_leaves_the_tools_turn_open_and_agrees_with_frames() -> None:
    s = scenario(2)
    robots = [identify(s.model, s.poses, o, kernel=s.kernel) for o in ([_points(s)], [s.frames(s.poses)])]
    assert robots[0].eliminated["tool.roll"].reason == "no influence"
    frames = [r.predict(s.kept_out) for r in robots]
    d = frames[0][0][:, :3, 3] - frames[1][0][:, :3, 3]
    R = [f[0][:, :3, :3] for f in frames]
    C = sum(tf.transport_covariance(R[k], frames[k][1][:, :3, :3]) for k in (0, 1))
    z = np.einsum("ni,nij,nj->n", d, np.linalg.inv(C), d) / 3
    assert np.median(z) < 2.5


def test_mixtures_of_frames_points_distances_and_sensor() -> None:
    s = scenario(3, n=90)
    T = s.truth.frames(s.theta, s.poses)
    n = len(T)
    frames, points = s.frames(s.poses), _points(s)
    d = np.linalg.norm(T[:, :3, 3], axis=1) + 1e-4 * s.rng.normal(size=n)
    distances = DistanceObservations(np.arange(n), d, np.full(n, 1e-4))
    at_rest = T[:, :3, 3].mean(axis=0) + s.rng.normal(0, 0.2, (n, 3))
    seen = tf.transform(tf.invert(T), at_rest) + 5e-5 * s.rng.normal(size=(n, 3))
    sensor = SensorPointObservations(np.arange(n), seen, at_rest, np.broadcast_to(25e-10 * np.eye(3), (n, 3, 3)))
    parts = [frames.subset(np.arange(30)), points.subset(np.arange(30)), distances, sensor]
    parts[1] = PointObservations(
        parts[1].pose + 30, parts[1].p_tool, points.p_world[30:60], parts[1].covariance, parts[1].target
    )
    robot = identify(s.model, s.poses, parts, kernel=s.kernel)
    assert 0.85 < robot.sigma0 < 1.15
    assert tool_residual(robot.predict(s.kept_out)[0], s.truth.frames(s.theta, s.kept_out)) < 8e-5


def test_distances_alone() -> None:
    s = scenario(4, compliant=False, n=300)
    T = s.truth.frames(s.theta, s.poses)
    d = np.linalg.norm(T[:, :3, 3], axis=1) + 5e-5 * s.rng.normal(size=300)
    robot = identify(
        s.model,
        s.poses,
        [DistanceObservations(np.arange(300), d, np.full(300, 5e-5))],
        IdentifyOptions(parameters="geometry"),
        s.kernel,
    )
    assert robot.summary.converged
    assert 0.9 < robot.sigma0 < 1.1
    predicted = np.linalg.norm(robot.predict(s.kept_out)[0][:, :3, 3], axis=1)
    truth = np.linalg.norm(s.truth.frames(s.theta, s.kept_out)[:, :3, 3], axis=1)
    assert np.abs(predicted - truth).mean() < 5e-5


def test_outlier_poses_are_left_out_and_reported() -> None:
    s = scenario(5)
    clean = s.frames(s.poses)
    T = clean.world_T_tool.copy()
    T[7, :3, 3] += [0.01, 0, 0]
    T[40, :3, 3] += [0, 0.003, 0]
    robot = identify(s.model, s.poses, [FrameObservations(clean.pose, T, clean.covariance)], kernel=s.kernel)
    assert robot.outliers == (7, 40)
    assert 0.85 < robot.sigma0 < 1.15
    assert robot.normalised[7] > 10
    kept = identify(s.model, s.poses, [clean], kernel=s.kernel)
    assert kept.outliers == ()


def test_basis_norm_table_5_4_and_named_parameters() -> None:
    s = scenario(6)
    observed = s.frames(s.poses)
    truth = s.truth.frames(s.theta, s.kept_out)
    for options in (
        IdentifyOptions(objective="basis"),
        IdentifyOptions(parameters="table5.4"),
        IdentifyOptions(statics="converged"),
    ):
        robot = identify(s.model, s.poses, [observed], options)
        assert tool_residual(robot.predict(s.kept_out)[0], truth) < 5e-4, options
    robot = identify(s.model, s.poses, [observed], IdentifyOptions(parameters=["axis2.pitch"]), s.kernel)
    assert set(robot.names) - {"axis2.pitch"} == {
        f"{e}.{k}" for e in ("base", "tool") for k in ("x", "y", "z", "roll", "pitch", "yaw")
    }
    assert robot.covariance_scale > 10  # far too few parameters: the residuals contradict the stated covariance


def test_terms_are_identified_with_the_rest() -> None:
    truth = kr_like(terms=(Term("axis3.wave", "axis3", "q", "a*cos(q3) + b*sin(q3)", {"a": 3e-4, "b": -2e-4}),))
    s = scenario(7, model=truth)
    model = truth.with_parameters({"axis3.wave.a": 0.0, "axis3.wave.b": 0.0})
    robot = identify(model, s.poses, [s.frames(s.poses)])
    for name, value in (("axis3.wave.a", 3e-4), ("axis3.wave.b", -2e-4)):
        k = robot.names.index(name)
        assert abs(robot.theta[k] - value) < 4 * robot.sigma[k]
        assert robot.model.terms[0].parameters[name.rsplit(".")[-1]] == pytest.approx(robot.theta[k])


def test_joint_repeatability_enters_the_weights() -> None:
    s = scenario(8)
    poses = s.poses.with_q(s.poses.q + 2e-4 * s.rng.normal(size=s.poses.q.shape))
    observed = s.frames(poses)
    naive = identify(s.model, s.poses, [observed], kernel=s.kernel)
    aware = identify(s.model, s.poses, [observed], IdentifyOptions(joint_sigma=2e-4), s.kernel)
    assert naive.sigma0 > 2
    assert 0.9 < aware.sigma0 < 1.1


def test_converges_from_zero_with_large_deviations() -> None:
    for seed in range(10):
        s = scenario(seed, scale=3.0, n=60)
        robot = identify(s.model, s.poses, [s.frames(s.poses)], IdentifyOptions(parameters="geometry"), s.kernel)
        assert robot.summary.converged
        assert robot.summary.iterations <= 5


def test_refusals_say_why() -> None:
    s = scenario(9, n=12)
    observed = s.frames(s.poses)
    with pytest.raises(NotIdentifiable, match="measured numbers"):
        identify(s.model, s.poses.subset(np.arange(4)), [observed.subset(np.arange(4))], kernel=s.kernel)
    alike = s.poses.with_q(np.repeat(s.poses.q[:1], 12, axis=0))
    with pytest.raises(NotIdentifiable, match="alike"):
        identify(s.model, alike, [s.frames(alike)], kernel=s.kernel)
    with pytest.raises(InvalidInput, match=r"no parameter 'axis9\.x'"):
        identify(s.model, s.poses, [observed], IdentifyOptions(parameters=["axis9.x"]), s.kernel)
    with pytest.raises(InvalidInput, match="standard"):
        identify(s.model, s.poses, [observed], IdentifyOptions(parameters="everything"), s.kernel)


def test_result_can_be_evaluated_again_from_its_model() -> None:
    s = scenario(10)
    robot = identify(s.model, s.poses, [s.frames(s.poses)], kernel=s.kernel)
    again = Kernel(robot.model)
    np.testing.assert_allclose(again.frames(again.theta0, s.kept_out), robot.predict(s.kept_out)[0], atol=1e-12)
    assert s.kernel.model.parameters == {}
