"""The bound against a brute-force Fisher matrix from a supersampled renderer."""

import numpy as np
import pytest

from robcal.errors import InvalidInput
from robcal.imaging.cramer_rao import centre_bound
from robcal.imaging.noise import NoiseModel
from tests.imaging.rendering import Dot, render


@pytest.mark.parametrize(
    ("a", "b", "angle"), [(1.0, 1.0, 0.0), (1.5, 0.8, 0.5), (3.0, 3.0, 0.0), (6.0, 3.5, 0.7), (12.0, 9.0, 2.0)]
)
def test_bound_agrees_with_brute_force(a: float, b: float, angle: float) -> None:
    noise = NoiseModel(2.0, 0.04, 15.0)
    contrast, background, blur, size = 150.0, 15.0, 0.8, int(2 * a + 16)
    middle = size / 2

    def grey(dx: float, dy: float) -> np.ndarray:
        light = render(size + 1, size + 1, [Dot(middle + dx, middle + dy, a, b, angle)], blur, sub=16)
        return (background + contrast * light).ravel()

    h = 1 / 16
    jacobian = np.column_stack([grey(h, 0) - grey(-h, 0), grey(0, h) - grey(0, -h)]) / (2 * h)
    fisher = (jacobian / noise.at(grey(0, 0))[:, None]).T @ jacobian
    bound = centre_bound((a, b), angle, blur, contrast, background, noise, known_shape=True)
    np.testing.assert_allclose(bound, np.linalg.inv(fisher), rtol=0.08, atol=0.04 * np.trace(bound))


def test_unknown_shape_costs_nothing_for_the_centre_of_a_symmetric_dot() -> None:
    noise = NoiseModel(1.0, 0.0, 10.0)
    known = centre_bound((6.0, 4.0), 0.3, 0.7, 100.0, 10.0, noise, known_shape=True)
    free = centre_bound((6.0, 4.0), 0.3, 0.7, 100.0, 10.0, noise)
    np.testing.assert_allclose(free, known, rtol=1e-3, atol=1e-9)


def test_large_sharp_dot_has_the_closed_form() -> None:
    # information of a straight edge of length L: A^2 L / (2 sqrt(pi) s v); half of a circle's counts for each axis
    noise = NoiseModel(4.0, 0.0, 10.0)
    s = np.sqrt(0.7**2 + 1 / 12)
    bound = centre_bound((30.0, 30.0), 0.0, 0.7, 100.0, 10.0, noise)
    expected = 4.0 * 2 * np.sqrt(np.pi) * s / (100.0**2 * np.pi * 30.0)
    assert bound[0, 0] == pytest.approx(expected, rel=0.02)


def test_refuses_no_dot() -> None:
    with pytest.raises(InvalidInput):
        centre_bound((0.0, 1.0), 0.0, 0.7, 100.0, 10.0, NoiseModel(1.0, 0.0, 0.0))
