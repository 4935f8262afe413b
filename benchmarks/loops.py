"""Robots with closed loops: how far do they miss before and after, and are the stated uncertainties right?

``python -m benchmarks.loops [--seeds 20] [--poses 100]``: a palletiser whose forearm a parallelogram holds, one whose
forearm a four-bar turns (both elastic, 80 kg), and a Stewart platform measured in 6D and by four targets in 3D. A hand
that stays level does not tell how long its tool is; with the tool stated to a millimetre the robot file says so. The
truth is that of :mod:`fixtures.loops` and :mod:`fixtures.hexapods`. Errors are those of the tool's place at 500 poses
that nobody measured. Parameters are compared with those that the same poses give without noise, since what the data
cannot tell apart is held.
"""

import argparse
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import yaml
from scipy import stats

from fixtures import hexapods, loops
from fixtures.rigid import Array, move, small_motion
from robcal.calibration.identification import IdentifiedRobot, IdentifyOptions, identify
from robcal.calibration.observations import FrameObservations, Observations, PointObservations
from robcal.calibration.verification import fit_nominal
from robcal.files.robot_file import read_robot
from robcal.robot.kernel import Kernel
from robcal.robot.kernel_cache import kernel_of
from robcal.robot.model import Payload, RobotModel
from robcal.transforms import difference

KEPT_OUT = 500
SIGMA_MM = 0.03


@dataclass(frozen=True)
class Recorded:
    """Joint values (n, N) with true tool frames (n, 4, 4), how they are measured, and the nominal robot."""

    model: RobotModel
    payload: str | None
    q: Array
    world_T_tool: Array
    measure: Callable[[Array, Array], Observations]


@dataclass(frozen=True)
class Score:
    """Figures of one robot: RMS errors in mm, share of poses and of parameters within their 95 %."""

    nominal: float
    identified: float
    predicted: float
    poses_within: float
    z: Array


def frames(world_T_tool: Array, noise: Array) -> Observations:
    """Frames measured with 0.03 mm and 0.007 deg, noise (n, 6) in units of these."""
    size = np.array([SIGMA_MM / 1e3] * 3 + [1.2e-4] * 3)
    n = len(world_T_tool)
    return FrameObservations(
        np.arange(n), world_T_tool @ small_motion(noise[:, :6] * size), np.tile(np.diag(size**2), (n, 1, 1))
    )


def points(world_T_tool: Array, noise: Array) -> Observations:
    """Four targets on the tool, each measured with 0.03 mm, noise (n, 12) in units of that."""
    n, m = len(world_T_tool), len(hexapods.TARGETS)
    seen = move(world_T_tool, hexapods.TARGETS) + noise.reshape(n, m, 3) * SIGMA_MM / 1e3
    covariance = np.tile((SIGMA_MM / 1e3) ** 2 * np.eye(3), (n * m, 1, 1))
    targets = np.tile(np.arange(m), n)
    return PointObservations(
        np.repeat(np.arange(n), m), hexapods.TARGETS[targets], seen.reshape(-1, 3), covariance, targets
    )


def nominal(description: dict[str, object]) -> RobotModel:
    """The robot of a description as its file says."""
    with tempfile.TemporaryDirectory() as scratch:
        path = Path(scratch) / "robot.yaml"
        path.write_text(yaml.safe_dump(description), encoding="utf-8")
        return read_robot(path)


def palletiser(fourbar: bool, seed: int, n: int, tool: bool = False) -> Recorded:
    """A palletiser at n random poses; ``tool``: its file states the tool to a millimetre and a milliradian."""
    truth = loops.true_palletiser(seed, fourbar)
    q = loops.random_angles(truth.description, n, np.random.default_rng([seed, 1]))
    model = replace(nominal(dict(truth.description)), payloads={"load": Payload(*truth.payload)})
    if tool:
        off = small_motion(np.random.default_rng([seed, 4]).normal(0.0, 1e-3, 6))
        model = replace(model, flange_T_tool=truth.flange_T_tool @ off)
    return Recorded(model, "load", q, truth.world_T_tool(q), frames)


