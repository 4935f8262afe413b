"""What is delivered of what was found: groups of terms, jumps that stay with the recording, scatter of the joints."""

from dataclasses import replace

import numpy as np
import pytest

from robcal.recipe.in_force import Form, contradicted, groups_of
from robcal.recipe.lack_of_fit import _balanced
from robcal.recipe.order import covariance_without_order, without_order
from robcal.robot.model import Frame, RobotModel, Term

JUMP = Term("axis1_zero_jump_0", "axis1", "q", "jump*(step(index - (9.5)))", {"jump": 1e-4})
WAVE = Term("axis1_gear_ripple_1", "axis1", "q", "cos*(cos(9.0*q1)) + sin*(sin(9.0*q1))", {"cos": 1e-5, "sin": 2e-5})


def model(*terms: Term) -> RobotModel:
    frames = (Frame("axis1", "z", xyz=(0.0, 0.0, 0.5), sign=-1), Frame("flange", xyz=(0.3, 0.0, 0.0)))
    return RobotModel("small", frames, terms=terms, parameters={"axis1.yaw": 3e-4})


def test_a_jump_stays_out_of_the_robot_and_its_last_state_is_in_the_zero() -> None:
    bare = without_order(model(JUMP, WAVE))
    assert [term.name for term in bare.terms] == [WAVE.name]
    assert bare.parameters["axis1.yaw"] == pytest.approx(3e-4 - 1e-4)  # against the sense of the frame's angle


def test_variance_of_the_zero_is_that_of_zero_and_jump_together() -> None:
    covariance = np.array([[4.0, 1.0], [1.0, 9.0]])
    names, left = covariance_without_order(model(JUMP), ("axis1.yaw", "axis1_zero_jump_0.jump"), covariance)
    assert names == ("axis1.yaw",)
    assert left == pytest.approx(np.array([[4.0 - 2.0 + 9.0]]))


def test_amplitudes_of_a_term_stand_or_fall_together() -> None:
    bare = Form(model(), ("axis1.yaw",))
    full = Form(model(WAVE), ("axis1.yaw", "axis1.elastic_yaw", *WAVE.parameter_names))
    groups = groups_of(bare, full)
    assert groups == {WAVE.name: WAVE.parameter_names, "axis1.elastic_yaw": ("axis1.elastic_yaw",)}
    left = full.without(groups[WAVE.name])
    assert not left.model.terms
    assert left.free == ("axis1.yaw", "axis1.elastic_yaw")


def test_curves_with_priors_stand_or_fall_together() -> None:
    curves = [replace(WAVE, name=f"curve{k}", priors={"cos": 1e-5, "sin": 1e-5}) for k in range(2)]
    bare, full = Form(model(), ()), Form(model(*curves), ())
    assert [len(names) for names in groups_of(bare, full).values()] == [4]


def test_scatter_of_the_joints_makes_up_the_excess_of_variance() -> None:
    rng = np.random.default_rng(0)
    square = rng.uniform(0.1, 1.0, (4000, 3, 2))
    sigma = np.array([2e-5, 6e-5])
    excess = (square @ sigma**2) * rng.chisquare(1, (4000, 3))
    found = _balanced(excess, square)
    assert np.sum(square @ found**2) == pytest.approx(excess.sum())
    assert found[0] < found[1]
    assert not np.any(_balanced(-excess, square))


class Predicted:
    """Errors of forty poses: `useful` halves them, of `twin` and `other` either one does, `idle` none."""

    def errors(self, dropped: tuple[str, ...] = ()) -> tuple[np.ndarray, np.ndarray]:
        size = np.random.default_rng(1).uniform(0.5, 1.5, 40)
        size = size * (2.0 if "useful" in dropped else 1.0) * (0.99 if "idle" in dropped else 1.0)
        size = size * {0: 1.001, 1: 1.0, 2: 1.8}[len({"twin", "other"} & set(dropped))]
        return size, size


def test_causes_without_which_folds_are_predicted_no_worse_are_contradicted() -> None:
    groups = {name: (name,) for name in ("useful", "twin", "other", "idle")}
    fold = np.repeat(np.arange(8), 5)
    weak = contradicted(Predicted(), groups, fold)  # type: ignore[arg-type]
    assert "idle" in weak
    assert "useful" not in weak
    assert len({"twin", "other"} & set(weak)) == 1
