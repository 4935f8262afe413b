"""Identification against an oracle and peers: accuracy, time, convergence, coverage.

Usage: ``python -m benchmarks.identification [accuracy|time|convergence|coverage|agreement|peers|all] [--quick]``

Setting: a 125 kg class arm with six errors a frame, 80 poses in 6D with 0.05 mm and 0.1 mrad noise, base and tool
unknown, base tilted by 22 mrad, 500 noise-free kept-out poses. The oracle knows which parameters are not zero.
"""

import argparse
import time
from dataclasses import replace

import numpy as np
from scipy import stats

from benchmarks.robots import Truth, kr125_like, measured, random_poses, table, true_robot
from robcal import transforms as tf
from robcal.calibration.identification import IdentifiedRobot, IdentifyOptions, identify
from robcal.calibration.observations import Observations, PointObservations
from robcal.robot.kernel import Kernel, PoseInputs


def mean_error(robot: IdentifiedRobot, truth: Truth, poses: PoseInputs) -> float:
    """Mean distance of predicted and true tool origins, mm."""
    T, _ = robot.predict(poses)
    return float(np.linalg.norm((T - truth.frames(poses))[:, :3, 3], axis=1).mean() * 1e3)


def accuracy(seeds: int) -> None:
    """Mean tool error on kept-out poses for choices of parameters, against the oracle."""
    kernel = Kernel(kr125_like())
    needless = [
        f"{f.name}.{k}"
        for f in kernel.model.frames
        for k in ("x", "y", "z", "roll", "pitch", "yaw", "elastic_roll", "elastic_pitch", "elastic_yaw")
    ]
    choices: dict[str, object] = {
        "standard (by evidence)": "standard",
        "geometry": "geometry",
        "table5.4": "table5.4",
        "everything": needless,
    }
    rows: list[list[object]] = []
    for compliant in (False, True):
        errors: dict[str, list[float]] = {name: [] for name in (*choices, "oracle")}
        parameters: dict[str, list[int]] = {name: [] for name in errors}
        for seed in range(seeds):
            rng = np.random.default_rng(seed)
            truth = true_robot(kernel, rng, compliant)
            poses, kept_out = random_poses(kernel, rng, 80), random_poses(kernel, rng, 500)
            observed = measured(truth, poses, rng)
            for name in errors:
                choice = truth.form if name == "oracle" else choices[name]
                robot = identify(kernel.model, poses, [observed], IdentifyOptions(parameters=choice), kernel)
                errors[name].append(mean_error(robot, truth, kept_out))
                parameters[name].append(len(robot.names))
        oracle = np.mean(errors["oracle"])
        rows += [
            [
                "compliant" if compliant else "geometry only",
                name,
                float(np.mean(parameters[name])),
                float(np.mean(e)),
                float(np.max(e)),
                float(np.mean(e) / oracle),
            ]
            for name, e in errors.items()
        ]
    table(
        f"Mean tool error at 500 kept-out poses, {seeds} seeds",
        ["true robot", "identified", "parameters", "mean mm", "worst mm", "ratio to oracle"],
        rows,
    )


def timing(repeats: int) -> None:
    """Processor time on one core (shortest of some repeats)."""
    rng = np.random.default_rng(0)
    kernel = Kernel(kr125_like())
    truth = true_robot(kernel, rng, True)
    poses = random_poses(kernel, rng, 80)
    observed = measured(truth, poses, rng)
    model = kr125_like()

    def shortest(action) -> float:  # type: ignore[no-untyped-def]
        best = np.inf
        for _ in range(repeats):
            start = time.process_time()
            action()
            best = min(best, time.process_time() - start)
        return best * 1e3

    theta = truth.theta
    rows: list[list[object]] = [
        ["build the kernel", shortest(lambda: Kernel(model).function("jacobian"))],
        [
            f"frames and Jacobian, 80 poses x {len(kernel.names)} columns",
            shortest(lambda: truth.kernel.frames_and_jacobian(theta, poses)),
        ],
        ["identify, kernel at hand", shortest(lambda: identify(kernel.model, poses, [observed], kernel=kernel))],
        ["identify, kernel built", shortest(lambda: identify(model, poses, [observed]))],
    ]
    table("Processor time, one core", ["step", "ms"], rows)