def platform(measure: Callable[[Array, Array], Observations], seed: int, n: int) -> Recorded:
    """A Stewart platform at n random poses."""
    driven = hexapods.drive(hexapods.true_hexapod(seed), n, np.random.default_rng([seed, 2]))
    return Recorded(nominal(hexapods.hexapod()), None, driven.lengths, driven.world_T_tool, measure)


ROBOTS: dict[str, Callable[[int, int], Recorded]] = {
    "palletiser, parallelogram": lambda seed, n: palletiser(False, seed, n),
    "palletiser, parallelogram, tool stated": lambda seed, n: palletiser(False, seed, n, tool=True),
    "palletiser, four-bar": lambda seed, n: palletiser(True, seed, n),
    "hexapod, frames": lambda seed, n: platform(frames, seed, n),
    "hexapod, points": lambda seed, n: platform(points, seed, n),
}


def score(recorded: Recorded, seed: int, n: int) -> Score:
    """Identify from the first n poses and compare at the others."""
    kernel = Kernel(recorded.model, "converged")
    poses = kernel.poses(recorded.q[:n], recorded.payload)
    noise = np.random.default_rng([seed, 3]).normal(size=(n, 12))
    measured = recorded.measure(recorded.world_T_tool[:n], noise)
    options = IdentifyOptions(statics="converged")
    found = identify(recorded.model, poses, [measured], options, kernel)
    plain = fit_nominal(recorded.model, poses, [measured]).model
    later = kernel.poses(recorded.q[n:], recorded.payload)
    T, covariance = found.predict(later)
    true = recorded.world_T_tool[n:]
    missed, before = (difference(F, true)[:, :3] for F in (T, _at(plain, later.q, recorded.payload)))
    place = covariance[:, :3, :3]
    square = np.einsum("ni,nij,nj->n", missed, np.linalg.inv(place), missed)
    return Score(
        1e3 * _rms(before),
        1e3 * _rms(missed),
        1e3 * float(np.sqrt(np.mean(np.trace(place, axis1=1, axis2=2)))),
        float(np.mean(square < stats.chi2.ppf(0.95, 3))),
        _deviations(recorded, found, kernel, n),
    )


def _at(model: RobotModel, q: Array, payload: str | None) -> Array:
    kernel = kernel_of(model, "converged")
    return kernel.frames(kernel.theta0, kernel.poses(q, payload))


def _deviations(recorded: Recorded, found: IdentifiedRobot, kernel: Kernel, n: int) -> Array:
    """Identified minus noise-free parameters of the robot (k,), in standard deviations."""
    own = [name for name in found.names if not name.startswith(("base.", "tool."))]
    options = IdentifyOptions(parameters=own, robust=False, statics="converged", covariance="stated")
    exact = recorded.measure(recorded.world_T_tool[:n], np.zeros((n, 12)))
    poses = kernel.poses(recorded.q[:n], recorded.payload)
    there = identify(recorded.model, poses, [exact], options, kernel)
    sigma = dict(zip(found.names, found.sigma, strict=True))
    both = [name for name in own if name in there.names]
    return np.array([(found.values[name] - there.values[name]) / sigma[name] for name in both])


def _rms(missed: Array) -> float:
    return float(np.sqrt(np.mean(np.sum(missed**2, axis=1))))


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--poses", type=int, default=100)
    parser.add_argument("--only", choices=list(ROBOTS), help="one robot alone")
    arguments = parser.parse_args()
    print("| robot | nominal, mm | identified, mm | predicted, mm | ratio | poses in 95 % | parameters in 95 % |")
    print("|---|---|---|---|---|---|---|")
    for name, make in ROBOTS.items():
        if arguments.only not in (None, name):
            continue
        scores = [score(make(s, arguments.poses + KEPT_OUT), s, arguments.poses) for s in range(arguments.seeds)]
        before, after, said = (
            float(np.sqrt(np.mean([getattr(s, key) ** 2 for s in scores])))
            for key in ("nominal", "identified", "predicted")
        )
        z = np.concatenate([s.z for s in scores])
        inside = 100 * np.mean(np.abs(z) < stats.norm.ppf(0.975))
        poses = 100 * np.mean([s.poses_within for s in scores])
        print(f"| {name} | {before:.3f} | {after:.4f} | {said:.4f} | {after / said:.2f} | {poses:.1f} | {inside:.1f} |")


if __name__ == "__main__":
    main()
