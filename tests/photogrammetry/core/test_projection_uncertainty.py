import numpy as np
from scipy.optimize import least_squares

from robcal.photogrammetry.core.camera import Camera, normalise, project
from robcal.photogrammetry.core.projection_uncertainty import projection_uncertainty
from robcal.transforms import retract, transform

CAMERA = Camera(2400, 1800, 3000.0, 3002.0, 1205.0, 890.0, -0.1, 0.05, 2e-4, -1e-4, 0.01)
SIGMA = np.array([0.4, 0.4, 0.6, 0.6, 3e-4, 1e-3, 1e-5, 1e-5, 1e-3])


def test_the_map_is_what_drawn_cameras_scatter_after_their_best_motion() -> None:
    found = projection_uncertainty(CAMERA, np.diag(SIGMA**2), 2.0, columns=9)
    pixels = np.stack(np.meshgrid(found.x, found.y), axis=-1).reshape(-1, 2)
    p = 2.0 * np.column_stack([normalise(CAMERA, pixels), np.ones(len(pixels))])
    rng = np.random.default_rng(0)
    squares = []
    for _ in range(60):
        drawn = CAMERA.with_vector(CAMERA.vector + SIGMA * rng.standard_normal(9))

        def off(six: np.ndarray, drawn: Camera = drawn) -> np.ndarray:
            return (project(drawn, transform(retract(np.eye(4), six), p)) - pixels).ravel()

        best = least_squares(off, np.zeros(6), x_scale=1e-4).fun.reshape(-1, 2)
        squares.append(np.mean(best**2, axis=1))
    scatter = np.sqrt(np.mean(squares, axis=0)).reshape(found.sigma.shape)
    assert 0.85 < np.sqrt(np.mean(scatter**2) / np.mean(found.sigma**2)) < 1.15
    assert np.corrcoef(scatter.ravel(), found.sigma.ravel())[0, 1] > 0.9
    assert found.pixel * 3001.0 == 2.0


def test_what_a_motion_takes_up_is_no_uncertainty() -> None:
    only_centre = np.zeros((9, 9))
    only_centre[2, 2] = only_centre[3, 3] = 1.0
    found = projection_uncertainty(CAMERA, only_centre, 2.0)
    assert np.nanmax(found.sigma) < 0.1  # a pixel of the principal point is nearly a turn of the camera
