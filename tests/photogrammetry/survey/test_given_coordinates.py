"""Given coordinates that a survey refutes."""

import numpy as np
import pytest

from robcal.photogrammetry.survey.given_coordinates import compare_given
from robcal.transforms import frame_from_xyzrpy, transform

RNG = np.random.default_rng(3)
GIVEN = np.column_stack([RNG.uniform(-0.2, 0.2, (12, 2)), RNG.uniform(0, 0.03, 12)])
IDS = np.arange(10, 22)
SIGMA = np.full(12, 3e-4)


def _surveyed(given: np.ndarray) -> np.ndarray:
    moved = transform(frame_from_xyzrpy([0.1, 0.2, 0.3, 0.4, -0.5, 0.6]), given)
    return moved + np.random.default_rng(4).normal(0, 1e-4, given.shape)


def test_sound_coordinates() -> None:
    found = compare_given(IDS, _surveyed(GIVEN), GIVEN, SIGMA)
    assert found.contradicting == ()
    assert found.mirrored is None


@pytest.mark.parametrize("target", range(12))
@pytest.mark.parametrize("by", [0.05, 0.004])
@pytest.mark.parametrize("stated", [True, False])
def test_one_target_off(target: int, by: float, stated: bool) -> None:
    given = GIVEN.copy()
    given[target, target % 3] += by
    found = compare_given(IDS, _surveyed(GIVEN), given, SIGMA if stated else np.full(12, np.nan))
    ((number, deviation, sigma),) = found.contradicting
    assert number == IDS[target]
    assert deviation == pytest.approx(by, rel=0.2)
    assert np.isfinite(sigma) == stated
    assert f"target {number} of 'plate' contradict the survey" in found.sentences("plate")[0]


@pytest.mark.parametrize("axis", range(3))
def test_mirror_images(axis: int) -> None:
    signs = np.where(np.arange(3) == axis, -1.0, 1.0)
    found = compare_given(IDS, _surveyed(GIVEN * signs), GIVEN, SIGMA)
    assert found.mirrored is not None
    assert found.mirrored[1] < 0.2 * found.mirrored[0]


def test_a_plane_body_tells_no_mirror_image_and_three_targets_nothing() -> None:
    plane = GIVEN * [1.0, 1.0, 0.0]
    assert compare_given(IDS, _surveyed(plane * [1.0, -1.0, 1.0]), plane, SIGMA).mirrored is None
    few = np.where(np.arange(12)[:, None] < 3, GIVEN + np.array([0.05, 0, 0]), np.nan)
    assert compare_given(IDS, _surveyed(GIVEN), few, SIGMA).contradicting == ()
