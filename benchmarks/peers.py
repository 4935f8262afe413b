"""Peers on the same data: FIGAROH and pybotics, where they can be imported (``pip install -e '.[benchmark]'``).

pybotics (modified DH, norms of position errors, no elasticities): base and tool start from the closed form that ours
uses, so that it need not guess. FIGAROH: see :mod:`benchmarks.peer_figaroh`. pybotics 3 wants numpy below 2, FIGAROH
above, so beside FIGAROH an older pybotics is installed; the version used is printed. Times are processor time.
"""

import importlib.metadata
import importlib.util
import time
from collections.abc import Callable

import numpy as np
from scipy import optimize

from benchmarks.peer_figaroh import predicted_positions
from benchmarks.robots import kr125_like, measured, random_poses, table, true_robot
from robcal.calibration.identification import identify
from robcal.calibration.observations import FrameObservations
from robcal.calibration.start_values import hand_eye
from robcal.robot.kernel import Kernel, PoseInputs
from robcal.robot.model import RobotModel

MODIFIED_DH = np.array(
    [
        # alpha, a, theta, d
        [0, 0, 0, 0.865],
        [-np.pi / 2, 0.41, 0, 0],
        [0, 1.0, -np.pi / 2, 0],
        [-np.pi / 2, -0.045, 0, 1.0],
        [np.pi / 2, 0, 0, 0],
        [-np.pi / 2, 0, 0, 0.21],
    ]
)


def _pybotics(q: np.ndarray, T: np.ndarray, q_out: np.ndarray) -> tuple[np.ndarray, float]:
    """Predicted positions (n, 3) at kept-out joint angles and seconds of the fit."""
    from pybotics.optimization import OptimizationHandler, optimize_accuracy
    from pybotics.robot import Robot

    robot = Robot.from_parameters(MODIFIED_DH)
    (W, F), _ = hand_eye(np.stack([robot.fk(row) for row in q]), T)
    robot.world_frame = W
    robot.tool.matrix = F
    start = time.process_time()
    handler = OptimizationHandler(robot, kinematic_chain_mask=True, tool_mask=[True] * 3 + [False] * 3, world_mask=True)
    result = optimize.least_squares(
        optimize_accuracy,
        handler.generate_optimization_vector(),
        args=(handler, q, T[:, :3, 3]),
        x_scale="jac",
        max_nfev=20,
    )
    handler.apply_optimization_vector(result.x)
    seconds = time.process_time() - start
    return np.stack([handler.robot.fk(row)[:3, 3] for row in q_out]), seconds


def compare(seeds: int = 1) -> None:
    """Print the mean error at kept-out poses and the time of each program that is there."""
    kernel = Kernel(kr125_like())
    rows: list[list[object]] = []
    for compliant in (False, True):
        found: dict[str, list[tuple[float, float]]] = {}
        for seed in range(seeds):
            rng = np.random.default_rng(seed)
            truth = true_robot(kernel, rng, compliant)
            poses, kept_out = random_poses(kernel, rng, 80), random_poses(kernel, rng, 500)
            observed = measured(truth, poses, rng)
            exact = truth.frames(kept_out)[:, :3, 3]
            for name, fit in _programs(kernel.model, poses, observed, kept_out, compliant).items():
                try:
                    predicted, seconds = fit()
                except ImportError:
                    continue
                error = float(np.linalg.norm(predicted - exact, axis=1).mean() * 1e3)
                found.setdefault(name, []).append((error, seconds))
        kind = "compliant" if compliant else "geometry only"
        ours = float(np.mean([s for _, s in found["robcal"]]))
        for name, values in found.items():
            error, seconds = (float(v) for v in np.mean(values, axis=0))
            rows.append([kind, name, error, seconds, seconds / ours])
    table(
        f"Peers, {seeds} seed(s), 80 poses, kernel included",
        ["true robot", "program", "mean mm", "processor s", "time ratio"],
        rows,
    )
    for name in ("figaroh", "pybotics"):
        if importlib.util.find_spec(name) is None:
            print(f"  {name} is not installed: pip install -e '.[benchmark]'")


def _programs(
    model: RobotModel, poses: PoseInputs, observed: FrameObservations, kept_out: PoseInputs, compliant: bool
) -> dict[str, Callable[[], tuple[np.ndarray, float]]]:
    """Each program as a function that gives predicted positions (n, 3) and processor seconds."""
    T = observed.world_T_tool

    def ours() -> tuple[np.ndarray, float]:
        start = time.process_time()
        robot = identify(model, poses, [observed])
        seconds = time.process_time() - start
        return robot.predict(kept_out)[0][:, :3, 3], seconds

    def figaroh(mended: bool) -> Callable[[], tuple[np.ndarray, float]]:
        return lambda: predicted_positions(model, "172 kg", poses.q, T, kept_out.q, compliant, mended)

    return {
        "robcal": ours,
        _versioned("figaroh", "as it is"): figaroh(False),
        _versioned("figaroh", "base's names mended"): figaroh(True),
        _versioned("pybotics", ""): lambda: _pybotics(poses.q, T, kept_out.q),
    }


def _versioned(package: str, note: str) -> str:
    if importlib.util.find_spec(package) is None:
        return package
    return " ".join([package, importlib.metadata.version(package), note]).strip()
