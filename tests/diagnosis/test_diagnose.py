"""Whole diagnoses of concealed campaigns; the effects are drawn by the fixtures, whose physics are their own."""

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from robcal.calibration.observations import PointObservations
from robcal.diagnosis.content import diagnosis_content
from robcal.diagnosis.core.fitting import Accepted
from robcal.diagnosis.core.result import Diagnosis
from robcal.diagnosis.diagnose import diagnose
from robcal.diagnosis.findings import rescaled
from robcal.physics.cause import LinearCause
from robcal.physics.joint_load import COUNTERBALANCE
from robcal.recipe.robot_diagnosis import own_elasticities
from robcal.transforms import exp_so3
from tests.diagnosis.recordings import concealed


def run(folder: Path, seed: int, *effects: str, **plan: object) -> tuple[Diagnosis, object]:
    found, identify, verify, truth = concealed(folder, seed=seed, effects=list(effects), **plan)
    return diagnose(found.model, identify, found.names, (*found.eliminated, *own_elasticities(found)), verify), truth


@pytest.mark.parametrize(("seed", "cause"), [(102, "zero_jump"), (104, "gear_ripple"), (114, "scale_error")])
def test_single_cause_is_named_where_it_is(tmp_path: Path, seed: int, cause: str) -> None:
    diagnosis, truth = run(tmp_path, seed, cause)
    effect = truth.plan.effects[0]
    assert [f.cause.name for f in diagnosis.findings] == [cause]
    assert diagnosis.findings[0].explained == pytest.approx(1.0)
    assert diagnosis.findings[0].cause.where == effect.where
    before, after, floor = diagnosis.heldout
    assert after < before
    assert after < 1.15 * floor
    assert diagnosis.unexplained_p > 0.01
    if cause == "scale_error":
        reported, sigma = diagnosis.findings[0].parameters["ppm"], diagnosis.findings[0].sigma["ppm"]
        assert abs(reported - effect.parameters["ppm"]) < 4 * sigma
    assert len(diagnosis.model.terms) == (cause != "scale_error")
    assert np.isfinite([v for t in diagnosis.model.terms for v in t.parameters.values()]).all()
    content = json.loads(json.dumps(diagnosis_content(diagnosis), allow_nan=False))
    assert content["format"] == "robcal/diagnosis-1"
    assert content["causes"][0]["parameters"].get("pose", "p").startswith("p")
    assert {"before", "after", "noise_floor"} <= set(content["heldout_mm"])


def test_exchanged_targets_are_read_right(tmp_path: Path) -> None:
    # the stages before leave exchanged targets out, so the robot was identified as without them
    found, _, _, _ = concealed(tmp_path / "right", seed=114, effects=[])
    _, identify, verify, truth = concealed(tmp_path / "exchanged", seed=114, effects=["target_swapped"])
    diagnosis = diagnose(found.model, identify, found.names, (*found.eliminated, *own_elasticities(found)), verify)
    effect = truth.plan.effects[0]
    told = diagnosis.findings[0]
    assert told.cause.name == "target_swapped"
    assert {int(told.cause.where), told.parameters["with"]} == {int(effect.where), int(effect.parameters["with"])}
    assert diagnosis.heldout[1] < 0.01 * diagnosis.heldout[0]


def test_outside_the_library_is_unknown_and_still_modelled(tmp_path: Path) -> None:
    diagnosis, truth = run(tmp_path, 116, "damaged_tooth", snr=14.0)
    found = diagnosis.findings[0]
    assert found.cause.name == "unknown"
    assert found.cause.where == truth.plan.effects[0].where
    assert diagnosis.heldout[1] < diagnosis.heldout[0]
    assert found.parameters["term"]["formula"]


@pytest.mark.slow
def test_what_is_fitted_anyway_is_told_as_fitted_last(tmp_path: Path) -> None:
    diagnosis, _ = run(tmp_path, 8033, "stiffness_nonlinear", snr=20.0)
    found = next(f for f in diagnosis.findings if f.cause.name == "stiffness_nonlinear")
    name, unit = found.cause.jointly_fitted["linear_deg_per_kNm"]
    assert found.parameters["linear_deg_per_kNm"] == pytest.approx(diagnosis.model.parameters[name] * unit)
    assert 0.0 < found.sigma["linear_deg_per_kNm"] < found.parameters["linear_deg_per_kNm"]


def test_torque_that_acts_through_a_compliance_is_told_for_the_compliance_of_the_end() -> None:
    law, end, torque = 4e-6, 2e-6, np.array([30.0, 40.0])
    cause = LinearCause(
        COUNTERBALANCE,
        "axis2",
        "y",
        ("cosine", "sine"),
        (1.0, 1.0),
        lambda v, c: {},
        scaled_by=("axis2.elastic_pitch", law),
    )
    item = Accepted(cause, {}, torque, np.zeros((2, 2)))
    names = ("axis2.elastic_pitch", "axis2_counterbalance_0.cosine", "axis2_counterbalance_0.sine")
    covariance = np.diag([(0.1 * end) ** 2, 0.0, 0.0])
    model = SimpleNamespace(parameters={"axis2.elastic_pitch": end})
    final = SimpleNamespace(free=names, accepted=(item,), covariance=covariance, model=model)
    values, spread = rescaled(final, item, item.full_names(0), np.eye(2), 1.0)  # type: ignore[arg-type]
    # the same deflection through half the compliance takes twice the torque; a tenth of it is as uncertain
    assert np.allclose(values, 2.0 * torque)
    assert np.allclose(spread, 4.0 * np.eye(2) + 0.01 * np.outer(values, values))


@pytest.mark.slow
def test_shares_of_a_mixture_add_up(tmp_path: Path) -> None:
    diagnosis, _ = run(tmp_path, 118, "zero_jump", "gear_ripple", snr=20.0)
    shares = [finding.explained for finding in diagnosis.findings]
    assert len(shares) >= 2
    assert min(shares) > 0.05
    assert sum(shares) == pytest.approx(1.0, abs=0.05)


def test_neither_nothing_nor_a_pose_at_which_the_robot_had_not_settled_is_a_mismatch(tmp_path: Path) -> None:
    found, identify, verify, _ = concealed(tmp_path, seed=100, effects=[])
    points = identify.observations
    assert isinstance(points, PointObservations)
    rows = points.pose == 17
    moved = points.p_world.copy()
    middle = moved[rows].mean(axis=0)
    moved[rows] = (moved[rows] - middle) @ exp_so3(np.array([4e-4, -3e-4, 5e-4])).T + middle + [2e-4, -1.5e-4, 1e-4]
    unsettled = replace(identify, observations=replace(points, p_world=moved))
    tied = (*found.eliminated, *own_elasticities(found))
    diagnosis = diagnose(found.model, unsettled, found.names, tied, verify)
    assert not diagnosis.findings
    assert diagnosis.blunders == (identify.names[17],)
    # what the gross error looked like at first, scatter of the joints, is judged again without it
    settled = diagnose(found.model, identify, found.names, tied, verify)
    assert diagnosis.noise_estimated == pytest.approx(settled.noise_estimated, rel=0.03)
    assert not settled.mismatch
    assert settled.p_value > 0.01
    assert "Nothing is missing" in str(diagnosis_content(settled)["statement"])
