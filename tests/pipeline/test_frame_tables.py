"""Frames in tables: the perturbation of a frame by its six numbers, and their standard deviations."""

import numpy as np
import pytest

from robcal.files.frame_tables import frame_columns, frame_covariance_columns, sigma_columns, twist_from_six
from robcal.transforms import difference, frame_from_xyzrpy

SIX = np.random.default_rng(3).uniform(-1.2, 1.2, (7, 6))


def test_jacobian_is_that_of_finite_differences() -> None:
    jacobian = twist_from_six(SIX)
    T = frame_from_xyzrpy(SIX)
    for k in range(6):
        step = np.zeros(6)
        step[k] = 1e-6
        numeric = (difference(T, frame_from_xyzrpy(SIX + step)) - difference(T, frame_from_xyzrpy(SIX - step))) / 2e-6
        assert np.abs(numeric) == pytest.approx(np.abs(jacobian[:, :, k]), abs=1e-8)


def test_sigma_of_independent_numbers_comes_back() -> None:
    stated = np.array([1e-4, 2e-4, 3e-4, 1e-5, 2e-5, 3e-5])
    jacobian = twist_from_six(SIX)
    columns = sigma_columns(frame_from_xyzrpy(SIX), jacobian @ np.diag(stated**2) @ np.swapaxes(jacobian, 1, 2))
    for k, (name, cells) in enumerate(columns.items()):
        factor = 1e3 if name.endswith("_mm") else 180 / np.pi
        assert [float(cell) for cell in cells] == pytest.approx([stated[k] * factor] * len(SIX), rel=1e-4)


def test_columns_are_named_once_with_their_units() -> None:
    names = [name for name, _, _ in frame_covariance_columns()]
    assert len(set(names)) == 21
    assert {"sxx_mm2", "sxroll_mm_deg", "syawyaw_deg2"} <= set(names)
    assert list(frame_columns(frame_from_xyzrpy(SIX))) == ["x_mm", "y_mm", "z_mm", "roll_deg", "pitch_deg", "yaw_deg"]
