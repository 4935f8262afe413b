"""Causes that are not accepted however well they fit."""

from dataclasses import replace

import numpy as np
import pytest

from robcal.diagnosis.core.fitting import Accepted, Fit, fit
from robcal.diagnosis.core.recording import Recording
from robcal.diagnosis.scan.tangents import Tangents, tangents
from robcal.diagnosis.search.admissible import LEAST_FURTHER, confounded_with, fold_gain, possible, refusal
from robcal.physics.cause import RobotCause
from robcal.physics.library import all_causes
from robcal.physics.site import RobotSite
from robcal.robot.model import RobotModel
from tests.physics.test_gravity_sag import ARM, CELL, FREE, recorded

MODEL = RobotModel("arm", ARM)


def at_poses(recording: Recording) -> tuple[Fit, Tangents]:
    present = fit(MODEL, recording, (*CELL, *FREE))
    return present, tangents(present, recording)


def cause(at: Tangents, name: str, where: str) -> RobotCause:
    site = RobotSite(MODEL, at.variables, frozenset(FREE), frozenset())
    found = next(c for c in all_causes(site, at.data, (), "body") if (c.name, c.where) == (name, where))
    assert isinstance(found, RobotCause)
    return found


def blocks(count: int, first_moves_at: int) -> Recording:
    """Poses in which the first joint rests until a certain one."""
    recording = recorded(4, count)
    q = recording.q.copy()
    q[:first_moves_at, 0] = 0.3
    approach = np.where(np.arange(count) % 2, 1.0, -1.0)
    return replace(recording, q=q, covariates={**recording.covariates, "approach2": approach})


def test_a_jump_when_another_joint_sets_out_is_not_to_be_told() -> None:
    present, at = at_poses(blocks(40, 20))
    jump = Accepted(cause(at, "zero_jump", "axis3"), {"pose": 20.0}, np.array([1e-3]), np.eye(1))
    assert confounded_with(jump, at) == "axis1"
    refused = refusal(jump, present, present, at)
    assert refused is not None
    assert refused.confounded
    assert "cannot be told" in refused.reason
    assert confounded_with(replace(jump, constants={"pose": 8.0}), at) == ""


def test_backlash_is_no_gain() -> None:
    present, at = at_poses(blocks(40, 0))
    width = Accepted(cause(at, "backlash", "axis2"), {"threshold_Nm": 0.0}, np.array([-1e-4]), np.eye(1) * 1e-12)
    assert not possible(width, present)
    assert possible(replace(width, values=-width.values), present)


@pytest.mark.parametrize(("degrees", "fine"), [(0.05, True), (0.95, False)])
def test_a_zero_does_not_jump_by_a_degree(degrees: float, fine: bool) -> None:
    present, at = at_poses(blocks(40, 0))
    jump = Accepted(cause(at, "zero_jump", "axis3"), {"pose": 20.0}, np.radians([degrees]), np.eye(1) * 1e-12)
    assert possible(jump, present) is fine


def test_a_true_law_gains_on_blocks_and_noise_does_not() -> None:
    recording = recorded(6, 60)
    model = replace(MODEL, parameters={"axis3.elastic_pitch": 3e-6})
    poor = fit(model, recording, (*CELL, *FREE))
    rich = fit(model, recording, (*CELL, *FREE, "axis2.elastic_pitch"))
    gain, clear = fold_gain(poor, rich, recording)
    assert clear
    assert gain > LEAST_FURTHER
    assert not fold_gain(rich, poor, recording)[1]
