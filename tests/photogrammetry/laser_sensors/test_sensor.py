"""Laser sensors against cameras and beams that share nothing with them: places, covariance, refusals."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from fixtures.laser_sensors import raw
from robcal.errors import DegenerateGeometry, InvalidInput
from robcal.photogrammetry.laser_sensors.calibration import calibrate_sensor
from robcal.photogrammetry.laser_sensors.sensor import FREE, NUMBERS, READINGS, model

KINDS = list(READINGS)
TELLS = {"point": [2], "section": [1, 2], "spot": [0, 1, 2], "axial": [2]}


def _places(kind: str, count: int, rng: np.random.Generator) -> np.ndarray:
    p = rng.uniform([-0.03, -0.03, 0.15], [0.03, 0.03, 0.25], (count, 3))
    return p * np.isin([0, 1, 2], TELLS[kind])


@pytest.mark.parametrize("kind", KINDS)
def test_a_calibrated_sensor_gives_places_within_the_covariance_that_it_states(kind: str) -> None:
    rng = np.random.default_rng(KINDS.index(kind))
    at, noise, squares, misses = TELLS[kind], 0.1, [], []
    for _ in range(16):
        known = _places(kind, 40, rng)
        sensor = calibrate_sensor(kind, raw(kind, known, noise, rng), known, aim=1e-3).sensor
        true = _places(kind, 60, rng)
        p, C, J = sensor.points(raw(kind, true, noise, rng))
        whole = C + J @ sensor.covariance @ np.swapaxes(J, 1, 2)
        off = (p - true)[:, at]
        misses.append(off)
        squares.append(np.einsum("mi,mij,mj->m", off, np.linalg.inv(whole[:, at][:, :, at]), off))
    inside = np.mean(np.concatenate(squares) < stats.chi2.ppf(0.95, len(at)))
    assert 0.93 < inside < 0.97
    assert np.abs(np.concatenate(misses)).max() < 4e-4


@pytest.mark.parametrize("kind", KINDS)
def test_derivatives_agree_with_differences(kind: str) -> None:
    rng = np.random.default_rng(1)
    known = _places(kind, 40, rng)
    numbers = calibrate_sensor(kind, raw(kind, known, 0.0, rng), known, aim=1e-3).sensor.numbers
    p = _places(kind, 5, rng)
    _, by_point, by_numbers = model(kind, p, numbers)
    for k in FREE[kind]:
        step = 1e-6 * np.eye(3)[k]
        slope = (model(kind, p + step, numbers)[0] - model(kind, p - step, numbers)[0]) / 2e-6
        assert np.allclose(slope, by_point[:, :, k], rtol=1e-5, atol=1e-5)
    for k in range(len(NUMBERS[kind])):
        size = 1e-6 * max(abs(numbers[k]), 1.0 if NUMBERS[kind][k][0] in "gp" else 1e-3)
        step = size * np.eye(len(numbers))[k]
        slope = (model(kind, p, numbers + step)[0] - model(kind, p, numbers - step)[0]) / (2.0 * size)
        assert np.allclose(slope, by_numbers[:, :, k], rtol=1e-4, atol=1e-4 * np.abs(by_numbers[:, :, k]).max() + 1e-9)


def test_coordinates_that_no_reading_tells_are_as_uncertain_as_the_aim() -> None:
    rng = np.random.default_rng(2)
    known = _places("point", 30, rng)
    sensor = calibrate_sensor("point", raw("point", known, 0.1, rng), known, aim=2e-3).sensor
    _, C, _ = sensor.points(raw("point", known[:3], 0.1, rng))
    assert np.allclose(np.sqrt(C[:, [0, 1], [0, 1]]), 2e-3)
    assert np.all(np.sqrt(C[:, 2, 2]) < 1e-4)


@pytest.mark.parametrize(
    ("kind", "change", "sentence"),
    [
        ("point", lambda p: p[:3], r"3 places: .* has 3 numbers, 5 places are needed"),
        ("axial", lambda p: 0.0 * p + [0, 0, 0.2], "do not differ in depth"),
        ("section", lambda p: p * [0, 0, 1], "lie on a line: move the target"),
        ("spot", lambda p: p * [1, 1, 0] + [0, 0, 0.2], r"lie in a plane|do not"),
    ],
)
def test_places_that_do_not_determine_a_sensor_are_refused(kind: str, change, sentence: str) -> None:  # type: ignore[no-untyped-def]
    rng = np.random.default_rng(3)
    places = change(_places(kind, 30, rng))
    with pytest.raises(DegenerateGeometry, match=sentence):
        calibrate_sensor(kind, raw(kind, places, 0.1, rng), places, aim=1e-3)


def test_readings_that_belong_to_other_places_are_refused() -> None:
    rng = np.random.default_rng(4)
    known = _places("spot", 40, rng)
    with pytest.raises(InvalidInput, match="are those of no sensor of kind 'spot'"):
        calibrate_sensor("spot", rng.permutation(raw("spot", known, 0.1, rng)), known)
    with pytest.raises(InvalidInput, match="state how far beside the target"):
        calibrate_sensor("point", raw("point", known, 0.1, rng), known)
