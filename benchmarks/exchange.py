"""A new robot in place of a calibrated one: how far are both tools apart, and is the predicted sigma right?

``python -m benchmarks.exchange [--robots 10] [--poses 12]``: new robots of the same type with other deviations (zeros
of up to 0.1 deg more) and elasticities that differ by a twentieth, 500 poses that were not measured.
"""

import argparse
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np

from fixtures.campaigns import make_campaign
from fixtures.plan import Truth
from fixtures.random_robots import random_deviations
from fixtures.rigid import Array, small_motion
from fixtures.true_robot import TrueRobot
from pipeline.runner import run_campaign
from pipeline.runs import open_run
from pipeline.stages.identify import load_calibrated
from robcal.calibration.calibrated import CalibratedRobot
from robcal.calibration.joint_log import JointLog
from robcal.calibration.measurements import RobotRecording
from robcal.calibration.observations import FrameObservations
from robcal.cell.exchange import exchange, transfer

POSITION, ANGLE = 5e-5, 1e-4
ZEROS = np.radians(0.1)
ABOUT = {"x": "roll", "y": "pitch", "z": "yaw"}


def log_of(q: Array) -> JointLog:
    """Poses without load."""
    n = len(q)
    return JointLog(tuple(map(str, range(n))), q, (None,) * n, np.zeros(n, dtype=bool), np.zeros_like(q))


def reference() -> tuple[CalibratedRobot, Truth]:
    """A calibrated reference robot and its truth."""
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        truth = make_campaign(folder / "campaign", seed=6, level="frames", poses=80, verify=8)
        run_campaign(folder / "campaign", folder / "run", until="identify")
        return load_calibrated(open_run(folder / "run")), truth


def new_robot(truth: Truth, rng: np.random.Generator) -> TrueRobot:
    """Another robot of the type, on the same base plate and with the same tool to a few tenths of a millimetre."""
    old = truth.robot.given_deviations
    drawn = random_deviations(truth.description, rng, length_m=0.5e-3)
    for f in truth.description["frames"]:
        if f.get("axis"):
            drawn[f"{f['name']}.{ABOUT[f['axis']]}"] += float(rng.normal(0, ZEROS))
    drawn |= {name: value * rng.normal(1.0, 0.05) for name, value in old.items() if ".elastic_" in name}
    moved = [small_motion(rng.normal(0, [3e-4] * 3 + [3e-4] * 3)) for _ in range(2)]
    return truth.robot.replaced(
        deviations=drawn,
        world_T_base=truth.robot.world_T_base @ moved[0],
        flange_T_tool=truth.robot.flange_T_tool @ moved[1],
    )


def exchanged(
    known: CalibratedRobot, truth: Truth, seed: int, poses: int, unmeasured: int = 500
) -> tuple[Array, Array, Array]:
    """Distance (n,) of both tools with and without transfer and its predicted standard deviation, in m."""
    rng = np.random.default_rng([seed, 77])
    robot = new_robot(truth, rng)
    every = truth.recorded.q
    q = every[rng.permutation(len(every))[:poses]]
    noise = rng.normal(0, [POSITION] * 3 + [ANGLE] * 3, (poses, 6))
    seen = FrameObservations.isotropic(robot.world_T_tool(q) @ small_motion(noise), POSITION, ANGLE)
    nominal = replace(known.model.nominal(), world_T_base=None, flange_T_tool=None)
    found = exchange(known, nominal, log_of(q), RobotRecording((seen,), (seen,), True))
    low, high = every.min(axis=0), every.max(axis=0)
    taught = log_of(rng.uniform(low, high, (unmeasured, len(low))))
    result = transfer(found, known, taught)
    ok = result.command.reachable
    wanted = truth.robot.world_T_tool(taught.q[ok])[:, :3, 3]
    after = np.linalg.norm(robot.world_T_tool(result.command.q[ok])[:, :3, 3] - wanted, axis=1)
    before = np.linalg.norm(robot.world_T_tool(taught.q[ok])[:, :3, 3] - wanted, axis=1)
    return after, before, result.sigma[ok]


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--robots", type=int, default=10)
    parser.add_argument("--poses", type=int, nargs="*", default=[6, 12, 24])
    options = parser.parse_args()
    known, truth = reference()
    print("poses  robot  mean mm without, with transfer, factor; root mean square of distance / predicted sigma")
    for poses in options.poses:
        ratios, factors = [], []
        for seed in range(options.robots):
            after, before, sigma = exchanged(known, truth, seed, poses)
            ratios.append(float(np.sqrt(np.mean((after / sigma) ** 2))))
            factors.append(float(before.mean() / after.mean()))
            print(
                f"{poses:5d} {seed:5d}  {1e3 * before.mean():7.3f} {1e3 * after.mean():7.3f} {factors[-1]:6.1f}"
                f"   {ratios[-1]:.2f}"
            )
        print(
            f"{poses:5d}   all  factor {np.min(factors):.1f} at least, ratio {np.sqrt(np.mean(np.square(ratios))):.2f}"
        )


if __name__ == "__main__":
    main()
