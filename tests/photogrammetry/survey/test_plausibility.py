"""Scale of a survey against everything else that has a length: factors of a wrong unit are errors, per cents notes."""

from types import SimpleNamespace

import numpy as np
import pytest

from robcal.errors import InvalidInput
from robcal.photogrammetry.core.network import Lengths
from robcal.photogrammetry.survey.final_frame import rough_scale, scale_notes

POINTS = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0.2]])
NETWORK = SimpleNamespace(ids=np.array([1, 2, 3, 4]), points=POINTS / 0.5)  # two units of its own are a metre
NONE = Lengths.none()
BAR = Lengths([[1, 2]], [1.0], [1e-5])
UNKNOWN = np.full((4, 3), np.nan)


def test_scale_bars_give_the_scale() -> None:
    assert rough_scale(NETWORK, BAR) == pytest.approx(0.5)


def test_agreement_says_nothing() -> None:
    check = Lengths([[1, 3]], [1.0], [np.nan])
    assert scale_notes(NETWORK, POINTS, BAR, check, 0.5, 2.0) == []


@pytest.mark.parametrize(
    ("given", "checks", "ratio"),
    [
        (1000 * POINTS, NONE, None),  # millimetres taken for metres
        (UNKNOWN, Lengths([[1, 3]], [1000.0], [np.nan]), None),
        (UNKNOWN, NONE, 2000.0),
    ],
)
def test_another_unit_is_an_error(given: np.ndarray, checks: Lengths, ratio: float | None) -> None:
    with pytest.raises(InvalidInput, match="unit"):
        scale_notes(NETWORK, given, BAR, checks, 0.5, ratio)


def test_per_cents_are_noted() -> None:
    notes = scale_notes(NETWORK, POINTS / 1.03, BAR, NONE, 0.5, 3.0)
    assert len(notes) == 2
    assert "+3 %" in notes[0]
    assert "1.50 times" in notes[1]


def test_check_length_whose_end_is_not_measured_is_no_contradiction() -> None:
    assert scale_notes(NETWORK, UNKNOWN, BAR, Lengths([[1, 9]], [77.0], [np.nan]), 0.5, None) == []
