"""Centres that lag behind their light: told, and taken back from the marks."""

from dataclasses import replace

import numpy as np
import pytest

from robcal.diagnosis.images.light_lag import without_lag
from robcal.photogrammetry.station.seen_normals import Ellipses
from robcal.physics.images.data import ImageData
from robcal.recipe.station import light_of
from tests.diagnosis.image_scenes import Station, station

LAG = np.array([0.4, 0.0])


@pytest.fixture(scope="module")
def scene() -> tuple[Station, dict[str, Ellipses], ImageData]:
    """A healthy station of dots whose light differs between poses and a little between dots."""
    made = station(seed=11, targets=20, views=30)
    rng = np.random.default_rng(5)
    by_pose = rng.uniform(0.2, 0.8, 30)
    shapes = {}
    for name, m in made.marks.items():
        light = by_pose[m.pose] * rng.uniform(0.88, 1.0, len(m))
        shapes[name] = Ellipses(np.full((len(m), 2), 5.0), np.zeros(len(m)), light)
    light = light_of(made.orientation, made.marks, shapes)
    assert light is not None
    assert np.isfinite(light).all()
    return made, shapes, replace(made.data, dots=True, light=light)


def _lagging(data: ImageData, name: str) -> ImageData:
    light = np.where(data.camera == data.names.index(name), data.light, 0.0)
    shift = light[:, None, None] * LAG[None, :, None]
    return replace(data, residual=data.residual + data.remove(data.whiten(shift))[:, 0])


def test_lag_is_told_and_taken_back(scene: tuple[Station, dict[str, Ellipses], ImageData]) -> None:
    made, shapes, data = scene
    marks, found = without_lag(made.marks, shapes, lambda: _lagging(data, "left"))
    assert [(f.name, f.where) for f in found] == [("centroid_bias", "left")]
    lag, sigma = (np.array(table["by_light_px"]) for table in (found[0].parameters, found[0].sigma))
    assert np.all(np.abs(lag - LAG) < 4.0 * sigma)
    assert sigma.max() < 0.15
    taken = made.marks["left"].xy - marks["left"].xy
    np.testing.assert_allclose(taken, shapes["left"].light[:, None] * lag, atol=1e-12)
    assert marks["right"] is made.marks["right"]
    assert "taken back" in found[0].statement


def test_healthy_stations_stay_as_they_are(scene: tuple[Station, dict[str, Ellipses], ImageData]) -> None:
    made, shapes, data = scene
    marks, found = without_lag(made.marks, shapes, lambda: data)
    assert found == ()
    assert all(marks[name] is made.marks[name] for name in marks)


def test_marks_of_other_programs_have_no_light(scene: tuple[Station, dict[str, Ellipses], ImageData]) -> None:
    made, _, data = scene
    assert light_of(made.orientation, made.marks, {}) is None

    def unused() -> ImageData:
        raise AssertionError("the images need not be looked at")

    assert without_lag(made.marks, {}, unused)[1] == ()
    even = replace(data, light=np.full(len(data.xy), 0.5))
    assert (
        without_lag(made.marks, {"left": Ellipses(*(np.zeros((0, 2)), np.zeros(0), np.zeros(0)))}, lambda: even)[1]
        == ()
    )
