"""The comparison centre: near the truth on even dots, none where there is no contour."""

import numpy as np

from robcal.imaging.detect import detect_targets
from robcal.imaging.other_centroids import contour_centres
from tests.imaging.rendering import Dot, expose, render, scene


def test_contour_is_near_on_an_even_dot() -> None:
    image = expose(render(60, 60, [Dot(30.3, 29.6, 8, 6, 0.5)]), np.random.default_rng(1), read_noise=0.3, gain=0.0)
    args = (image, np.array([[30.0, 30.0]]), np.array([[8.0, 6.0]]), np.array([15.0]))
    assert np.abs(contour_centres(*args, np.array([180.0]))[0] - (30.3, 29.6)).max() < 0.06


def test_no_contour_is_nan() -> None:
    flat = np.full((40, 40), 20, np.uint8)
    centre = contour_centres(flat, np.array([[20.0, 20.0]]), np.array([[5.0, 5.0]]), np.array([20.0]), np.array([50.0]))
    assert np.isnan(centre).all()


def test_only_doubtful_dots_get_a_second_centre() -> None:
    rng = np.random.default_rng(5)
    light = render(400, 300, scene(rng, 400, 300, 20, (5.0, 9.0), [], 2.5))
    found = detect_targets(expose(light, rng))
    assert len(found) == 20
    assert np.isnan(found.contour_offset).all()
    assert not found.contradicted.any()


def test_a_dot_with_a_fleck_is_contradicted_and_no_other() -> None:
    rng = np.random.default_rng(6)
    dots = [Dot(50.0 + 80 * i, 50.0 + 80 * j, 12, 11, 0.3 * i) for i in range(4) for j in range(3)]
    light = render(340, 260, dots)
    light[44:56, 56:64] *= 0.75  # translucent, inside the right half of the first dot
    found = detect_targets(expose(light, rng))
    assert len(found) == 12
    first = int(np.argmin(np.linalg.norm(found.xy - 50.0, axis=1)))
    assert found.contour_offset[first] > 0.1
    assert np.flatnonzero(found.contradicted).tolist() == [first]
    assert np.isfinite(found.contour_offset).sum() == 1
