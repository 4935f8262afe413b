"""A wire: its length against the one of the simulation, its gradient and derivatives against differences."""

from dataclasses import replace

import numpy as np
import pytest

from fixtures.effects import Effect
from fixtures.measuring_effects import wire_length
from fixtures.true_robot import Circumstances
from robcal.calibration.wire import LIMITS, Wire
from robcal.errors import InvalidInput

UP = (0.0, 3.0, 4.0)
EVERYTHING = Wire(0.05, 2e-5, 3e-4, 5e-4, 2e-3, (0.1, -0.2, 1.0), 8.0)


def _points(rng: np.random.Generator) -> np.ndarray:
    return rng.uniform(-2.0, 2.0, (20, 3)) + np.array([0.0, 2.5, 0.0])


@pytest.mark.parametrize(
    ("effect", "wire"),
    [
        (Effect("pulley_wrap", "wire", parameters={"radius_mm": 35.0}), Wire(radius=0.035, axis=UP)),
        (
            Effect("wire_sag", "wire", parameters={"g_per_m": 6.0, "tension_N": 8.0}),
            Wire(sag=3.6e-5, axis=UP, tension=8.0),
        ),
        (Effect("wire_stretch", "wire", parameters={"ppm_per_m": 90.0}), Wire(stretch=9e-5)),
        (Effect("wire_scale", "wire", parameters={"ppm": -300.0}), Wire(scale=-3e-4)),
        (Effect("wire_offset", "wire", parameters={"mm": 1.5}), Wire(offset=1.5e-3)),
    ],
)
def test_the_counted_length_is_that_of_the_simulated_wire(effect: Effect, wire: Wire) -> None:
    p = _points(np.random.default_rng(0))
    simulated = wire_length([effect], p, Circumstances.plain(len(p), 6, None), np.array([0.0, 0.6, 0.8]))
    assert np.allclose(wire.length(p)[0], simulated, atol=1e-12)


def test_the_gradient_agrees_with_differences() -> None:
    p, h = _points(np.random.default_rng(1)), 1e-6
    columns = [(EVERYTHING.length(p + h * e)[0] - EVERYTHING.length(p - h * e)[0]) / (2 * h) for e in np.eye(3)]
    assert np.allclose(EVERYTHING.length(p)[1], np.column_stack(columns), atol=1e-8)


@pytest.mark.parametrize("name", LIMITS)
def test_the_derivative_by_a_parameter_agrees_with_differences(name: str) -> None:
    p, h = _points(np.random.default_rng(2)), 1e-6
    ends = [replace(EVERYTHING, **{name: getattr(EVERYTHING, name) + s * h}).length(p)[0] for s in (1, -1)]
    assert np.allclose(EVERYTHING.by_parameter(p, (name,))[:, 0], (ends[0] - ends[1]) / (2 * h), rtol=1e-6, atol=1e-7)


def test_wires_that_cannot_be_are_refused() -> None:
    for radius, axis in ((-0.1, (0.0, 0.0, 1.0)), (0.02, (0.0, 0.0, 0.0))):
        with pytest.raises(InvalidInput, match="not negative"):
            Wire(radius, axis=axis)
    with pytest.raises(InvalidInput, match="tension"):
        Wire(tension=0.0)
