"""Matching of uncoded dots: gates, ambiguity, new points, sizes."""

import numpy as np

from robcal.photogrammetry.survey.matching import Geometry, Sightings, is_dot, match_known, seen_diameters
from robcal.photogrammetry.survey.new_points import find_new_points
from tests.photogrammetry.networks import Truth, make_network


def scene(seed: int = 0) -> tuple[Truth, Geometry, Sightings]:
    truth = make_network(np.random.default_rng(seed), images=8, targets=20)
    n, t = 8, 20
    geometry = Geometry(
        truth.camera,
        truth.camera_T_body,
        truth.points,
        np.tile(1e-10 * np.eye(6), (n, 1, 1)),
        np.tile(1e-10 * np.eye(3), (t, 1, 1)),
        np.zeros((9, 9)),
    )
    m = len(truth.marks)
    return truth, geometry, Sightings(truth.marks.image, truth.marks.xy, np.full(m, truth.sigma), np.full(m, 8.0))


def test_known_points_take_their_dots() -> None:
    truth, geometry, sightings = scene()
    none = np.full(len(truth.marks), -1)
    found = match_known(geometry, sightings, none, np.full((20, 3), np.nan), 10.0)
    np.testing.assert_array_equal(found, truth.marks.target)


def test_two_dots_within_the_gate_are_left_out() -> None:
    truth, geometry, sightings = scene()
    rival = sightings.xy[:1] + 0.3
    more = Sightings(
        np.append(sightings.image, sightings.image[0]),
        np.vstack([sightings.xy, rival]),
        np.append(sightings.sigma, truth.sigma),
        np.append(sightings.size, 8.0),
    )
    found = match_known(geometry, more, np.full(len(more.image), -1), np.full((20, 3), np.nan), 10.0)
    assert found[0] == -1
    assert found[-1] == -1
    np.testing.assert_array_equal(found[1:-1], truth.marks.target[1:])


def test_two_points_that_claim_one_dot_get_none() -> None:
    truth, geometry, sightings = scene()
    double = geometry.with_points(truth.points[:1] + 1e-5, 1e-10 * np.eye(3)[None])
    found = match_known(double, sightings, np.full(len(truth.marks), -1), np.full((21, 3), np.nan), 10.0)
    assert (found[truth.marks.target == 0] == -1).all()


def test_the_back_of_a_point_is_not_searched() -> None:
    truth, geometry, sightings = scene()
    normals = np.tile([0.0, 0.0, -1.0], (20, 1))
    found = match_known(geometry, sightings, np.full(len(truth.marks), -1), normals, 10.0)
    assert (found == -1).all()


def test_new_points_are_where_they_are() -> None:
    truth, geometry, sightings = scene()
    known = truth.marks.target < 6
    found = find_new_points(
        geometry, sightings, np.where(known, truth.marks.target, -1), centre=np.zeros(3), radius=1.0
    )
    assert len(found.points) == 14
    for point, C, members in zip(found.points, found.covariance, found.members, strict=True):
        target = truth.marks.target[members]
        assert len(set(target.tolist())) == 1
        e = point - truth.points[target[0]]
        assert e @ np.linalg.solve(C, e) < 40.0
    nowhere = find_new_points(geometry, sightings, truth.marks.target, centre=np.zeros(3), radius=1.0)
    assert len(nowhere.points) == 0


def test_clutter_makes_no_points() -> None:
    rng = np.random.default_rng(1)
    _, geometry, _ = scene()
    image = np.repeat(np.arange(8), 15)
    clutter = Sightings(image, rng.uniform(20, 1750, (120, 2)), np.full(120, 0.05), np.full(120, 8.0))
    found = find_new_points(geometry, clutter, np.full(120, -1), centre=np.zeros(3), radius=1.0, min_images=4)
    assert len(found.points) == 0


def test_sizes() -> None:
    truth, geometry, _ = scene()
    image = np.arange(8)
    depth = truth.camera_T_body[:, 2, :3] @ truth.points[3] + truth.camera_T_body[:, 2, 3]
    major = 0.004 * truth.camera.fx / depth
    seen = seen_diameters(geometry, truth.points[3], image, major)
    np.testing.assert_allclose(seen, 0.008, rtol=1e-12)
    sizes = np.array([[0.007, 0.009]])
    assert is_dot(seen, sizes)
    assert not is_dot(2.0 * seen, sizes)
    assert not is_dot(seen * np.linspace(0.5, 1.5, 8), sizes)
    assert is_dot(np.full(8, np.nan), sizes)
    assert is_dot(2.0 * seen, np.zeros((0, 2)))
