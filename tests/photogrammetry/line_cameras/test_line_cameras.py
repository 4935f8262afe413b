from dataclasses import replace

import numpy as np
import pytest

from fixtures.line_cameras import TrueLineCamera, readings, true_system, volume
from robcal.errors import DegenerateGeometry
from robcal.photogrammetry.line_cameras.calibration import CalibratedLineCameras, calibrate
from robcal.photogrammetry.line_cameras.camera import LineCamera, LineCameraSystem, Readings
from robcal.photogrammetry.line_cameras.intersection import intersect_planes
from robcal.transforms import Array

SIGMA, PLACE = 0.02, 2e-5


def as_readings(u: Array, seen: Array | None = None) -> Readings:
    n, c = u.shape
    rows = np.ones(n * c, dtype=bool) if seen is None else seen.ravel()
    return Readings(
        np.repeat(np.arange(n), c)[rows], np.tile(np.arange(c), n)[rows], u.ravel()[rows], np.full(n * c, SIGMA)[rows]
    )


def calibrated(seed: int, cameras: int) -> tuple[tuple[TrueLineCamera, ...], CalibratedLineCameras]:
    system, rng = true_system(seed, cameras), np.random.default_rng(seed)
    places = volume(rng, 120)
    given = as_readings(readings(system, places, SIGMA, rng))
    stated = places + PLACE * rng.standard_normal(places.shape)
    covariance = np.tile(PLACE**2 * np.eye(3), (len(places), 1, 1))
    return system, calibrate([f"c{k}" for k in range(cameras)], given, stated, covariance)


def test_derivatives_against_differences() -> None:
    true = true_system(2)[0]
    camera = LineCamera(true.world_T_camera, true.f_px, true.c_px, true.cubic, true.quintic)
    p = volume(np.random.default_rng(0), 20)
    u, by_point, by_numbers = camera.read(p)
    np.testing.assert_allclose(u, true.read(p), atol=1e-9)
    for k in range(3):
        step = 1e-5 * np.eye(3)[k]
        change = (camera.read(p + step)[0] - camera.read(p - step)[0]) / 2e-5
        np.testing.assert_allclose(by_point[:, k], change, rtol=1e-6, atol=1e-4)
    for k in range(9):
        step = 1e-5 * np.eye(9)[k]
        change = (camera.moved(step).read(p)[0] - camera.moved(-step).read(p)[0]) / 2e-5
        np.testing.assert_allclose(by_numbers[:, k], change, rtol=1e-6, atol=1e-4)


def test_a_reading_is_a_plane_through_its_light() -> None:
    true = true_system(3)[1]
    camera = LineCamera(true.world_T_camera, true.f_px, true.c_px, true.cubic, true.quintic)
    p = volume(np.random.default_rng(1), 20)
    normal, offset = camera.planes(true.read(p))
    np.testing.assert_allclose(np.einsum("ni,ni->n", normal, p), offset, atol=1e-9)


def test_points_scatter_as_their_covariance_says() -> None:
    squares = []
    for seed in range(8):
        system, found = calibrated(seed, 3 + seed % 3)
        rng = np.random.default_rng([seed, 1])
        p = volume(rng, 200)
        out = intersect_planes(found.system, as_readings(readings(system, p, SIGMA, rng)))
        total = out.covariance + out.jacobian @ found.system.covariance @ np.swapaxes(out.jacobian, 1, 2)
        e = out.p_world - p
        squares.append(np.mean(np.einsum("ni,nij,nj->n", e, np.linalg.inv(total), e)) / 3.0)
    assert 0.8 < np.mean(squares) < 1.2


def test_derivative_by_the_system_against_disturbed_systems() -> None:
    system, found = calibrated(1, 3)
    given = as_readings(readings(system, volume(np.random.default_rng(2), 5), SIGMA, np.random.default_rng(3)))
    out = intersect_planes(found.system, given)
    for k in (0, 4, 5, 7, 20):
        step = np.zeros(27)
        step[k] = 1e-6
        other = intersect_planes(_disturbed(found, step), given)
        change = (other.p_world - out.p_world) / 1e-6
        np.testing.assert_allclose(out.jacobian[:, :, k], change, rtol=1e-3, atol=1e-5 * np.abs(change).max())


def _disturbed(found: CalibratedLineCameras, step: Array) -> LineCameraSystem:
    cameras = tuple(c.moved(step[9 * k : 9 * k + 9]) for k, c in enumerate(found.system.cameras))
    return replace(found.system, cameras=cameras)


def test_wrong_readings_of_a_calibration_are_left_out() -> None:
    system, rng = true_system(5), np.random.default_rng(5)
    places = volume(rng, 120)
    u = readings(system, places, SIGMA, rng)
    wrong = rng.choice(u.size, 10, replace=False)
    u.ravel()[wrong] += rng.choice([-1, 1], 10) * rng.uniform(2.0, 300.0, 10)
    found = calibrate(["a", "b", "c"], as_readings(u), places, np.zeros((120, 3, 3)))
    assert set(np.flatnonzero(found.rejected)) >= set(wrong)
    assert np.count_nonzero(found.rejected) <= 12
    assert 0.8 < found.sigma0 < 1.2


def test_noise_that_is_not_stated_is_estimated() -> None:
    system, rng = true_system(6), np.random.default_rng(6)
    places = volume(rng, 120)
    u = readings(system, places, 0.05, rng)
    given = as_readings(u)
    relative = Readings(given.point, given.camera, given.u, np.ones(len(given.u)))
    found = calibrate(["a", "b", "c"], relative, places, np.zeros((120, 3, 3)), stated=False)
    assert 0.045 < found.system.noise < 0.055


@pytest.mark.parametrize(("count", "depth", "told"), [(8, 1.0, "saw 8 known places"), (60, 0.0, "lie in a plane")])
def test_places_that_do_not_suffice_are_refused(count: int, depth: float, told: str) -> None:
    system, rng = true_system(7), np.random.default_rng(7)
    places = volume(rng, count) * [1, 1, depth] + [0, 0, 3.0 - 3.0 * depth]
    with pytest.raises(DegenerateGeometry, match=told):
        calibrate(["a", "b", "c"], as_readings(readings(system, places, SIGMA, rng)), places, np.zeros((count, 3, 3)))


@pytest.mark.parametrize("cameras", [3, 4, 5])
def test_a_contradiction_is_located_where_it_can_be(cameras: int) -> None:
    system, found = calibrated(9, cameras)
    rng = np.random.default_rng(10)
    p = volume(rng, 40)
    u = readings(system, p, SIGMA, rng)
    u[7, 1] += 5.0
    seen = np.ones(u.shape, dtype=bool)
    seen[3, : cameras - 2] = False
    out = intersect_planes(found.system, as_readings(u, seen))
    assert "2 of the cameras saw it" in out.reasons[3]
    if cameras == 3:  # nothing redundant: it cannot show
        assert set(out.reasons) == {3}
    elif cameras == 4:
        assert "four planes miss one another" in out.reasons[7]
    else:
        assert set(out.reasons) == {3}
        assert np.linalg.norm(out.p_world[7] - p[7]) < 5e-4
