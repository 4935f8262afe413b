"""Peers on the same data: pybotics (modified DH, norms of position errors) where it can be imported.

The chain of :func:`benchmarks.robots.kr125_like` written as a modified DH table; base and tool of the peer start from
the closed form that ours uses, so that it need not guess.
"""

from __future__ import annotations

import time

import numpy as np
from scipy import optimize

from benchmarks.robots import kr125_like, measured, random_poses, table, true_robot
from robcal.calibration.identification import identify, predict_frames
from robcal.calibration.start_values import hand_eye
from robcal.robot.kernel import Kernel

MODIFIED_DH = np.array([
    # alpha, a, theta, d
    [0, 0, 0, 0.865],
    [-np.pi / 2, 0.41, 0, 0],
    [0, 1.0, -np.pi / 2, 0],
    [-np.pi / 2, -0.045, 0, 1.0],
    [np.pi / 2, 0, 0, 0],
    [-np.pi / 2, 0, 0, 0.21],
])


def _pybotics(q: np.ndarray, T: np.ndarray, q_out: np.ndarray) -> tuple[np.ndarray, float]:
    """Predicted positions (n, 3) at kept-out joint angles and seconds of the fit."""
    from pybotics.optimization import OptimizationHandler, optimize_accuracy
    from pybotics.robot import Robot

    robot = Robot.from_parameters(MODIFIED_DH)
    (W, F), _ = hand_eye(np.stack([robot.fk(row) for row in q]), T)
    robot.world_frame = W
    robot.tool.matrix = F
    start = time.perf_counter()
    handler = OptimizationHandler(
        robot, kinematic_chain_mask=True, tool_mask=[True] * 3 + [False] * 3, world_mask=True
    )
    result = optimize.least_squares(
        optimize_accuracy, handler.generate_optimization_vector(), args=(handler, q, T[:, :3, 3]), x_scale="jac",
        max_nfev=20,
    )
    handler.apply_optimization_vector(result.x)
    seconds = time.perf_counter() - start
    return np.stack([handler.robot.fk(row)[:3, 3] for row in q_out]), seconds


def compare() -> None:
    """Print the mean error at kept-out poses and the time of each program that is there."""
    kernel = Kernel(kr125_like())
    rows: list[list[object]] = []
    for compliant in (False, True):
        rng = np.random.default_rng(0)
        truth = true_robot(kernel, rng, compliant)
        poses, kept_out = random_poses(kernel, rng, 80), random_poses(kernel, rng, 500)
        observed = measured(truth, poses, rng)
        exact = truth.frames(kept_out)[:, :3, 3]
        robot = identify(kernel.model, poses, [observed])
        predicted = predict_frames(robot, kept_out)[0][:, :3, 3]
        kind = "compliant" if compliant else "geometry only"
        own = float(np.linalg.norm(predicted - exact, axis=1).mean() * 1e3)
        rows.append([kind, "robcal", own, robot.seconds, 1.0])
        try:
            predicted, seconds = _pybotics(poses.q, observed.world_T_tool, kept_out.q)
        except ImportError:
            rows.append([kind, "pybotics (not installed)", float("nan"), float("nan"), float("nan")])
            continue
        error = float(np.linalg.norm(predicted - exact, axis=1).mean() * 1e3)
        rows.append([kind, "pybotics", error, seconds, seconds / robot.seconds])
    table("Peers, one robot, 80 poses", ["true robot", "program", "mean mm", "seconds", "time ratio"], rows)
