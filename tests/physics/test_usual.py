"""Usual sizes of deviations."""

import numpy as np
import pytest

from robcal.physics.cause import DEFLECTION, DEVIATION, prior_scale, prior_scales


def test_an_elasticity_is_measured_by_the_largest_load() -> None:
    variables = {"axis2_mpitch": np.array([-50.0, 20.0]), "axis3_mpitch": np.array([0.01, -0.02])}
    assert prior_scale("axis2.elastic_pitch", variables) == pytest.approx(DEFLECTION / 50.0)
    assert prior_scale("axis3.elastic_pitch", variables) == 0.0
    assert prior_scale("axis4.elastic_roll", variables) == 0.0


def test_geometry_and_everything_else() -> None:
    names = ("axis1.x", "tool.yaw", "payload.load.x", "gravity.tilt_x", "axis2_gear_ripple_0.sine")
    np.testing.assert_array_equal(prior_scales(names, {}), [DEVIATION, DEVIATION, 0.0, 0.0, 0.0])
