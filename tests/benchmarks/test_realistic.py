"""Scores of realistic recordings, on records of which the outcome is known."""

from typing import Any

import pytest

from benchmarks.impossible_causes import impossible
from benchmarks.realistic import SCORES, agrees, gain_share, tables

GOOD: dict[str, Any] = {
    "seed": 1,
    "traits": "a robot",
    "mirrored": False,
    "headline": 0.10,
    "kept_out": 50,
    "truth": 0.09,
    "measured": 0.105,
    "identified": 0.3,
    "floor": 0.05,
    "coverage": 0.95,
    "grade": "good",
    "causes": ["backlash@axis1"],
    "impossible": [],
    "seconds": 1.0,
}


def scores(*records: dict[str, Any]) -> list[float]:
    return [score.value(list(records)) for score in SCORES]


def test_all_goals_reached_by_a_good_record() -> None:
    assert scores(GOOD) == pytest.approx([1.0, 1.0, 1.0, 0.84, 0.0, 1.0, 0.95, 0.0])


@pytest.mark.parametrize(
    ("change", "score"),
    [
        ({"headline": 0.05}, 0),
        ({"headline": 0.05, "truth": 0.4, "measured": 0.41}, 1),
        ({"truth": 0.31}, 2),
        ({"truth": 0.29}, 3),
        ({"truth": 0.21}, 4),
        ({"mirrored": True}, 4),
        ({"coverage": 0.7}, 5),
        ({"impossible": ["backlash"]}, 7),
    ],
)
def test_each_fault_shows_in_its_score(change: dict[str, Any], score: int) -> None:
    assert scores({**GOOD, **change})[score] != pytest.approx(scores(GOOD)[score])


def test_few_kept_out_poses_are_allowed_their_scatter() -> None:
    record = {**GOOD, "headline": 0.13, "kept_out": 8}
    assert not agrees(record)
    assert agrees(record, with_sampling=True)


def test_no_gain_where_nothing_could_be_gained() -> None:
    assert gain_share({**GOOD, "floor": 0.29}) != gain_share({**GOOD, "floor": 0.29})
    assert gain_share({**GOOD, "truth": 0.35}) < 0


def test_the_table_names_the_worst_and_the_refused() -> None:
    bad = {**GOOD, "seed": 7, "headline": 0.01}
    refused = {"seed": 9, "traits": "b", "mirrored": False, "refused": "no poses", "seconds": 1.0}
    text = "\n".join(tables([GOOD, bad, refused]))
    assert text.index("seed 7") < text.index("seed 1")
    assert "seed 9: no poses" in text


@pytest.mark.parametrize(
    ("cause", "fault"),
    [
        ({"cause": "backlash", "parameters": {"width_deg": -0.03}}, "width_deg -0.03"),
        ({"cause": "payload_mass", "parameters": {"mass_kg": -5.8}}, "mass_kg"),
        ({"cause": "zero_jump", "parameters": {"jump_deg": 0.95}}, "0.95"),
        ({"cause": "camera_moved", "parameters": {}}, "nothing moved"),
        ({"cause": "refraction", "parameters": {}}, "air"),
        ({"cause": "unknown", "stage": "robot", "parameters": {"term": {"variables": ["time_s"]}}}, "time_s"),
        ({"cause": "axis_wobble", "parameters": {"amplitude_deg": 1.0}, "sigma": {"amplitude_deg": 2.0}}, "+-"),
        ({"cause": "backlash", "parameters": {"width_deg": 0.03}, "sigma": {"width_deg": 0.002}}, None),
        ({"cause": "unknown", "stage": "robot", "parameters": {"term": {"variables": ["q3_deg"]}}}, None),
    ],
)
def test_what_cannot_be(cause: dict[str, Any], fault: str | None) -> None:
    words = impossible({"where": "axis1", "stage": "robot", **cause}, moved=False)
    assert (words is None) if fault is None else fault in str(words)


def test_a_move_that_happened_is_possible() -> None:
    assert impossible({"cause": "camera_moved", "where": "station", "parameters": {}}, moved=True) is None
