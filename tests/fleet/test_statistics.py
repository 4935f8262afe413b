"""Fleets: outlying robots are found at the stated rate of false alarms; batches; changes of one robot."""

import numpy as np
import pytest

from benchmarks.fleet import rates
from fixtures.fleets import simulated_fleet
from robcal.errors import InvalidInput
from robcal.fleet.change import change
from robcal.fleet.statistics import Member, fleet


def members(simulated, names):
    return [Member(r.name, names, r.values, r.covariance, r.batch) for r in simulated]


def test_outlying_robots_are_found_at_one_per_cent_of_false_alarms():
    found, false = rates(7.0, fleets=2, robots=300, seed=1)
    assert found > 0.95
    assert false < 0.015


def test_median_and_spread_are_those_of_the_robots_not_of_the_estimates():
    rng = np.random.default_rng(2)
    names = ("axis1.x",)
    spread, sigma = 3e-4, 4e-4
    values = 1e-3 + spread * rng.normal(size=800) + sigma * rng.normal(size=800)
    values[:30] += 1e-2
    found = fleet([Member(f"r{k}", names, np.array([v]), np.array([[sigma**2]])) for k, v in enumerate(values)])
    (p,) = found.parameters
    assert p.median == pytest.approx(1e-3, abs=5e-5)
    assert p.spread == pytest.approx(spread, rel=0.2)
    assert {o.name for o in found.outliers} >= {f"r{k}" for k in range(30)}


def test_batches_that_differ_are_told_and_others_not():
    rng = np.random.default_rng(3)
    names, simulated = simulated_fleet(rng, 200, batches={"north": 0.6, "south": 0.4})
    found = fleet(members(simulated, names))
    assert {d.parameter for d in found.differences} == {names[0]}
    assert found.batches.keys() == {"north", "south"}
    names, simulated = simulated_fleet(rng, 200)
    mixed = [Member(r.name, names, r.values, r.covariance, "ab"[k % 2]) for k, r in enumerate(simulated)]
    assert fleet(mixed).differences == ()


def test_robots_with_other_parameters_take_part_with_what_they_have():
    rng = np.random.default_rng(4)
    names, simulated = simulated_fleet(rng, 40, parameters=6, share=0.0)
    some = members(simulated, names)
    some[0] = Member("r000", (names[2],), some[0].values[2:3] + 0.05, some[0].covariance[2:3, 2:3])
    found = fleet(some)
    assert found.outliers[0].name == "r000"
    assert set(found.outliers[0].parameters) == {names[2]}


def test_few_robots_tell_nothing():
    with pytest.raises(InvalidInput, match="too few"):
        fleet([Member("a", ("x",), np.zeros(1), np.eye(1))] * 3)


def test_changes_have_the_stated_significance():
    """Without a change the probabilities are uniform; a change of six sigma is named, and nothing else."""
    rng = np.random.default_rng(5)
    names = tuple(f"p{k}" for k in range(8))
    root = rng.normal(size=(8, 8))
    C = root @ root.T * 1e-8
    p_values = []
    for _ in range(400):
        a, b = rng.multivariate_normal(np.zeros(8), C, 2)
        p_values.append(change(Member("a", names, a, C), Member("b", names, b, C)).p_value)
    assert np.mean(np.array(p_values) < 0.05) == pytest.approx(0.05, abs=0.03)
    moved = np.zeros(8)
    moved[3] = 6 * np.sqrt(2 * C[3, 3])
    found = change(Member("a", names, np.zeros(8), C), Member("b", names, moved, C))
    assert [p.name for p in found.parameters if p.p_value < 0.01] == ["p3"]
    assert found.p_value < 1e-6


def test_nothing_in_common_is_told():
    a, b = (Member(n, (n,), np.zeros(1), np.eye(1)) for n in "ab")
    with pytest.raises(InvalidInput, match="no parameters in common"):
        change(a, b)