def convergence(robots: int) -> None:
    """Gauss-Newton steps from zero for random robots with deviations three times the usual."""
    kernel = Kernel(kr125_like())
    steps, bad = [], []
    for seed in range(robots):
        rng = np.random.default_rng(seed)
        truth = true_robot(kernel, rng, seed % 2 == 1, scale=3.0)
        poses = random_poses(kernel, rng, 80)
        choice = IdentifyOptions(parameters="standard" if seed % 2 else "geometry", robust=False)
        robot = identify(kernel.model, poses, [measured(truth, poses, rng)], choice, kernel)
        first = robot.first_summary
        steps.append(first.iterations)
        if not (first.converged and robot.summary.converged and 0.8 < robot.sigma0 < 1.2):
            bad.append(seed)
    counts = np.bincount(steps)
    table(
        f"Gauss-Newton from zero, deviations three times the usual: {robots - len(bad)} of {robots} converge",
        ["steps", "robots"],
        [[str(k), int(c)] for k, c in enumerate(counts) if c],
    )
    if bad:
        print(f"  not converged: seeds {bad}")


def coverage(runs: int) -> None:
    """Share of true values inside the 95 % intervals, pooled by kind of parameter, and of predicted frames."""
    kernel = Kernel(kr125_like())
    inside: dict[str, list[bool]] = {}
    rng = np.random.default_rng(1)
    truth = true_robot(kernel, rng, True)
    # the truth as the identification can express it: what it leaves at nominal is nominal
    poses, kept_out = random_poses(kernel, rng, 80), random_poses(kernel, rng, 20)
    exact = identify(kernel.model, poses, [measured(truth, poses, rng)], IdentifyOptions(robust=False), kernel)
    names = exact.names
    plain = Truth(exact.kernel, exact.kernel.theta0)
    chosen = IdentifyOptions(parameters=names, robust=False, covariance="stated")
    base = [n for n in names if n.startswith(("base.", "tool."))]
    for run in range(runs):
        observed = measured(plain, poses, np.random.default_rng(1000 + run))
        robot = identify(kernel.model, poses, [observed], chosen, kernel)
        sigma = dict(zip(robot.names, robot.sigma, strict=True))
        W = tf.difference(robot.kernel.world_T_base, plain.kernel.world_T_base)
        F = tf.difference(robot.kernel.flange_T_tool, plain.kernel.flange_T_tool)
        order = ("x", "y", "z", "roll", "pitch", "yaw")
        miss = {f"base.{k}": W[i] for i, k in enumerate(order)} | {f"tool.{k}": F[i] for i, k in enumerate(order)}
        for name in robot.names:
            if name not in base:
                miss[name] = plain.theta[kernel.index[name]] - robot.values[name]
            kind = name.rsplit(".", 1)[-1]
            group = (
                name.split(".", maxsplit=1)[0]
                if name in base
                else "elastic"
                if "elastic" in kind
                else ("length" if kind in "xyz" else "angle")
            )
            inside.setdefault(group, []).append(abs(miss[name]) < 1.959964 * sigma[name])
        T, C = robot.predict(kept_out)
        d = tf.difference(T, plain.frames(kept_out))[:, :3]
        z = np.einsum("ni,nij,nj->n", d, np.linalg.inv(C[:, :3, :3]), d)
        inside.setdefault("predicted position", []).extend((z < stats.chi2.isf(0.05, 3)).tolist())
    table(
        f"Coverage of 95 % intervals, {runs} runs",
        ["kind", "intervals", "inside %"],
        [[name, len(v), 100.0 * float(np.mean(v))] for name, v in inside.items()],
    )


