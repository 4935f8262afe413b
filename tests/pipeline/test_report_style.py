"""How numbers and plots of the report are written."""

import numpy as np
import pytest

from pipeline.report.parameter_chapter import _readable
from pipeline.report.style import scene, to_sigma


@pytest.mark.parametrize(
    ("value", "sigma", "expected"),
    [
        (-0.018234, 0.0004, "-0.01823"),
        (0.0002066, 0.00028, "0.00021"),
        (1234.5678, 12.0, "1235"),
        (0.5, 0.0, "0.5000"),
        (0.5, float("nan"), "0.5000"),
        (3.0e-8, 2.0e-3, "0.0000"),
    ],
)
def test_a_value_has_the_decimals_of_its_sigma(value: float, sigma: float, expected: str) -> None:
    assert to_sigma(value, sigma) == expected


@pytest.mark.parametrize("shape", [(1.0, 1.0, 1.0), (0.01, 3.0, 0.2), (5.0, 0.0, 0.0), (0.0, 0.0, 0.0)])
def test_a_plot_in_space_holds_all_its_points_with_equal_scale(shape: tuple[float, float, float]) -> None:
    points = np.random.default_rng(1).uniform(-0.5, 0.5, (30, 3)) * shape + [10.0, -20.0, 0.0]
    trace = {k: [*points[:, i].tolist(), None] for i, k in enumerate("xyz")}
    view = scene([trace], (0.0, -1.0, 0.0))["scene"]
    ranges = np.array([view[f"{k}axis"]["range"] for k in "xyz"])
    assert np.all(ranges[:, 0] <= points.min(axis=0))
    assert np.all(ranges[:, 1] >= points.max(axis=0))
    ratio = np.array([view["aspectratio"][k] for k in "xyz"]) / np.ptp(ranges, axis=1)
    np.testing.assert_allclose(ratio, ratio[0], rtol=0.05)
    size = np.linalg.norm([view["aspectratio"][k] for k in "xyz"])
    assert size < np.linalg.norm([view["camera"]["eye"][k] for k in "xyz"])  # the camera stands outside


def test_constants_of_an_expression_are_readable() -> None:
    assert _readable("width*(abs(torque4) > (27.61435003421944))") == "width*(abs(torque4) > (27.61))"
    assert _readable("a*sin(2*q3 + 0.25)") == "a*sin(2*q3 + 0.25)"
