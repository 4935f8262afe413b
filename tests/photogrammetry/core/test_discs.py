"""Sizes and directions of discs from the ellipses that they show."""

from dataclasses import replace

import numpy as np
import pytest

from robcal.photogrammetry.core.discs import Discs, discs_from_ellipses, modelled_discs, size_ratio
from robcal.photogrammetry.core.eccentricity import shape_normals
from robcal.transforms import Array, transform
from tests.photogrammetry.networks import Truth, disc_outline, make_network, polygon_axes

DIAMETER = 0.012


def ellipses(truth: Truth) -> tuple[Array, Array]:
    """Axes (m, 2) and angles (m,) of all marks, from outlines."""
    marks = truth.marks
    T = truth.camera_T_body[marks.image]
    p = transform(T, truth.points[marks.target])
    n = np.einsum("mij,mj->mi", T[:, :3, :3], truth.normals[marks.target])
    found = [polygon_axes(disc_outline(truth.camera, a, b, DIAMETER / 2, 60)) for a, b in zip(p, n, strict=True)]
    return np.array([axes for axes, _ in found]), np.array([angle for _, angle in found])


def discs(truth: Truth, axes: Array, angle: Array, scale: float = 1.0) -> Discs:
    T = truth.camera_T_body.copy()
    T[:, :3, 3] *= scale
    return discs_from_ellipses(
        truth.camera, T, scale * truth.points, truth.marks.image, truth.marks.target, axes, angle
    )


def turned(a: Array, b: Array) -> Array:
    return np.degrees(np.arccos(np.clip(np.einsum("ti,ti->t", a, b), -1, 1)))


@pytest.mark.parametrize("body", ["plate", "sphere", "cube"])
def test_diameter_and_outward_normal(body: str) -> None:
    truth = make_network(np.random.default_rng(3), body, images=60, targets=24)
    axes, angle = ellipses(truth)
    found = discs(truth, axes, angle)
    assert (found.images >= 4).all()
    np.testing.assert_allclose(found.diameter, DIAMETER, rtol=5e-3)
    assert turned(found.normal, truth.normals).max() < 1.0
    smaller = discs(truth, axes, angle, scale=0.3)
    np.testing.assert_allclose(smaller.diameter, 0.3 * found.diameter, rtol=1e-9)


def test_noise_of_the_axes_is_told_by_sigma() -> None:
    rng = np.random.default_rng(4)
    truth = make_network(rng, "plate", images=25, targets=40)
    axes, angle = ellipses(truth)
    noisy = axes * (1.0 + rng.normal(0.0, 0.02, axes.shape))
    found = discs(truth, noisy, angle)
    ratio = np.radians(turned(found.normal, truth.normals)) / found.sigma
    assert 0.5 < np.sqrt(np.mean(ratio**2)) < 1.5


def test_an_ellipse_half_hidden_does_not_count() -> None:
    truth = make_network(np.random.default_rng(5), "plate", images=25, targets=12)
    axes, angle = ellipses(truth)
    bad = np.flatnonzero(truth.marks.target == 3)[:3]
    axes[bad, 1] *= 0.4
    found = discs(truth, axes, angle)
    assert found.images[3] == np.count_nonzero(truth.marks.target == 3) - 3
    assert turned(found.normal, truth.normals).max() < 1.0


def test_frontal_images_alone_and_marks_without_ellipses_tell_nothing() -> None:
    truth = make_network(np.random.default_rng(6), "plate", images=6, targets=9, tilt=(0.0, 0.0))
    axes, angle = ellipses(truth)
    found = discs(truth, axes * (1.0 + np.random.default_rng(1).normal(0.0, 0.01, axes.shape)), angle)
    known = np.isfinite(found.sigma)
    assert np.all(found.sigma[known] > np.radians(2.0))
    none = discs(truth, np.full_like(axes, np.nan), angle)
    assert np.isnan(none.diameter).all()
    assert not none.images.any()


def test_stated_diameters_hold_and_calibrate_the_measured_ones() -> None:
    truth = make_network(np.random.default_rng(7), "plate", images=20, targets=16)
    axes, angle = ellipses(truth)
    stated = np.full(16, DIAMETER)
    stated[5] = 0.0
    swollen = discs(truth, 1.02 * axes, angle)
    diameters, normals = modelled_discs(swollen, stated, truth.points)
    assert size_ratio(swollen, stated) == pytest.approx(1.02, abs=2e-3)
    np.testing.assert_allclose(diameters, DIAMETER, rtol=2e-3)
    assert normals is None  # the plate's own shape says the same
    # in a scale of its own the network gets diameters of that scale
    small = discs(truth, axes, angle, scale=0.1)
    np.testing.assert_allclose(modelled_discs(small, stated, 0.1 * truth.points)[0], 0.1 * DIAMETER, rtol=5e-3)
    # nothing is made up where nothing is stated
    nothing, _ = modelled_discs(swollen, np.zeros(16), truth.points)
    assert not nothing.any()


def test_normals_that_the_shape_cannot_tell_come_from_the_ellipses() -> None:
    truth = make_network(np.random.default_rng(8), "cube", images=60, targets=24)
    axes, angle = ellipses(truth)
    _, normals = modelled_discs(discs(truth, axes, angle), np.full(24, DIAMETER), truth.points)
    assert normals is not None
    assert turned(normals, truth.normals).max() < 1.5


def test_targets_of_different_heights_do_not_lean() -> None:
    rng = np.random.default_rng(9)
    truth = make_network(rng, "plate", images=40, targets=24)
    raised = replace(truth, points=truth.points + rng.uniform(0.0, 0.06, (24, 1)) * truth.normals)
    axes, angle = ellipses(raised)
    shape = shape_normals(raised.points)[0]
    leaning = turned(np.abs(shape), np.abs(raised.normals))
    assert np.nanmax(leaning) > 2.0  # what the shape alone says
    _, normals = modelled_discs(discs(raised, axes, angle), np.full(24, DIAMETER), raised.points)
    assert normals is not None
    assert turned(normals, raised.normals).max() < 1.0
