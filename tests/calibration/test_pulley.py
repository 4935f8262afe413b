"""The pulley of a wire: its length against the one of the simulation, its gradient against differences."""

import numpy as np
import pytest

from fixtures.effects import Effect
from fixtures.measuring_effects import wire_length
from fixtures.true_robot import Circumstances
from robcal.calibration.pulley import Pulley
from robcal.errors import InvalidInput


def _points(rng: np.random.Generator) -> np.ndarray:
    return rng.uniform(-2.0, 2.0, (20, 3)) + np.array([0.0, 2.5, 0.0])


def test_the_drawn_length_is_that_of_the_simulated_wire() -> None:
    p = _points(np.random.default_rng(0))
    effect = Effect("pulley_wrap", "wire", parameters={"radius_mm": 35.0})
    up = np.array([0.0, 0.6, 0.8])
    simulated = wire_length([effect], p, Circumstances.plain(len(p), 6, None), up)
    assert np.allclose(Pulley(0.035, (0.0, 3.0, 4.0)).length(p)[0], simulated, atol=1e-12)


def test_the_gradient_agrees_with_differences() -> None:
    p = _points(np.random.default_rng(1))
    pulley, h = Pulley(0.05, (0.1, -0.2, 1.0)), 1e-6
    columns = [(pulley.length(p + h * e)[0] - pulley.length(p - h * e)[0]) / (2 * h) for e in np.eye(3)]
    assert np.allclose(pulley.length(p)[1], np.column_stack(columns), atol=1e-8)


def test_a_pulley_without_size_or_axis_is_refused() -> None:
    for radius, axis in ((0.0, (0.0, 0.0, 1.0)), (0.02, (0.0, 0.0, 0.0))):
        with pytest.raises(InvalidInput, match="radius above zero"):
            Pulley(radius, axis)
