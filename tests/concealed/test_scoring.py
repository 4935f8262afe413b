"""Scores on invented answers: what counts as the same cause, as covered, as gained."""

from typing import Any

import numpy as np
import pytest

from benchmarks.concealed.adapter import Answer
from benchmarks.concealed.equivalence import Equivalence
from benchmarks.concealed.scenarios import BATTERIES, Scenario
from benchmarks.concealed.scoring import score
from benchmarks.concealed.tables import gain_share, report
from fixtures.campaigns import plan_of
from fixtures.draws import BY_LEVEL
from fixtures.effects import Effect
from fixtures.plan import Plan, Recording, Truth
from fixtures.recordings import draw_truth, record
from fixtures.signature import Design

LAG = Effect("hysteresis", "axis1", None, {"width_deg": 0.02})


def _cause(cause: str, where: str, direction: str | None = None, **more: Any) -> dict[str, Any]:
    return {"cause": cause, "stage": "robot", "where": where, "direction": direction, "parameters": {}, **more}


@pytest.fixture(scope="module")
def plan() -> Plan:
    return plan_of(seed=3, effects=[LAG], poses=50, verify=0, kept_out=40)


@pytest.fixture(scope="module")
def recorded(plan: Plan) -> tuple[Recording, Truth]:
    return record(plan)


@pytest.fixture(scope="module")
def equal(recorded: tuple[Recording, Truth]) -> Equivalence:
    return Equivalence(recorded[1], Design.of(recorded[1]))


def test_backlash_is_hysteresis_where_no_load_turns_the_joint(equal: Equivalence) -> None:
    assert equal.same(LAG, _cause("backlash", "axis1", "z"))
    assert not equal.same(LAG, _cause("hysteresis", "axis2"))
    assert not equal.same(LAG, _cause("gear_ripple", "axis1", parameters={"order": 7}))
    loaded = Effect("hysteresis", "axis2", None, {"width_deg": 0.02})
    assert equal.cosine(loaded, _cause("backlash", "axis2")) < 1.0 + 1e-9


def test_moved_base_and_moved_station_are_the_same(equal: Equivalence) -> None:
    moved = Effect("base_moved", "base", None, {"index": 20, "shift_mm": (0.3, 0.1, 0.0), "turn_deg": (0.0, 0.0, 0.01)})
    assert equal.same(moved, _cause("camera_moved", "station", parameters={"pose": "p021"}))
    assert equal.same(moved, _cause("camera_moved", "station", parameters={"pose": "p024"}))  # noise shifts the pose
    assert not equal.same(moved, _cause("zero_jump", "axis2", parameters={"pose": "p021"}))


@pytest.mark.parametrize("cause", BY_LEVEL["points"])
def test_every_cause_reproduces_itself_over_its_grid(cause: str) -> None:
    if cause == "target_swapped":
        pytest.skip("exchanged labels have no amplitude")
    drawn = plan_of(seed=8, effects=[cause], snr=8.0, poses=40, verify=0, kept_out=1)
    truth = draw_truth(drawn)
    effect = truth.effects[0]
    kept = {k: v for k, v in effect.parameters.items() if k in ("order", "pose", "from") or cause == "geometry"}
    answer = {"cause": cause, "where": effect.where, "direction": effect.direction, "parameters": kept}
    assert Equivalence(truth, Design.of(truth)).cosine(effect, answer) > 0.99


def test_places_that_the_robot_does_not_have_are_simply_wrong(equal: Equivalence) -> None:
    assert equal.cosine(LAG, _cause("hysteresis", "axis9")) == 0.0
    assert equal.cosine(LAG, _cause("unknown", "axis1")) == 0.0


def _scored(
    plan: Plan, recorded: tuple[Recording, Truth], causes: list[dict[str, Any]], **predicted: np.ndarray
) -> dict:
    scenario = Scenario("singles", "hysteresis", "points", 3, None, lambda: plan)
    answer = Answer({"mismatch": bool(causes), "p_value": 1e-9, "causes": causes}, predicted, 1.0)
    return score(scenario, *recorded, answer)


def test_right_answer(plan: Plan, recorded: tuple[Recording, Truth]) -> None:
    truth = recorded[1]
    rivals = [{"cause": "backlash", "where": "axis1", "direction": "z"}]
    told = _cause(
        "hysteresis",
        "axis1",
        "z",
        parameters={"width_deg": 0.021},
        sigma={"width_deg": 0.001},
        indistinguishable_from=rivals,
    )
    result = _scored(plan, recorded, [told], inside=truth.inside.with_effect)
    assert result["name_right"]
    assert result["exact"]
    assert result["set_size"] == 1
    assert (result["intervals_inside"], result["intervals"]) == (1, 1)
    assert gain_share(result, "inside") > 1.0  # the truth itself beats every fit


def test_wrong_answers(plan: Plan, recorded: tuple[Recording, Truth]) -> None:
    truth = recorded[1]
    rivals = [{"cause": "hysteresis", "where": "axis1", "direction": "z"}]
    told = _cause("transmission_ratio", "axis1", "z", indistinguishable_from=rivals)
    result = _scored(plan, recorded, [told], inside=truth.inside.without_effect)
    assert not result["name_right"]
    assert result["where_right"]
    assert result["set_covers"]
    assert result["set_size"] == 2
    assert result["extras"] == 1
    assert gain_share(result, "inside") < 0.6
    nothing = _scored(plan, recorded, [])
    assert not nothing["mismatch"]
    assert "name_right" not in nothing


def test_tables_are_made_of_any_mixture_of_records(plan: Plan, recorded: tuple[Recording, Truth]) -> None:
    head = {"key": "k", "battery": "singles", "label": "hysteresis", "level": "points", "snr": 12.0, "seed": 3}
    right = _scored(plan, recorded, [_cause("hysteresis", "axis1", "z")], inside=recorded[1].inside.with_effect)
    text = report(
        [{**head, **right}, {**head, **_scored(plan, recorded, [])}, {**head, "error": "no"}, {**head, "skipped": "no"}]
    )
    assert "50.0 % (1/2)" in text
    assert "1 runs failed" in text


@pytest.mark.parametrize("name", sorted(BATTERIES))
def test_batteries_have_unique_scenarios(name: str) -> None:
    scenarios = list(BATTERIES[name](2, 100, "points"))
    assert len({s.key for s in scenarios}) == len(scenarios)


@pytest.mark.parametrize("name", ["nulls", "inseparable", "decoys", "mixtures"])
def test_plans_of_batteries_can_be_made(name: str) -> None:
    for scenario in BATTERIES[name](1, 100, "points"):
        plan = scenario.build()
        assert plan is not None
        assert bool(plan.effects) == (name != "nulls" and "bad target" not in scenario.label)
