"""Bundle adjustment with full covariance: robcal beside pycolmap and scipy on the same network, in one run.

    python -m benchmarks.bundle [--images 200] [--targets 150] [--no-scipy]

Simulated plate, one self-calibrated camera (8 numbers, so that COLMAP's OPENCV model is the same), start values off by
1 % in focal length, without distortion, millimetres in the points. robcal's time includes robust start, data snooping,
redundancy numbers and the full covariance of points, camera and stations; pycolmap's its adjustment and its own
covariance of points and stations (conditional, see robcal/photogrammetry/bundle/colmap_engine.py); scipy's only the
adjustment (sparse Jacobian, analytic).
"""

import argparse
import time

import numpy as np
import pycolmap
from scipy import optimize, sparse

from robcal.photogrammetry.bundle.adjustment import adjust
from robcal.photogrammetry.bundle.colmap_engine import to_reconstruction
from robcal.photogrammetry.bundle.determinacy import intrinsics_basis
from robcal.photogrammetry.bundle.normals import MarkOrder, State, linearise
from robcal.photogrammetry.core.camera import Camera, project
from robcal.photogrammetry.core.network import ImageMarks
from robcal.transforms import Array, fit_frame, frame, retract, transform

FREE = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2")
SIGMA = 0.05


def simulate(images: int, targets: int, seed: int = 0) -> tuple[State, State, ImageMarks]:
    """(true state, start state, marks) of a plate of 1 m seen from all around."""
    rng = np.random.default_rng(seed)
    camera = Camera(2448, 2048, 3200.0, 3201.0, 1230.0, 1015.0, -0.1, 0.05, 2e-4, -3e-4, 0.0)
    points = np.column_stack([rng.uniform(-0.5, 0.5, (targets, 2)) * [1.0, 0.8], rng.normal(0, 0.002, targets)])
    poses = []
    for _ in range(images):
        azimuth, tilt, roll = rng.uniform(0, 2 * np.pi), rng.uniform(0.1, 0.8), rng.uniform(0, 2 * np.pi)
        view = np.array([np.cos(azimuth) * np.sin(tilt), np.sin(azimuth) * np.sin(tilt), np.cos(tilt)])
        x = np.cross([np.cos(roll), np.sin(roll), 0.3], -view)
        x /= np.linalg.norm(x)
        R = np.stack([x, np.cross(-view, x), -view])
        poses.append(frame(R, -R @ (view * rng.uniform(1.9, 2.4))))
    T = np.array(poses)
    image, target = (a.ravel() for a in np.meshgrid(np.arange(images), np.arange(targets), indexing="ij"))
    xy = project(camera, transform(T[image], points[target]))
    seen = np.all((xy > 5) & (xy < [2443, 2043]), axis=1)
    image, target, xy = image[seen], target[seen], xy[seen]
    covariance = np.tile(np.eye(2) * SIGMA**2, (len(xy), 1, 1))
    marks = ImageMarks(image, target, xy + rng.normal(0, SIGMA, xy.shape), covariance)
    start = Camera(2448, 2048, 3232.0, 3232.0, 1223.5, 1023.5)
    near = State(start, retract(T, rng.normal(0, 0.003, (images, 6))), points + rng.normal(0, 0.002, points.shape))
    return State(camera, T, points), near, marks


def rms_um(points: Array, truth: Array) -> float:
    """Root mean square error in micrometres after a fit with scale (none of the engines has one)."""
    a, b = points - points.mean(axis=0), truth - truth.mean(axis=0)
    R = fit_frame(a, b)[:3, :3]
    moved = b @ R.T
    scale = np.sum(a * moved) / np.sum(moved**2)
    return float(np.sqrt(np.mean((a - scale * moved) ** 2)) * 1e6)


def run_robcal(start: State, marks: ImageMarks) -> tuple[float, Array, str]:
    """Seconds, points, what else."""
    begin = time.perf_counter()
    net = adjust(marks, start.camera, start.camera_T_body, start.points, free_intrinsics=FREE)
    seconds = time.perf_counter() - begin
    return seconds, net.points, f"sigma0 {net.sigma0_px:.4f} px, sigma {net.points_sigma.mean() * 1e6:.2f} um"


