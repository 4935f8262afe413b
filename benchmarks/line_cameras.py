"""Do points and frames of a system of linear cameras lie within their covariance?

``python -m benchmarks.line_cameras [--seeds 60]``: systems of three, four and five linear cameras of 2048 px on a beam
of 1.1 m, calibrated from 150 places of a light in 1.4 x 1.2 x 1.6 m (known to 0.02 mm), read with a noise of 0.02 px.
Then 300 lights, and 100 poses of a probe of five LEDs, anywhere in that volume. NEES is the mean squared error in units
of the stated covariance per coordinate (1 where it is honest), noise of the readings and calibration together; the one
of frames is over six numbers. ``wrong`` is with 2 % gross errors in the readings of the calibration.
"""

import argparse

import numpy as np

from fixtures.line_cameras import LEDS, readings, true_system, volume
from fixtures.rigid import frame, move, rotation
from robcal.photogrammetry.core.bodies import Body
from robcal.photogrammetry.line_cameras.calibration import calibrate
from robcal.photogrammetry.line_cameras.camera import LineCameraSystem, Readings
from robcal.photogrammetry.line_cameras.intersection import intersect_planes
from robcal.photogrammetry.measure.frames import measure_frames
from robcal.photogrammetry.measure.measured_points import MeasuredPoints
from robcal.transforms import Array, difference

SIGMA, PLACE = 0.02, 2e-5


def _given(u: Array) -> Readings:
    n, c = u.shape
    return Readings(np.repeat(np.arange(n), c), np.tile(np.arange(c), n), u.ravel(), np.full(n * c, SIGMA))


def _nees(e: Array, covariance: Array) -> float:
    return float(np.mean(np.einsum("ni,ni->n", e, np.linalg.solve(covariance, e[..., None])[..., 0])) / e.shape[1])


def _points(system: LineCameraSystem, u: Array, pose: Array, target: Array) -> MeasuredPoints:
    out = intersect_planes(system, _given(u))
    good = np.isfinite(out.p_world).all(axis=1)
    return MeasuredPoints(
        pose[good],
        target[good],
        out.p_world[good],
        out.covariance[good],
        out.n_cameras[good],
        np.ones(int(good.sum())),
        out.jacobian[good],
        system.covariance,
    )


def one(seed: int, cameras: int, wrong: float) -> tuple[float, float, float, float]:
    """NEES of points and of frames; RMS error (mm) of a point's coordinate, and of a frame's place."""
    rng = np.random.default_rng([seed, cameras])
    true = true_system(seed, cameras)
    places = volume(rng, 150)
    u = readings(true, places, SIGMA, rng)
    gross = rng.random(u.shape) < wrong
    u = u + gross * rng.uniform(1.0, 300.0, u.shape) * rng.choice([-1.0, 1.0], u.shape)
    stated = places + PLACE * rng.standard_normal(places.shape)
    names = [f"c{k}" for k in range(cameras)]
    system = calibrate(names, _given(u), stated, np.tile(PLACE**2 * np.eye(3), (150, 1, 1))).system
    p = volume(rng, 300)
    points = _points(system, readings(true, p, SIGMA, rng), np.arange(300), np.zeros(300, dtype=np.int64))
    covariance = points.total_covariance
    assert covariance is not None
    e = points.p_world - p[points.pose]
    T = frame(rotation(rng.uniform(-0.6, 0.6, (100, 3))), volume(rng, 100) * [0.7, 0.6, 0.9] + [0, 0, 0.3])
    lights = move(T, np.broadcast_to(LEDS, (100, 5, 3))).reshape(-1, 3)
    pose, target = np.repeat(np.arange(100), 5), np.tile(np.arange(5), 100)
    found = measure_frames(
        _points(system, readings(true, lights, SIGMA, rng), pose, target), Body("probe", np.arange(5), LEDS)
    )
    d = difference(T[found.pose], found.world_T_body)
    return (
        _nees(e, covariance),
        _nees(d, found.covariance + found.common_covariance),
        1e3 * float(np.sqrt(np.mean(e**2))),
        1e3 * float(np.sqrt(np.mean(d[:, :3] ** 2))),
    )


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=60)
    seeds = parser.parse_args().seeds
    print("cameras  wrong  NEES points (5-95 %)      NEES frames  point mm  frame mm")
    for cameras, wrong in ((3, 0.0), (4, 0.0), (5, 0.0), (3, 0.02)):
        rows = np.array([one(seed, cameras, wrong) for seed in range(seeds)])
        low, high = np.percentile(rows[:, 0], [5, 95])
        mean = rows.mean(axis=0)
        print(
            f"{cameras:7d}  {100 * wrong:3.0f} %  {mean[0]:6.3f} ({low:.3f} to {high:.3f})  {mean[1]:12.3f}"
            f"  {mean[2]:8.4f}  {mean[3]:8.4f}"
        )


if __name__ == "__main__":
    main()
