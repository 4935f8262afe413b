"""Cleaning of a station: which contradiction is found first, what is left out, what is dropped from the lens model."""

import numpy as np
import pytest

from robcal.photogrammetry.station.cleaning import mark_statistic
from robcal.photogrammetry.station.network import StationOrientation, StationSettings
from robcal.photogrammetry.station.orientation import orient_station
from tests.photogrammetry.stations import Station, simulate


def _oriented(station: Station, **settings: object) -> StationOrientation:
    options = StationSettings(**settings)  # type: ignore[arg-type]
    return orient_station(station.marks, station.body, station.rough, station.sizes, settings=options)


def _contradictions(done: StationOrientation) -> list[str]:
    return [found.kind for found in done.evidence if found.kind in ("camera_moved", "target_shifted")]


def test_statistic_is_chi_square_of_the_redundant_part() -> None:
    rng = np.random.default_rng(1)
    A = rng.normal(size=(2000, 2, 2))
    R = A @ np.swapaxes(A, 1, 2) + 0.1 * np.eye(2)
    r = np.einsum("mij,mj->mi", np.linalg.cholesky(R), rng.normal(size=(2000, 2)))  # covariance R
    np.testing.assert_allclose(
        mark_statistic(r, R), np.einsum("mi,mij,mj->m", r, np.linalg.inv(R), r), rtol=1e-6, atol=1e-9
    )
    assert np.mean(mark_statistic(r, R)) == pytest.approx(2.0, abs=0.15)


def test_mark_without_redundancy_in_one_direction_is_tested_in_the_other() -> None:
    R = np.diag([0.5, 0.0])[None]
    np.testing.assert_allclose(mark_statistic(np.array([[1.0, 7.0]]), R), [2.0])
    assert mark_statistic(np.array([[1.0, 7.0]]), np.zeros((1, 2, 2)))[0] == 0.0


def test_clean_station_loses_nothing() -> None:
    done = _oriented(simulate(seed=3, poses=30))
    assert _contradictions(done) == []
    assert len(done.rejected) <= 2


def test_isolated_gross_errors_are_left_out_one_by_one() -> None:
    station = simulate(seed=4, poses=30)
    rng = np.random.default_rng(4)
    marks = station.marks["left"]
    bad = rng.choice(len(marks.pose), 5, replace=False)
    xy = marks.xy.copy()
    xy[bad] += 1.5
    station.change("left", xy=xy)
    done = _oriented(station)
    planted = {(int(marks.pose[i]), int(marks.target[i])) for i in bad}
    assert planted <= {(r.pose, r.target) for r in done.rejected if r.camera == "left"}
    # of two rays that miss one another the other one may go with it
    assert len({(r.pose, r.target) for r in done.rejected} - planted) <= 2
    assert {r.kind for r in done.rejected} == {"outlier"}
    assert _contradictions(done) == []


def test_slipped_image_is_a_contradiction_of_images_not_of_marks() -> None:
    station = simulate(seed=5, poses=30, cameras=3)
    marks = station.marks["right"]
    xy = marks.xy.copy()
    xy[marks.pose == 7] += [4.0, 0.0]
    station.change("right", xy=xy)
    done = _oriented(station)
    assert [(r.camera, r.pose, r.target) for r in done.rejected if r.kind == "contradiction"] == [("right", 7, -1)]


def test_groups_of_the_lens_that_carry_nothing_are_dropped() -> None:
    done = _oriented(simulate(seed=6, poses=40))
    for camera in done.cameras:
        assert camera.k3 == 0.0  # the true lens has none
        assert camera.k1 == pytest.approx(-0.08, abs=0.02)
