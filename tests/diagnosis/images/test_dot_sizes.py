"""Dots without a stated size: the diameter found in images goes into the body."""

from dataclasses import replace

import numpy as np
import pytest

from robcal.diagnosis.images.light_lag import with_dot_sizes
from robcal.photogrammetry.core.bodies import Body
from robcal.photogrammetry.core.eccentricity import centre_shift
from tests.diagnosis.image_scenes import station

DIAMETER = 0.04


def _body(**more: object) -> Body:
    points = np.random.default_rng(1).uniform(-0.2, 0.2, (5, 3))
    return Body("plate", np.arange(1, 6), points, codes=("ring12",) * 5, **more)  # type: ignore[arg-type]


def _unused():
    raise AssertionError("the images need not be looked at")


@pytest.fixture(scope="module")
def view():
    """A healthy station of round dots, and the same with the eccentricity of dots of 40 mm."""
    data = station(seed=11, targets=20, views=30).data
    data = replace(data, dots=True, normal_camera=data.camera_R_body[:, :, 2], radii=np.zeros(len(data.xy)))
    shift = np.zeros_like(data.xy)
    for c, camera in enumerate(data.cameras):
        rows = data.camera == c
        size = np.full(rows.sum(), DIAMETER / 2)
        shift[rows] = centre_shift(camera, data.p_camera[rows], data.normal_camera[rows], size)
    seen = data.residual + data.remove(data.whiten(shift[:, :, None]))[:, 0]
    return data, replace(data, residual=seen)


def test_diameter_goes_into_the_body(view) -> None:
    body, found = with_dot_sizes(_body(), lambda: view[1])
    assert [f.where for f in found] == list(view[1].names)
    sigma = found[0].sigma["diameter_mm"] / 1000.0
    assert np.allclose(body.diameters, body.diameters[0])
    assert abs(body.diameters[0] - DIAMETER) < 4.0 * sigma
    assert all("taken back" in f.statement for f in found)


def test_nothing_is_made_up_for_a_healthy_station(view) -> None:
    given = _body()
    assert with_dot_sizes(given, lambda: view[0]) == (given, ())


def test_stated_diameters_and_corners_are_left_alone() -> None:
    stated = _body(diameters=np.full(5, 0.01))
    assert with_dot_sizes(stated, _unused) == (stated, ())
    corners = replace(_body(), codes=("corner",) * 5)
    assert with_dot_sizes(corners, _unused) == (corners, ())