def run_pycolmap(start: State, marks: ImageMarks) -> tuple[float, float, Array]:
    """Seconds of the adjustment, seconds of its covariance, points."""
    names = tuple(f"{j}" for j in range(len(start.camera_T_body)))
    model = to_reconstruction(start.camera, start.camera_T_body, start.points, marks, names)
    options = pycolmap.BundleAdjustmentOptions()
    options.refine_principal_point = True
    options.print_summary = False
    config = pycolmap.BundleAdjustmentConfig()
    for image in model.images:
        config.add_image(image)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    begin = time.perf_counter()
    adjuster = pycolmap.create_default_ceres_bundle_adjuster(options, config, model)
    adjuster.solve()
    middle = time.perf_counter()
    covariance = pycolmap.estimate_ba_covariance(pycolmap.BACovarianceOptions(), model, adjuster)
    end = time.perf_counter()
    if covariance is None:
        end = float("nan")
    points = np.array([model.points3D[i + 1].xyz for i in range(len(start.points))])
    return middle - begin, end - middle, points


def run_scipy(start: State, marks: ImageMarks) -> tuple[float, Array]:
    """Seconds and points; trust region with the same analytic Jacobian, sparse."""
    n, t = len(start.camera_T_body), len(start.points)
    order = MarkOrder(marks, n, t)
    basis = intrinsics_basis(FREE)
    k = len(FREE)
    unit = np.concatenate([[1e3] * 4, [1.0] * 4, np.ones(3 * t + 6 * n)])
    shift = np.zeros((len(marks), 2))
    m = len(marks)
    columns = np.concatenate(
        [
            np.broadcast_to(np.arange(k), (m, k)),
            k + 3 * order.marks.target[:, None] + np.arange(3),
            k + 3 * t + 6 * order.marks.image[:, None] + np.arange(6),
        ],
        axis=1,
    )
    columns = np.repeat(columns[:, None, :], 2, axis=1).reshape(2 * m, -1)
    pointers = np.arange(2 * m + 1) * columns.shape[1]

    def at(x: Array) -> State:
        x = x * unit
        return start.moved(basis, x[: k + 3 * t], x[k + 3 * t :].reshape(n, 6))

    def fun(x: Array) -> Array:
        return -linearise(at(x), order, basis, shift).r.ravel()

    def jac(x: Array) -> sparse.csr_matrix:
        J = linearise(at(x), order, basis, shift).J.reshape(2 * m, -1)
        return sparse.csr_matrix(((J * unit[columns]).ravel(), columns.ravel(), pointers), (2 * m, len(unit)))

    begin = time.perf_counter()
    best = optimize.least_squares(
        fun, np.zeros(len(unit)), jac, method="trf", x_scale="jac", tr_solver="lsmr", ftol=1e-9, max_nfev=60
    )
    return time.perf_counter() - begin, at(best.x).points


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--images", type=int, default=200)
    parser.add_argument("--targets", type=int, default=150)
    parser.add_argument("--no-scipy", action="store_true", help="leave scipy out (it takes minutes)")
    arguments = parser.parse_args()
    truth, start, marks = simulate(arguments.images, arguments.targets)
    print(f"{arguments.images} images, {arguments.targets} targets, {len(marks)} marks, sigma {SIGMA} px")
    run_robcal(*simulate(6, 12)[1:])  # first calls load libraries
    own, points, words = min((run_robcal(start, marks) for _ in range(3)), key=lambda run: run[0])
    rows = [("robcal, adjustment with snooping and full covariance", own, rms_um(points, truth.points))]
    seconds, covariance, points = run_pycolmap(start, marks)
    rows.append(("pycolmap, adjustment", seconds, rms_um(points, truth.points)))
    rows.append(("pycolmap, adjustment and its covariance", seconds + covariance, rms_um(points, truth.points)))
    if not arguments.no_scipy:
        seconds, points = run_scipy(start, marks)
        rows.append(("scipy.optimize.least_squares, adjustment", seconds, rms_um(points, truth.points)))
    print(f"| {'engine':52} | seconds | by robcal | RMS um |\n|{'-' * 54}|{'-' * 9}|{'-' * 11}|{'-' * 8}|")
    for name, value, rms in rows:
        print(f"| {name:52} | {value:7.2f} | {value / own:9.1f} | {rms:6.2f} |")
    print(f"robcal: {words}")


if __name__ == "__main__":
    main()
