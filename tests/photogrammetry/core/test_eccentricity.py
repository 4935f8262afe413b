"""Where the centre of a dot's image lies: against brute force with polygons; normals from the shape of a body."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from robcal.photogrammetry.core.bodies import Body
from robcal.photogrammetry.core.camera import Camera, project
from robcal.photogrammetry.core.eccentricity import body_normals, centre_shift, fit_sphere, rim_offset
from tests.photogrammetry.networks import plate_points, polygon_centre, sphere_points


@given(st.integers(0, 2**32 - 1), st.booleans())
@settings(max_examples=25, deadline=None)
def test_shift_against_polygons(seed: int, distorted: bool) -> None:
    rng = np.random.default_rng(seed)
    f = rng.uniform(0.8, 3.0) * 2400
    k = (-0.25, 0.3, 3e-4, -4e-4, -0.04) if distorted else (0.0,) * 5
    camera = Camera(2400, 1800, f, 1.001 * f, 1210.0, 890.0, *k)
    uv = rng.uniform([150, 150], [2250, 1650], 2)
    p = np.array([(uv[0] - 1210) / f, (uv[1] - 890) / f, 1.0]) * rng.uniform(0.8, 4.0)
    normal = -p / np.linalg.norm(p) + 0.7 * rng.normal(size=3)
    normal /= np.linalg.norm(normal)
    radius = rng.uniform(5.0, 25.0) * p[2] / f  # 5 to 25 px
    expected = polygon_centre(camera, p, normal, radius) - project(camera, p)
    shift = centre_shift(camera, p[None], normal[None], np.array([radius]))[0]
    size = np.linalg.norm(expected)
    # without distortion exact but for the polygon; with it to second order of the dot's size
    np.testing.assert_allclose(shift, expected, atol=1e-3 + (0.02 * size if distorted else 1e-3 * size))


def test_sign_of_the_normal_and_unknown_sizes_do_not_matter() -> None:
    camera = Camera.from_size(2000, 1500)
    p = np.array([[0.1, -0.2, 2.0]] * 4)
    n = np.array([[0.3, 0.2, -0.93], [-0.3, -0.2, 0.93], [np.nan] * 3, [0.3, 0.2, -0.93]])
    n[[0, 1, 3]] /= np.linalg.norm(n[0])
    shift = centre_shift(camera, p, n, np.array([0.02, 0.02, 0.02, 0.0]))
    np.testing.assert_allclose(shift[0], shift[1], atol=1e-12)
    np.testing.assert_array_equal(shift[2:], 0.0)
    assert np.linalg.norm(shift[0]) > 0.01


def test_normals_of_plate_sphere_and_cylinder() -> None:
    rng = np.random.default_rng(1)
    plate = body_normals(plate_points(rng, 30))
    np.testing.assert_allclose(np.abs(plate[:, 2]), 1.0, atol=1e-3)
    sphere = sphere_points(rng, 40)
    np.testing.assert_allclose(body_normals(sphere + np.array([1.0, 2.0, 3.0])), sphere / 0.2, atol=1e-6)
    z, phi = (a.ravel() for a in np.meshgrid(np.linspace(0, 1.0, 12), np.linspace(0, 2 * np.pi, 30, endpoint=False)))
    radial = np.stack([np.cos(phi), np.sin(phi), np.zeros_like(phi)], axis=1)
    cylinder = body_normals(0.4 * radial + z[:, None] * [0.0, 0.0, 1.0])
    inside = (z > 0.05) & (z < 0.95)
    cosine = np.sum(cylinder * radial, axis=1)[inside]
    assert np.nanmin(cosine) > 0.97
    assert np.isfinite(cosine).mean() > 0.9


def test_a_bar_on_the_plate_does_not_bend_its_neighbours_normals() -> None:
    rng = np.random.default_rng(4)
    plate = plate_points(rng, 40)
    bar = np.array([[-0.5, -0.45, 0.02], [0.5, -0.45, 0.02]])
    far = np.array([[0.0, 0.0, 0.7]])
    normals = body_normals(np.concatenate([plate, bar, far]))
    np.testing.assert_allclose(np.abs(normals[:-1, 2]), 1.0, atol=2e-3)
    sphere = sphere_points(rng, 40)
    around = np.concatenate([sphere, [[0.5, 0.0, 0.0], [-0.5, 0.1, 0.0]]])
    np.testing.assert_allclose(body_normals(around)[:40], sphere / 0.2, atol=1e-6)


def test_shapeless_bodies_have_no_normals() -> None:
    cloud = np.random.default_rng(2).normal(size=(30, 3))
    assert np.isnan(body_normals(cloud)).any(axis=1).mean() > 0.7
    assert np.isnan(body_normals(cloud[:2])).all()
    three = body_normals(np.eye(3))
    np.testing.assert_allclose(np.abs(three), 1 / np.sqrt(3), atol=1e-12)


def test_sphere_fit() -> None:
    p = sphere_points(np.random.default_rng(3), 25, 0.3) + np.array([0.1, 0.2, -5.0])
    centre, radius, misfit = fit_sphere(p)
    np.testing.assert_allclose(centre, [0.1, 0.2, -5.0], atol=1e-9)
    assert radius == pytest.approx(0.3)
    assert misfit < 1e-9


def test_a_dot_on_a_sphere_ends_below_its_centre() -> None:
    p = sphere_points(np.random.default_rng(5), 40) + np.array([1.0, 2.0, 3.0])
    radii = np.full(40, 0.0025)
    radii[7] = 0.0
    normals = body_normals(p)
    offset = rim_offset(p, radii, normals)
    depth = 0.2 - np.sqrt(0.2**2 - 0.0025**2)
    others = np.arange(40) != 7
    np.testing.assert_allclose(offset[others], -depth * normals[others], rtol=1e-6, atol=1e-12)
    assert not offset[7].any()
    # on facets, and on a plate, it does not
    tilted = normals + 0.3 * np.random.default_rng(6).normal(size=normals.shape)
    tilted /= np.linalg.norm(tilted, axis=1)[:, None]
    facets = np.abs(np.einsum("ti,ti->t", tilted, normals)) < 0.98
    assert not rim_offset(p, radii, tilted)[facets].any()
    assert not rim_offset(plate_points(np.random.default_rng(7), 40), radii).any()


def test_targets_of_different_heights_on_a_plate_are_on_no_sphere() -> None:
    rng = np.random.default_rng(5)
    raised = plate_points(rng, 30)
    raised[:, 2] += rng.uniform(0.0, 0.05, 30)
    np.testing.assert_array_equal(rim_offset(raised, np.full(30, 0.01)), 0.0)
    body = Body("plate", np.arange(30), raised)
    assert np.isnan(body.estimated_normals()).all()
