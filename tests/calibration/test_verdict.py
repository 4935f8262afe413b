"""Every rule of the verdict: kept, and broken alone."""

from dataclasses import replace

import pytest

from robcal.calibration.tolerance import conformity
from robcal.calibration.verdict import RULES, Deviation, Facts, verdict

SOUND = Facts(
    sigma0=1.1,
    before_mm=2.0,
    before_deg=0.1,
    after_mm=0.1,
    geometry=(Deviation("axis2.x", 1.2, "mm"), Deviation("axis2.pitch", -0.2, "deg")),
    coverage_95=0.95,
    kept_out=20,
)

BROKEN = {
    "elsewhere": ({"elsewhere": "the kept-out poses lie off together"}, "bad", "lie off together"),
    "gain": ({"after_mm": 1.9}, "bad", "does not make this robot better"),
    "mirrored": ({"mirrored": ("the measured frames are",)}, "bad", "mirrored"),
    "agreement": ({"disagreeing": ("the delivered error is 1 mm, what predict gives 2 mm",)}, "bad", "predict gives 2"),
    "convergence": ({"converged": False, "coverage_95": None}, "bad", "did not converge"),
    "unfinished": ({"converged": False}, "care", "did not converge, though"),
    "sigma0": ({"sigma0": 4.7}, "care", "4.7 times"),
    "before": ({"before_mm": 283.0}, "care", "missed by 283 mm"),
    "geometry": ({"geometry": (Deviation("axis3.x", -270.0, "mm"),)}, "care", "axis3.x -270 mm"),
    "negative": ({"negative": (Deviation("axis2.elastic_pitch", -0.1, "deg/kNm"),)}, "care", "axis2.elastic_pitch"),
    "coordinates": ({"untested": ("target 31 contradicts the survey",)}, "care", "target 31"),
    "coverage": ({"coverage_95": 0.8}, "care", "80 % inside"),
    "tolerance": ({"conformity": conformity([1e-4, 4e-4, 5e-4], 3e-4)}, "bad", "2 of 3 kept-out errors miss"),
    "tolerance in doubt": (
        {"conformity": conformity([1e-4, 2.9e-4], 3e-4, 1e-4)},
        "care",
        "1 of them too close to tell",
    ),
    "kept out": ({"kept_out": 9}, "care", "on 9 poses only"),
    "unexplained": ({"unexplained": True}, "care", "cannot explain"),
    "unnamed": ({"unnamed": True}, "care", "without a name"),
}


def test_nothing_speaks_against_it() -> None:
    assert verdict(SOUND).grade == "good"
    assert verdict(SOUND).reasons == ()


def test_every_rule_has_its_case() -> None:
    assert set(BROKEN) == {rule.name for rule in RULES}


@pytest.mark.parametrize("name", BROKEN)
def test_a_broken_rule_gives_its_grade_and_reason(name: str) -> None:
    change, grade, words = BROKEN[name]
    found = verdict(replace(SOUND, **change))
    assert found.grade == grade
    assert len(found.reasons) == 1
    assert words in found.text


@pytest.mark.parametrize(
    "change",
    [
        {"sigma0": 30.0, "explained": True},
        {"sigma0": None},
        {"before_mm": 19.0, "before_deg": 1.9},
        {"geometry": (Deviation("axis3.x", -19.0, "mm"), Deviation("axis3.yaw", 1.9, "deg"))},
        {"coverage_95": 1.0},
        {"coverage_95": 0.86},
        {"kept_out": 10},
    ],
)
def test_within_the_rules(change: dict) -> None:
    assert verdict(replace(SOUND, **change)).grade == "good"


def test_turns_beyond_what_robots_are_off() -> None:
    assert "2.5 deg" in verdict(replace(SOUND, before_deg=2.5)).text
    assert "axis3.yaw" in verdict(replace(SOUND, geometry=(Deviation("axis3.yaw", 2.1, "deg"),))).text


def test_the_worst_grade_counts_and_all_reasons_are_told() -> None:
    found = verdict(replace(SOUND, converged=False, kept_out=3, sigma0=5.0))
    assert found.grade == "bad"
    assert len(found.reasons) == 3
    assert "converge" in found.reasons[0]
