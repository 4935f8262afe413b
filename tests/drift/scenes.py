"""A robot that warms up in front of a sphere, by the fixtures alone, and its files."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import yaml

from fixtures.aiming import aimed_poses
from fixtures.measuring import SPHERE
from fixtures.rigid import frame_from_six, inverse
from fixtures.true_robot import TrueRobot
from fixtures.warming import Heat, Warming, seen, warm, warm_tool
from pipeline.artifacts import CALIBRATED
from pipeline.json_io import write_json
from pipeline.runs import Run, StageRecord, run_file
from robcal.calibration.calibrated import CalibratedRobot
from robcal.drift.reference import Readings
from robcal.files.robot_file import read_robot
from robcal.robot.kernel_cache import kernel_of
from robcal.transforms import Array

ROBOT = Path(__file__).parents[2] / "configs" / "robots" / "kr150_class.yaml"
EVERY_S = 360.0
SIGMA = 1e-5


@dataclass(frozen=True)
class Scene:
    """``push`` (m) displaces the sphere, ``slip`` (rad) joints, ``dirt`` (m) a target, at a reading."""

    true: TrueRobot
    robot: CalibratedRobot
    q: Array
    target: Array
    heat: Heat
    warming: Warming

    def readings(
        self,
        cycle: int,
        *,
        rows: Sequence[int] | None = None,
        push: Sequence[float] = (0, 0, 0),
        slip: Sequence[float] = (0,) * 6,
        dirt: tuple[int, Sequence[float]] | None = None,
        hour: float | None = None,
        time_s: float | None = None,
        q: Array | None = None,
    ) -> Readings:
        """One tour, or some rows of it, at a cycle; ``hour`` of the warming up, by default that of the cycle."""
        at = np.arange(len(self.q)) if rows is None else np.asarray(rows)
        k = min(cycle if hour is None else round(hour * 3600 / EVERY_S), len(self.heat.time_s) - 1)
        commanded = (self.q if q is None else q)[at]
        deviation = self.warming.deviations(self.true, self.heat, np.full(len(at), k))
        T = warm_tool(self.true, commanded + np.asarray(slip), deviation)
        p = SPHERE[self.target[at]] + np.asarray(push)
        if dirt is not None:
            p = p + np.where((self.target[at] == dirt[0])[:, None], np.asarray(dirt[1]), 0.0)
        x = seen(T, p, SIGMA, np.random.default_rng([cycle, 7]))
        n = len(at)
        start = EVERY_S * cycle if time_s is None else time_s
        kernel = kernel_of(self.robot.model, self.robot.statics)
        return Readings(
            np.full(n, cycle),
            start + 3.0 * np.arange(n),
            tuple(f"p{i}" for i in at),
            self.target[at] + 1,
            x,
            np.broadcast_to(SIGMA**2 * np.eye(3), (n, 3, 3)),
            kernel.poses(commanded),
        )


def make_scene(poses: int = 24, hours: float = 6.0, seed: int = 1) -> Scene:
    """A robot that is calibrated perfectly while cold."""
    description = yaml.safe_load(ROBOT.read_text())
    rng = np.random.default_rng(seed)
    world_T_base = inverse(frame_from_six([1.3, 0.1, 0.7, 0.1, 0.2, 0.3]))
    flange_T_tool = frame_from_six([0.05, 0.0, 0.3, 0.1, 0.2, 0.3])
    true = TrueRobot(description, {}, world_T_base=world_T_base, flange_T_tool=flange_T_tool)
    q, target = aimed_poses(true, SPHERE, poses, rng)
    model = replace(read_robot(ROBOT), world_T_base=world_T_base, flange_T_tool=flange_T_tool)
    time_s = np.arange(0, hours * 3600 + 1, EVERY_S)
    heat = warm(time_s, np.ones(len(time_s)), true.joints, len(true.names), rng)
    robot = CalibratedRobot(model=model, nominal=model)
    return Scene(true, robot, q, target, heat, Warming.drawn(true, rng))


def write_run(folder: Path, robot: CalibratedRobot) -> Path:
    """A run folder that holds a calibrated robot and nothing else."""
    run = Run(folder)
    write_json(run_file(run), {"format": "robcal/run-1", "campaign": str(folder / "none")})
    run.save(CALIBRATED, robot)
    run.write_record(StageRecord("diagnose", "key", {}, {}))
    return folder


def write_readings(path: Path, parts: Sequence[Readings], *, angles: bool = True) -> Path:
    """A table of readings as the contract has it."""
    joints = parts[0].inputs.q.shape[1]
    header = ["cycle", "time_s", "pose", "target", "x_mm", "y_mm", "z_mm", "sigma_mm"]
    header += [f"q{k + 1}_deg" for k in range(joints)] if angles else []
    lines = [",".join(header)]
    for r in parts:
        for i in range(len(r)):
            row = [str(r.cycle[i]), f"{r.time[i]:.3f}", r.pose[i], str(r.target[i])]
            row += [f"{1e3 * v:.6f}" for v in r.x[i]] + [f"{1e3 * SIGMA}"]
            row += [f"{v:.9f}" for v in np.degrees(r.inputs.q[i])] if angles else []
            lines.append(",".join(row))
    path.write_text("\n".join(lines) + "\n")
    return path
