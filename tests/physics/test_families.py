"""The library: complete, finite, and reported in the contract's names and units."""

from dataclasses import replace

import numpy as np
import pytest

from robcal.physics.cause import Basis, numeric_sigma
from robcal.physics.library import entries
from robcal.physics.site import RobotSite, exponential_law
from robcal.robot.model import Frame, Payload, RobotModel
from robcal.robot.terms import evaluate

ROBOT_CAUSES = {
    "stiffness_nonlinear",
    "backlash",
    "hysteresis",
    "lost_motion",
    "zero_jump",
    "joint_eccentricity",
    "gear_ripple",
    "transmission_ratio",
    "joint_coupling",
    "axis_wobble",
    "counterbalance",
    "payload_mass",
    "payload_cog",
    "base_compliance",
    "base_tilt",
    "thermal_growth",
    "thermal_zero_drift",
    "base_moved",
    "link_compliance",
    "geometry",
    "joint_compliance",
}


def site(fitted: frozenset[str] = frozenset({"axis1.elastic_yaw", "axis2.elastic_pitch"})) -> RobotSite:
    frames = (
        Frame("axis1", "z", xyz=(0.0, 0.0, 0.75), mass=300.0, cog=(0.1, 0.0, 0.0)),
        Frame("axis2", "y", sign=-1, xyz=(0.35, 0.0, 0.0), mass=200.0, cog=(0.5, 0.0, 0.0)),
    )
    model = RobotModel(
        "two", frames, payloads={"load": Payload(50.0, (0.0, 0.0, 0.2))}, parameters={"axis2.elastic_pitch": 1e-6}
    )
    rng = np.random.default_rng(0)
    n = 40
    variables = {name: rng.normal(size=n) for name in ("q1", "q2")}
    variables |= {name: 800 * rng.normal(size=n) for name in ("torque1", "torque2", "base_mx", "base_my", "base_mz")}
    moments = [f"axis{k}_m{a}" for k in (1, 2) for a in ("roll", "pitch", "yaw")]
    variables |= {name: 800 * rng.normal(size=n) for name in moments}
    variables |= {f"approach{k}": rng.choice([-1.0, 1.0], n) for k in (1, 2)}
    variables |= {"index": np.arange(n, dtype=float), "time_s": 60.0 * np.arange(n)}
    variables["temp_arm_c"] = 20 + 0.1 * np.arange(n)
    return RobotSite(model, variables, fitted, frozenset())


def causes(where: RobotSite) -> list:  # type: ignore[type-arg]
    return [
        cause
        for entry in entries()
        if entry.on_robot is not None
        for cause in entry.on_robot(where)
        if cause.kind.named
    ]


def test_every_cause_of_the_robot_is_there() -> None:
    assert {cause.name for cause in causes(site(frozenset({"axis1.elastic_yaw"})))} == ROBOT_CAUSES


def test_weights_are_shared_among_places() -> None:
    for name in ("hysteresis", "gear_ripple", "joint_coupling", "axis_wobble"):
        total = sum(cause.weight for cause in causes(site()) if cause.name == name)
        assert total == pytest.approx(1.0)


def test_laws_are_finite_and_reports_have_sigmas() -> None:
    where = site()
    for cause in causes(where):
        for constants in cause.grid[:3]:
            names = cause.names(constants)
            assert len(names) == len(cause.sizes(constants))
            for basis in cause.bases(constants) if cause.bases else ():
                assert np.all(np.isfinite(evaluate(basis.expression, where.variables)))
                assert basis.parameter in names
            reported, sigma = numeric_sigma(cause.report, cause.sizes(constants), constants, np.eye(len(names)) * 1e-12)
            assert set(sigma) <= set(reported)
            assert sigma


def test_amplitude_and_phase() -> None:
    cause = next(f for f in causes(site()) if f.name == "joint_eccentricity" and f.where == "axis2")
    amplitude, phase = 3e-4, np.radians(40.0)
    reported = cause.report(amplitude * np.array([np.cos(phase), np.sin(phase)]), {"order": 2.0})
    assert reported["amplitude_deg"] == pytest.approx(np.degrees(amplitude))
    assert reported["phase_deg"] == pytest.approx(40.0)
    # amplitude * cos(order * q - phase), in the sense of q
    q = site().variables["q2"]
    law = sum(
        amplitude * weight * evaluate(b.expression, {"q2": q})
        for b, weight in zip(cause.bases({"order": 2.0}), (np.cos(phase), np.sin(phase)), strict=True)
    )
    assert np.allclose(law, amplitude * np.cos(2 * q - phase))


