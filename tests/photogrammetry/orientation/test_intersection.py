"""Forward intersection: covariance against scatter, derivative by the station against differences, bad rays."""

import numpy as np

from robcal.photogrammetry.core.camera import project
from robcal.photogrammetry.orientation.intersection import Rays, intersect
from robcal.transforms import invert, retract, transform
from tests.photogrammetry.stations import nees, simulate


def _rays(cameras=2, n=200, sigma=0.02, seed=0):
    s = simulate(cameras=cameras)
    rng = np.random.default_rng(seed)
    T = np.array([s.world_T_camera[c] for c in s.cameras])
    lenses = list(s.cameras.values())
    p = transform(s.world_T_body[0], rng.uniform(-0.3, 0.3, (n, 3)))
    point, camera = np.repeat(np.arange(n), cameras), np.tile(np.arange(cameras), n)
    xy = np.stack([project(lenses[c], transform(invert(T[c]), p[i])) for i, c in zip(point, camera, strict=True)])
    covariance = np.tile(np.eye(2) * sigma**2, (len(xy), 1, 1))
    return p, point, camera, xy + rng.normal(size=xy.shape) * sigma, covariance, lenses, T


def test_noise_is_what_the_covariance_says():
    p, point, camera, xy, C, lenses, T = _rays(n=800)
    out = intersect(Rays(point, camera, xy, C, lenses, T))
    assert 0.9 < nees(out.p_world - p, out.covariance).mean() < 1.1
    assert 0.9 < out.chi2.mean() < 1.1


def test_derivative_by_the_station():
    _, point, camera, xy, C, lenses, T = _rays(n=3)
    base = intersect(Rays(point, camera, xy, C, lenses, T))
    for e in range(2):
        for k in range(6):
            step = np.zeros(6)
            step[k] = 1e-6
            moved = T.copy()
            moved[e] = retract(T[e], step)
            numeric = (intersect(Rays(point, camera, xy, C, lenses, moved)).p_world - base.p_world) / 1e-6
            assert np.allclose(base.by_exterior[:, e, :, k], numeric, atol=2e-2 * np.abs(numeric).max() + 1e-6)
    step = np.zeros(9)
    step[2] = 1e-3
    lens = [lenses[0].with_vector(lenses[0].vector + step), lenses[1]]
    numeric = (intersect(Rays(point, camera, xy, C, lens, T)).p_world - base.p_world) / 1e-3
    assert np.allclose(base.by_interior[:, 0, :, 2], numeric, rtol=1e-2, atol=1e-9)


def test_one_bad_ray_of_three_is_left_out():
    p, point, camera, xy, C, lenses, T = _rays(cameras=3, n=20)
    xy[5 * 3 + 1] += [1.0, -2.0]
    out = intersect(Rays(point, camera, xy, C, lenses, T))
    assert not out.used[16]
    assert out.used.sum() == 59
    assert out.n_cameras[5] == 2
    assert np.linalg.norm(out.p_world - p, axis=1).max() < 2e-4
