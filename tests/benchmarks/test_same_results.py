"""The comparison of two versions' results, and the patterns that read what benchmarks print."""

import math
import re

import pytest

from benchmarks.old_against_new import BENCHMARKS
from benchmarks.same_results import compare, relative_difference

OLD = {"a": {"x": 1.0, "seconds": 3.0}, "list": [1, 2.0], "p_value": 1e-12, "text": "one", "none": None, "yes": True}


def changed(**values: object) -> dict[str, object]:
    return {**OLD, **values}


def test_equal_but_for_seconds() -> None:
    found = compare(OLD, changed(a={"x": 1.0, "seconds": 9.0}), 1e-9)
    assert (found.first, found.largest, found.texts, found.numbers) == (None, 0.0, 0, 4)


@pytest.mark.parametrize(
    ("change", "first"),
    [
        ({"a": {"x": 1.0 + 1e-6}}, "a.x"),
        ({"list": [1, 2.1]}, "list[1]"),
        ({"list": [1]}, "list[1]"),
        ({"p_value": 1.001e-12}, "p_value"),
        ({"none": 0.0}, "none"),
        ({"yes": False}, "yes"),
        ({"more": 1.0}, None),
    ],
)
def test_the_first_difference_is_named(change: dict[str, object], first: str | None) -> None:
    assert compare(OLD, changed(**change), 1e-9).first == first


def test_words_are_counted_and_do_not_count_as_numbers() -> None:
    found = compare(OLD, changed(text="other"), 1e-9)
    assert (found.first, found.texts) == (None, 1)


def test_tiny_numbers_are_zero_except_probabilities() -> None:
    assert relative_difference(1e-17, -1e-16, "mean_mm") < 1e-6
    assert relative_difference(1e-17, 1e-16, "p_value") == pytest.approx(0.9)
    assert relative_difference(math.nan, math.nan) == 0.0
    assert relative_difference(math.nan, 1.0) == math.inf


@pytest.mark.parametrize(
    ("name", "line", "what", "time"),
    [
        ("bundle", "| robcal, adjustment  |    0.71 |       1.0 |   3.52 |", "robcal, adjustment", 0.71),
        ("identification", "  identify, kernel at hand        44.44", "identify, kernel at", 44.44),
        ("centroids", "150 targets, 50 coded              150     46     0.39", "150 targets", 0.39),
        ("full_campaign", "detect          52.50", "detect", 52.5),
        ("full_campaign", "total           92.00   (goal 100)", "total", 92.0),
    ],
)
def test_printed_times_are_read(name: str, line: str, what: str, time: float) -> None:
    found = re.search(BENCHMARKS[name].line, line, re.MULTILINE)
    assert found is not None
    assert found["name"].startswith(what)
    assert float(found["time"]) == time