def test_backlash_rests_on_the_loaded_flank_and_lags_without_load() -> None:
    cause = next(f for f in causes(site()) if f.name == "backlash" and f.where == "axis2")
    (basis,) = cause.bases({"threshold_Nm": 20.0})
    values = evaluate(
        basis.expression, {"torque2": np.array([100.0, -100.0, 5.0, 5.0]), "approach2": np.array([1.0, 1.0, 1.0, -1.0])}
    )
    assert np.allclose(values, [0.5, -0.5, -0.5, 0.5])


def test_backlash_may_have_no_threshold_at_all() -> None:
    cause = next(f for f in causes(site()) if f.name == "backlash" and f.where == "axis2")
    assert cause.ordered["threshold_Nm"][0] == 0.0
    (basis,) = cause.bases({"threshold_Nm": 0.0})
    loads = {"torque2": np.array([1e-3, -1e-3, 0.0]), "approach2": np.array([1.0, -1.0, 1.0])}
    assert np.allclose(evaluate(basis.expression, loads), [0.5, -0.5, -0.5])
    assert cause.report(np.array([1e-4]), {"threshold_Nm": 0.0}).keys() == {"width_deg"}
    assert cause.report(np.array([1e-4]), {"threshold_Nm": 3.0})["threshold_Nm"] == 3.0


def test_an_upright_axis_counts_as_unloaded_whatever_small_torque_the_fit_gives_it() -> None:
    where = site()
    upright = replace(where, variables={**where.variables, "torque1": 1e-3 * where.variables["torque1"]})
    cause = next(f for f in causes(upright) if f.name == "backlash" and f.where == "axis1")
    hysteresis = next(f for f in causes(upright) if f.name == "hysteresis" and f.where == "axis1")
    assert cause.bases({}) == hysteresis.bases({})
    assert not cause.ordered


def test_an_axis_may_be_dragged_along_by_several() -> None:
    frames = tuple(Frame(f"axis{k}", "z", xyz=(0.3, 0.0, 0.1)) for k in (1, 2, 3))
    angles = np.random.default_rng(1).normal(size=(3, 20))
    variables = {f"q{k}": angles[k - 1] for k in (1, 2, 3)} | {"index": np.arange(20.0)}
    variables |= {f"torque{k}": np.zeros(20) for k in (1, 2, 3)}
    where = RobotSite(RobotModel("three", frames), variables, frozenset(), frozenset())
    dragged = [f for f in causes(where) if f.name == "joint_coupling" and f.where == "axis3"]
    assert len(dragged) == 2
    assert len({f.key for f in dragged}) == 2
    reported = dragged[0].report(np.array([1e-4]), {})
    assert dragged[0].describe(reported).startswith("Axis 3 is dragged along by axis 1: 1.00e-04")
    assert dragged[0].acts_once


def test_causes_whose_constants_bend_one_law_act_once_at_a_place() -> None:
    once = {f.name: f.acts_once for f in causes(site())}
    assert all(once[cause] for cause in ("backlash", "hysteresis", "lost_motion"))
    assert not any(once[cause] for cause in ("zero_jump", "gear_ripple", "base_moved"))


def test_warming_up_ends_at_its_duration() -> None:
    t = np.array([0.0, 3600.0, 7200.0])
    law, straight = (
        evaluate(template, {"time_s": t, **constants})
        for template, constants in (exponential_law(0.0, 2.0, 0.5), exponential_law(0.0, 2.0, np.inf))
    )
    assert law[0] == 0.0
    assert law[-1] == pytest.approx(2.0)
    assert np.allclose(straight, t / 3600)


def test_constants_filled_in_give_what_the_template_gives() -> None:
    angles = np.linspace(-2.0, 2.0, 7)
    basis = Basis("axis1", "q", "cos(order*q1) + where(q1 > threshold, 1, 0)", "a", {"order": 17.0, "threshold": -0.5})
    assert "order" not in basis.expression
    assert np.allclose(evaluate(basis.expression, {"q1": angles}), basis.value({"q1": angles}), atol=1e-15)


def test_fitted_parameters_are_no_candidates() -> None:
    where = site(frozenset({"axis1.elastic_yaw", "axis2.elastic_pitch", "axis2.elastic_roll", "axis2.x"}))
    freed = {name for cause in causes(where) for name in cause.free_parameters}
    assert not freed & where.fitted
    assert "axis2.elastic_yaw" in freed
