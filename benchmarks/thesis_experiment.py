"""The thesis' experiment, simulated: 103 poses, 172 kg, a plate of five targets; Tables 5.1 and 5.2 in their form.

Usage: ``python -m benchmarks.thesis_experiment [--seeds N]``

Five targets a pose, length deviations of 0.085 mm on average (0.075 mm a coordinate), 80 poses identify, 23 verify.
The true robot has six errors a frame, compliances about and across its joint axes, and joints that repeat to 10 urad.
The floor is what the true robot itself would show against the same measurements.
"""

import argparse

import numpy as np

from benchmarks.robots import Truth, kr125_like, random_poses, table, true_robot
from robcal import transforms as tf
from robcal.calibration.identification import IdentifyOptions, identify
from robcal.calibration.noise import estimate_noise
from robcal.calibration.observations import FrameObservations, PointObservations
from robcal.calibration.verification import TEST_VECTORS, ErrorStatistics, fit_nominal, tool_errors, verify
from robcal.robot.compensation import compensate
from robcal.robot.kernel import Kernel, PoseInputs

PLATE = np.array([[0, 0, 0], [0.5, 0, 0.02], [0.5, 0.5, 0], [0, 0.5, 0.02], [0.25, 0.2, 0]]) - [0.25, 0.25, 0]
SIGMA = 0.085e-3 / np.sqrt(4.0 / np.pi)
"""Standard deviation of a coordinate (m): a difference of two scatters by its root 2, its mean size is root 2/pi."""
REPEATABILITY = 1e-5
SCALE, COMPLIANCE_SHARE = 0.6, 0.15


def measure(truth: Truth, poses: PoseInputs, rng: np.random.Generator) -> PointObservations:
    """Five targets a pose, the joints stopping with their repeatability."""
    T = truth.frames(poses.with_q(poses.q + REPEATABILITY * rng.normal(size=poses.q.shape)))
    n, k = len(poses), len(PLATE)
    p_tool = np.tile(PLATE, (n, 1))
    p_world = tf.transform(np.repeat(T, k, axis=0), p_tool) + SIGMA * rng.normal(size=(n * k, 3))
    C = np.broadcast_to(SIGMA**2 * np.eye(3), (n * k, 3, 3))
    return PointObservations(np.repeat(np.arange(n), k), p_tool, p_world, C, np.tile(np.arange(k), n))


def plate_frames(points: PointObservations, n: int) -> FrameObservations:
    """Least-squares frames of the plate (thesis section 5.4) with their covariance."""
    frames = np.stack([tf.fit_frame(points.p_world[points.pose == i], PLATE) for i in range(n)])
    B = np.concatenate([np.tile(np.eye(3), (len(PLATE), 1)), -tf.skew(PLATE).reshape(-1, 3)], axis=1)
    C = SIGMA**2 * np.linalg.inv(B.T @ B)
    return FrameObservations(np.arange(n), frames, np.broadcast_to(C, (n, 6, 6)))


def one(seed: int) -> tuple[dict[str, list[np.ndarray]], dict[str, np.ndarray], float]:
    """Errors (mm) by test vector: calibrated, uncalibrated, floor; by load through the compensation; coverage."""
    rng = np.random.default_rng(seed)
    kernel = Kernel(kr125_like())
    truth = true_robot(kernel, rng, True, SCALE, cross=1e-7)
    elastic = [k for k, n in enumerate(kernel.names) if "elastic" in n]
    truth.theta[elastic] *= COMPLIANCE_SHARE
    poses = random_poses(kernel, rng, 103)
    points = measure(truth, poses, rng)
    here, there = np.arange(80), np.arange(80, 103)
    train = [points.subset(here)]
    inside = poses.subset(here)
    robot = identify(kernel.model, inside, train, kernel=kernel)
    # joints do not stop exactly: weigh the data, and state the uncertainty, with what the residuals tell about that
    scatter = estimate_noise(robot, inside, train)
    if scatter.joint_sigma > 0:
        robot = identify(kernel.model, inside, train, IdentifyOptions(joint_sigma=scatter.joint_sigma), kernel)
    nominal = fit_nominal(kernel.model, poses.subset(here), train)
    test = plate_frames(points.subset(there), len(there))
    result = verify(robot, poses.subset(there), [test], nominal)
    floor = tool_errors(truth.frames(poses.subset(there)), [test])
    nominal_errors = result.nominal_errors or {}
    errors = {
        name: [1e3 * result.errors[name], 1e3 * nominal_errors[name], 1e3 * floor[name][1]] for name in TEST_VECTORS
    }
    loads: dict[str, np.ndarray] = {}
    for load in kernel.model.payloads:
        wanted = nominal.kernel.frames(nominal.kernel.theta0, random_poses(kernel, rng, 40, load))
        sent = compensate(robot.model, wanted, payload=load)
        good = sent.reachable
        q = sent.q[good] + REPEATABILITY * rng.normal(size=(int(good.sum()), 6))
        reached = truth.frames(kernel.poses(q, load))
        seen = np.linalg.norm((reached - wanted[good])[:, :3, 3] + SIGMA * rng.normal(size=(len(q), 3)), axis=1)
        loads[load] = 1e3 * seen
    return errors, loads, result.coverage_95


def main() -> None:
    """Print Tables 5.1 and 5.2 in the thesis' form."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=10)
    seeds = parser.parse_args().seeds
    runs = [one(seed) for seed in range(seeds)]
    rows: list[list[object]] = []
    for what in ("mean", "min", "max", "std"):
        row: list[object] = [what]
        for name in TEST_VECTORS:
            for column in range(3):
                values = [getattr(ErrorStatistics.of(errors[name][column]), what) for errors, _, _ in runs]
                row.append(float(np.mean(values)))
        rows.append(row)
    head = ["mm"] + [f"{name} {what}" for name in TEST_VECTORS for what in ("cal", "uncal", "floor")]
    table(f"Table 5.1: 23 kept-out poses, test vectors of 0, 500, 1000 mm, {seeds} robots", head, rows)
    table(
        "Table 5.2: other loads through the compensation, identified with 172 kg",
        ["load", "mean mm", "max mm"],
        [
            [load, float(np.mean([r[1][load].mean() for r in runs])), float(np.max([r[1][load].max() for r in runs]))]
            for load in runs[0][1]
        ],
    )
    print(f"\n  share of kept-out poses inside their 95 % region: {np.mean([r[2] for r in runs]):.3f}")


if __name__ == "__main__":
    main()