def _only(observed: Observations, wanted: np.ndarray, rows: np.ndarray) -> Observations:
    """Observations of the wanted poses, numbered as in rows."""
    part = observed.subset(wanted)
    at = {int(row): k for k, row in enumerate(rows)}
    return replace(part, pose=np.array([at[int(wanted[k])] for k in part.pose], dtype=np.int64))  # type: ignore[no-any-return]


def agreement(seeds: int) -> None:
    """3D (one target a pose, twice the poses), 6D and a mixture of both of one robot: do they agree as they claim?"""
    kernel = Kernel(kr125_like())
    errors: dict[str, list[float]] = {"6D, 80 poses": [], "3D, 160 other poses": [], "mixture, 40 + 80 poses": []}
    squares: list[float] = []
    inside: list[bool] = []
    for seed in range(seeds):
        rng = np.random.default_rng(seed)
        truth = true_robot(kernel, rng, True)
        poses, kept_out = random_poses(kernel, rng, 240), random_poses(kernel, rng, 100)
        frames = measured(truth, poses, rng)
        n = len(poses)
        p = truth.frames(poses)[:, :3, 3] + 5e-5 * rng.normal(size=(n, 3))
        points = PointObservations(
            np.arange(n), np.zeros((n, 3)), p, np.broadcast_to(25e-10 * np.eye(3), (n, 3, 3)), np.zeros(n)
        )
        sets = (  # rows measured in 6D, rows measured in 3D
            (np.arange(80), np.arange(0)),
            (np.arange(0), np.arange(80, 240)),
            (np.arange(40), np.arange(80, 160)),
        )
        robots = []
        for in_6d, in_3d in sets:
            rows = np.concatenate([in_6d, in_3d])
            observed = [o for o in (_only(frames, in_6d, rows), _only(points, in_3d, rows)) if len(o.pose)]
            robots.append(identify(kernel.model, poses.subset(rows), observed, kernel=kernel))
        for out, robot in zip(errors.values(), robots, strict=True):
            out.append(mean_error(robot, truth, kept_out))
        (T6, C6), (T3, C3) = (robot.predict(kept_out) for robot in robots[:2])
        d = (T3 - T6)[:, :3, 3]
        R6, R3 = T6[:, :3, :3], T3[:, :3, :3]
        C = R6 @ C6[:, :3, :3] @ np.swapaxes(R6, 1, 2) + R3 @ C3[:, :3, :3] @ np.swapaxes(R3, 1, 2)
        z = np.einsum("ni,nij,nj->n", d, np.linalg.inv(C), d)
        squares.append(float(np.mean(z)) / 3.0)
        inside += (z < stats.chi2.isf(0.05, 3)).tolist()
    table(
        f"3D and 6D of the same robot, {seeds} seeds",
        ["measured", "mean mm", "worst mm"],
        [[name, float(np.mean(e)), float(np.max(e))] for name, e in errors.items()],
    )
    print(
        f"  3D against 6D at 100 kept-out poses: squared normalised difference {np.mean(squares):.2f} per degree of "
        f"freedom, {100 * np.mean(inside):.1f} % inside the joint 95 % region"
    )


def main() -> None:
    """Print the chosen tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", nargs="?", default="all")
    parser.add_argument("--quick", action="store_true", help="a tenth of the runs")
    options = parser.parse_args()
    share = 10 if options.quick else 1
    if options.what in ("accuracy", "all"):
        accuracy(max(2, 20 // share))
    if options.what in ("time", "all"):
        timing(60)
    if options.what in ("convergence", "all"):
        convergence(1000 // share)
    if options.what in ("coverage", "all"):
        coverage(2000 // share)
    if options.what in ("agreement", "all"):
        agreement(max(2, 20 // share))
    if options.what in ("peers", "all"):
        from benchmarks.peers import compare

        compare()


if __name__ == "__main__":
    main()
