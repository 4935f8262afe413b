"""Coverage of every parameter's 95 % interval where a tracker and a wire identify one robot together.

``python -m benchmarks.instruments [--runs 200]`` prints a row for each parameter that is identified in most runs: share
of the runs in which truth lies inside, and the standard deviation of the normalised errors. Truth is a robot of
``fixtures``; noise is drawn anew in every run. Geometry that the data cannot tell apart has no truth of its own: the
model is one of parameters that the data do tell.
"""

import argparse
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from fixtures.instruments import Watched, Watcher, watch, write_watched
from fixtures.plan import Plan
from robcal.calibration.identification import IdentifyOptions
from robcal.calibration.instruments import CellFrame, Instrument, identify_instruments
from robcal.calibration.joint_log import JointLog
from robcal.calibration.measurements import RobotRecording
from robcal.files.measurement_tables import read_measurements
from robcal.files.poses_table import read_poses
from robcal.files.recordings import observations_of
from robcal.files.robot_import import read_any_robot
from robcal.robot.model import Payload, RobotModel
from robcal.transforms import Array, difference

MODEL = (
    *("axis2.pitch", "axis2.x", "axis2.roll", "axis3.pitch", "axis3.x", "axis3.roll", "axis4.z", "axis4.yaw"),
    *("axis5.pitch", "axis5.yaw", "axis2.elastic_pitch", "axis3.elastic_pitch", "axis5.elastic_pitch"),
)
WATCHERS = {"tracker": Watcher(sigma_mm=0.05, sigma_deg=0.005), "wire": Watcher("distances", sigma_mm=0.03)}


def instruments_in(folder: Path, made: Watched) -> tuple[RobotModel, JointLog, list[Instrument]]:
    """Robot, joint log and instruments of a campaign folder of ``fixtures``."""
    model = read_any_robot(folder / "robot.yaml")
    loads = {k: Payload(m, tuple(c)) for k, (m, c) in made.truth.robot.payloads.items()}
    model = replace(model, payloads=loads)
    log = read_poses(folder / "poses.csv", model, model.payloads)
    out = []
    for name in made.tables:
        o = observations_of(read_measurements(folder / f"{name}.csv", log.names), None)
        out.append(Instrument(name, RobotRecording((o,), (o,), True), CellFrame(name, "base"), CellFrame(name, "tool")))
    return model, log, out


def normalised_errors(plan: Plan, run: int) -> dict[str, float]:
    """Estimate minus truth in standard deviations, by parameter; worlds and tools as right perturbations."""
    made = watch(plan, WATCHERS, noise_seed=run)
    options = IdentifyOptions(MODEL, robust=False, statics="converged", covariance="stated")
    with tempfile.TemporaryDirectory() as place:
        found = identify_instruments(*instruments_in(write_watched(place, made), made), options)
    out: dict[str, float] = {}
    for name, placed in found.placed.items():
        robot = placed.robot
        if robot is None:
            continue
        ends = (made.world_T_base[name], placed.world_T_base), (made.flange_T_tool[name], placed.flange_T_tool)
        off: Array = np.concatenate([difference(found_, true) for true, found_ in ends])
        cell = [f"{end}.{k}" for end in ("base", "tool") for k in ("x", "y", "z", "roll", "pitch", "yaw")]
        truth = dict(made.truth.robot.given_deviations)
        for n, value, sigma in zip(robot.names, robot.theta, robot.sigma, strict=True):
            if n in cell:
                out[f"{name}.{n}"] = float(-off[cell.index(n)] / sigma)
            else:
                out[n] = float((value - truth.get(n, 0.0)) / sigma)
    return out


def table(runs: Sequence[dict[str, float]]) -> list[str]:
    """Lines of the table."""
    names = [n for n in runs[0] if sum(n in r for r in runs) > 0.5 * len(runs)]
    lines = [f"{len(runs)} runs", f"{'parameter':28s} coverage_95   rms"]
    all_inside = []
    for n in names:
        z = np.array([r[n] for r in runs if n in r])
        inside = np.abs(z) < 1.959964
        all_inside.append(inside.mean())
        lines.append(f"{n:28s}    {100 * inside.mean():5.1f} %   {np.sqrt(np.mean(z**2)):.2f}")
    low, high = 100 * min(all_inside), 100 * max(all_inside)
    return [*lines, f"all {100 * np.mean(all_inside):.1f} %, from {low:.1f} to {high:.1f} %"]


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=200)
    parser.add_argument("--seed", type=int, default=7)
    chosen = parser.parse_args()
    plan = Plan(seed=chosen.seed, poses=60, verify=0, model=MODEL, kept_out=2)
    print("\n".join(table([normalised_errors(plan, run) for run in range(chosen.runs)])))


if __name__ == "__main__":
    main()
