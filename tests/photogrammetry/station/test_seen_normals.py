"""Directions of dots from the ellipses of a station's images."""

from dataclasses import replace

import numpy as np
import pytest

from robcal.photogrammetry.core.bodies import Body
from robcal.photogrammetry.station.network import StationMarks, StationOrientation
from robcal.photogrammetry.station.orientation import orient_station
from robcal.photogrammetry.station.seen_normals import Ellipses, ellipses_of, needs_normals, with_seen_normals
from robcal.transforms import invert, transform
from tests.photogrammetry.networks import disc_outline, polygon_axes
from tests.photogrammetry.stations import Station, simulate

DIAMETER = 0.02
NORMAL = np.array([0.0, 0.0, 1.0])


@pytest.fixture(scope="module")
def scene() -> tuple[Station, StationOrientation, dict[str, Ellipses]]:
    s = simulate(seed=3, poses=25, points=8, flat=False)
    ellipses = {}
    for name, m in s.marks.items():
        T = invert(s.world_T_camera[name]) @ s.world_T_body[m.pose]
        p = transform(T, s.true_points[s.body.index(m.target)])
        towards = np.sign(-np.einsum("mi,mi->m", p, T[:, :3, 2]))  # a disc looks the same from behind
        n = T[:, :3, 2] * towards[:, None]
        shapes = [
            polygon_axes(disc_outline(s.cameras[name], a, b, DIAMETER / 2, 60)) for a, b in zip(p, n, strict=True)
        ]
        axes, angle = (np.array(column) for column in zip(*shapes, strict=True))
        ellipses[name] = Ellipses(axes, angle, np.zeros(len(m)))
    return s, orient_station(s.marks, s.body, s.rough, s.sizes), ellipses


def test_dots_at_different_heights_get_their_directions(
    scene: tuple[Station, StationOrientation, dict[str, Ellipses]],
) -> None:
    s, orientation, ellipses = scene
    assert needs_normals(s.body)
    found = with_seen_normals(s.body, orientation, s.marks, ellipses)
    assert found.normals is not None
    told = np.isfinite(found.normals).all(axis=1)
    assert told.all()
    assert np.degrees(np.arccos(np.clip(np.abs(found.normals @ NORMAL), 0, 1))).max() < 1.0
    assert not needs_normals(found)


def test_nothing_is_made_up(scene: tuple[Station, StationOrientation, dict[str, Ellipses]]) -> None:
    s, orientation, ellipses = scene
    blind = {n: replace(e, semi_axes=np.full_like(e.semi_axes, np.nan)) for n, e in ellipses.items()}
    assert with_seen_normals(s.body, orientation, s.marks, blind) is s.body
    assert with_seen_normals(s.body, orientation, s.marks, {}) is s.body
    flat = simulate(seed=3, poses=3)
    assert not needs_normals(flat.body)
    corners = Body("board", s.body.ids, s.body.points, codes=("corner",) * len(s.body))
    assert not needs_normals(corners)
    assert not needs_normals(replace(s.body, normals=np.tile(NORMAL, (len(s.body), 1))))


def test_ellipses_are_those_of_the_marks() -> None:
    class Found:
        xy = np.array([[10.0, 20.0], [30.0, 40.0]])
        semi_axes = np.array([[3.0, 2.0], [5.0, 4.0]])
        angle = np.array([0.1, 0.2])
        contrast = np.array([51.0, -102.0])

    two = np.tile(np.eye(2), (2, 1, 1))
    marks = StationMarks(np.array([4, 5]), np.array([1, 2]), np.array([[30.0, 40.0], [10.0, 20.0]]), two)
    shapes = ellipses_of(marks, {4: Found()})  # type: ignore[dict-item]
    np.testing.assert_array_equal(shapes.semi_axes[0], [5.0, 4.0])
    assert shapes.angle[0] == 0.2
    assert shapes.light[0] == pytest.approx(0.4)
    assert np.isnan(shapes.light[1])
    assert np.isnan(shapes.semi_axes[1]).all()
