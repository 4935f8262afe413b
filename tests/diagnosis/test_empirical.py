"""Laws for what has no name: smooth inside the recorded values, constant beyond them, readable by the kernel."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from robcal.physics.cause import LinearCause
from robcal.physics.empirical import LEAST_IN_BUMP, REACH, describe_covariate, empirical_causes
from robcal.physics.site import RobotSite
from robcal.robot.model import Frame, RobotModel
from robcal.robot.terms import evaluate
from tests.physics.test_families import site


def smooth(covariate: str) -> LinearCause:
    return next(f for f in empirical_causes(site()) if f.covariates == (covariate,) and len(f.grid) == 3)


@given(st.floats(0.0, 1e3))
def test_beyond_the_recorded_values_a_law_stays_as_at_their_end(far: float) -> None:
    values = np.asarray(site().variables["q1"])
    cause = smooth("q1")
    for constants in cause.grid:
        for basis in cause.bases(constants):  # type: ignore[misc]
            ends = basis.value({"q1": np.array([values.max(), values.min()])})
            beyond = basis.value({"q1": np.array([values.max() + far, values.min() - far])})
            np.testing.assert_array_equal(beyond, ends)


def test_the_kernel_reads_the_same_law() -> None:
    cause = smooth("q2")
    q = np.linspace(-4.0, 4.0, 50)
    for basis in cause.bases(cause.grid[-1]):  # type: ignore[misc]
        np.testing.assert_allclose(evaluate(basis.expression, {"q2": q}), basis.value({"q2": q}), rtol=1e-12)


def test_all_of_them_share_one_weight() -> None:
    causes = list(empirical_causes(site()))
    assert {f.name for f in causes} == {"unknown"}
    assert sum(f.weight for f in causes) == pytest.approx(causes[0].weight * len(causes))
    assert sum(f.weight for f in causes) < 1.0


def test_a_bump_that_stands_alone_is_seen_at_several_poses() -> None:
    frames = (Frame("axis1", "z", xyz=(0.0, 0.0, 0.5)), Frame("axis2", "y", xyz=(0.3, 0.0, 0.0)))
    rng = np.random.default_rng(2)
    angles = {"q1": rng.normal(size=80), "q2": np.append(rng.uniform(-0.1, 0.1, 79), 3.0)}
    where = RobotSite(RobotModel("two", frames), angles | {"index": np.arange(80.0)}, frozenset(), frozenset())
    bumps = [cause for cause in empirical_causes(where) if "width" in cause.continuous]
    assert {cause.where for cause in bumps} == {"axis1", "axis2"}
    for cause in bumps:
        values = angles[cause.covariates[0]]
        for point in cause.grid:
            near = np.abs(values - point["centre"]) < REACH * point["width"]
            assert near.sum() >= LEAST_IN_BUMP


def test_a_cable_pulls_only_beyond_its_slack() -> None:
    taut = [f for f in empirical_causes(site()) if "pulls at" in f.sentence]
    assert {(f.where, f.covariates) for f in taut} == {("axis1", ("q2",)), ("axis2", ("q1",))}
    values = np.asarray(site().variables["q2"])
    for constants in taut[0].grid:
        first, second = taut[0].bases(constants)  # type: ignore[misc]
        inside = np.linspace(constants["below"], constants["above"], 20)
        assert not np.any(first.value({"q2": inside}))
        assert not np.any(second.value({"q2": inside}))
        ends = {"q2": np.array([values.min(), values.max(), values.max() + 1.0])}
        pull = first.value(ends)
        assert pull[0] == 0.0 < pull[1] == pull[2]
        assert second.value(ends)[0] > 0.0


@pytest.mark.parametrize(
    ("covariate", "words"),
    [
        ("q5", "the angle of axis 5"),
        ("torque12", "the load torque of axis 12"),
        ("axis3_mroll", "the moment about x of axis3"),
        ("temp_room_c", "the temperature 'room'"),
        ("time_s", "time"),
        ("index", "the order of the poses"),
        ("humidity", "humidity"),
    ],
)
def test_covariates_are_told_in_words(covariate: str, words: str) -> None:
    assert describe_covariate(covariate) == words
