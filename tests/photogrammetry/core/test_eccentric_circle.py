"""Centre of the image of a circle against the centroid of its outline as a polygon."""

import numpy as np
import pytest

from robcal.photogrammetry.core.camera import Camera, project
from robcal.photogrammetry.core.eccentricity import effective_point
from tests.photogrammetry.networks import polygon_centre

CAMERA = Camera(2400, 1800, 3000.0, 3000.0, 1200.0, 900.0)


@pytest.mark.parametrize("tilt", [0.0, 0.5, 1.0])
def test_centre_of_the_ellipse(tilt: float) -> None:
    p = np.array([0.1, -0.05, 0.8])
    normal = np.array([np.sin(tilt), 0.0, -np.cos(tilt)])
    seen = polygon_centre(CAMERA, p, normal, 0.02)
    at = project(CAMERA, effective_point(p, normal, 0.02))
    np.testing.assert_allclose(at, seen, atol=1e-3)
    if tilt > 0.4:
        assert np.linalg.norm(project(CAMERA, p) - seen) > 0.1  # what is corrected is not small


def test_unknown_normal_or_radius_is_no_correction() -> None:
    p = np.array([[0.1, 0.0, 1.0], [0.2, 0.0, 1.0]])
    nan = np.full((2, 3), np.nan)
    np.testing.assert_array_equal(effective_point(p, nan, np.full(2, 0.01)), p)
    np.testing.assert_array_equal(effective_point(p, np.tile([0.0, 0, -1], (2, 1)), np.full(2, np.nan)), p)
