"""The library: complete, finite, and told in the contract's names and units."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from robcal.diagnosis.scan.analysis import acts_once
from robcal.physics.cause import Basis, numeric_sigma
from robcal.physics.joint import joint_families
from robcal.physics.measuring import describe
from robcal.physics.site import RobotSite, exponential_law
from robcal.physics.structure import structure_families
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


def families(where: RobotSite) -> list:  # type: ignore[type-arg]
    return [*joint_families(where), *structure_families(where)]


def test_every_cause_of_the_robot_is_there() -> None:
    assert {family.cause for family in families(site(frozenset({"axis1.elastic_yaw"})))} == ROBOT_CAUSES


def test_weights_are_shared_among_places() -> None:
    for cause in ("hysteresis", "gear_ripple", "joint_coupling", "axis_wobble"):
        total = sum(family.weight for family in families(site()) if family.cause == cause)
        assert total == pytest.approx(1.0)


def test_laws_are_finite_and_reports_have_sigmas() -> None:
    where = site()
    for family in families(where):
        for constants in family.grid[:3]:
            names = family.names(constants)
            assert len(names) == len(family.sizes(constants))
            for basis in family.bases(constants) if family.bases else ():
                assert np.all(np.isfinite(evaluate(basis.expression, where.variables)))
                assert basis.parameter in names
            told, sigma = numeric_sigma(family.report, family.sizes(constants), constants, np.eye(len(names)) * 1e-12)
            assert set(sigma) <= set(told)
            assert sigma


def test_amplitude_and_phase() -> None:
    family = next(f for f in families(site()) if f.cause == "joint_eccentricity" and f.where == "axis2")
    amplitude, phase = 3e-4, np.radians(40.0)
    told = family.report(amplitude * np.array([np.cos(phase), np.sin(phase)]), {"order": 2.0})
    assert told["amplitude_deg"] == pytest.approx(np.degrees(amplitude))
    assert told["phase_deg"] == pytest.approx(40.0)
    # amplitude * cos(order * q - phase), in the sense of q
    q = site().variables["q2"]
    law = sum(
        amplitude * weight * evaluate(b.expression, {"q2": q})
        for b, weight in zip(family.bases({"order": 2.0}), (np.cos(phase), np.sin(phase)), strict=True)
    )
    assert np.allclose(law, amplitude * np.cos(2 * q - phase))


def test_backlash_rests_on_the_loaded_flank_and_lags_without_load() -> None:
    family = next(f for f in families(site()) if f.cause == "backlash" and f.where == "axis2")
    (basis,) = family.bases({"threshold_Nm": 20.0})
    values = evaluate(
        basis.expression, {"torque2": np.array([100.0, -100.0, 5.0, 5.0]), "approach2": np.array([1.0, 1.0, 1.0, -1.0])}
    )
    assert np.allclose(values, [0.5, -0.5, -0.5, 0.5])


def test_backlash_may_have_no_threshold_at_all() -> None:
    family = next(f for f in families(site()) if f.cause == "backlash" and f.where == "axis2")
    assert family.ordered["threshold_Nm"][0] == 0.0
    (basis,) = family.bases({"threshold_Nm": 0.0})
    loads = {"torque2": np.array([1e-3, -1e-3, 0.0]), "approach2": np.array([1.0, -1.0, 1.0])}
    assert np.allclose(evaluate(basis.expression, loads), [0.5, -0.5, -0.5])
    assert family.report(np.array([1e-4]), {"threshold_Nm": 0.0}).keys() == {"width_deg"}
    assert family.report(np.array([1e-4]), {"threshold_Nm": 3.0})["threshold_Nm"] == 3.0


def test_an_upright_axis_counts_as_unloaded_whatever_small_torque_the_fit_gives_it() -> None:
    where = site()
    upright = replace(where, variables={**where.variables, "torque1": 1e-3 * where.variables["torque1"]})
    family = next(f for f in families(upright) if f.cause == "backlash" and f.where == "axis1")
    hysteresis = next(f for f in families(upright) if f.cause == "hysteresis" and f.where == "axis1")
    assert family.bases({}) == hysteresis.bases({})
    assert not family.ordered


def test_an_axis_may_be_dragged_along_by_several() -> None:
    frames = tuple(Frame(f"axis{k}", "z", xyz=(0.3, 0.0, 0.1)) for k in (1, 2, 3))
    angles = np.random.default_rng(1).normal(size=(3, 20))
    variables = {f"q{k}": angles[k - 1] for k in (1, 2, 3)} | {"index": np.arange(20.0)}
    variables |= {f"torque{k}": np.zeros(20) for k in (1, 2, 3)}
    where = RobotSite(RobotModel("three", frames), variables, frozenset(), frozenset())
    dragged = [f for f in joint_families(where) if f.cause == "joint_coupling" and f.where == "axis3"]
    assert len(dragged) == 2
    assert len({f.key for f in dragged}) == 2
    told = dragged[0].report(np.array([1e-4]), {})
    assert describe(dragged[0].sentence, "axis3", "z", told).startswith("Axis 3 is dragged along by axis 1: 1.00e-04")
    assert acts_once(dragged[0])


def test_causes_whose_constants_bend_one_law_act_once_at_a_place() -> None:
    once = {f.cause: acts_once(f) for f in families(site())}
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
    freed = {name for family in families(where) for name in family.frees}
    assert not freed & where.fitted
    assert "axis2.elastic_yaw" in freed
