"""Real recordings of a UR10 with a laser tracker: kept-out RMS before, after geometry, after elasticity, per series.

Usage: ``python -m benchmarks.real_ur10 FOLDER`` where FOLDER holds ``robot.yaml`` and ``series_a`` .. ``series_d`` with
``poses.csv`` and ``frames.csv`` (Landgraf et al., IEEE CASE 2021; MIT licence).
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import pandas as pd
import yaml

from benchmarks.robots import table
from robcal import transforms as tf
from robcal.calibration.identification import IdentifyOptions, identify
from robcal.calibration.observations import FrameObservations
from robcal.calibration.verification import fit_nominal, verify
from robcal.robot.kernel import Kernel
from robcal.robot.model import Frame, RobotModel, Term

WAVE_PRIOR = 5e-4
DEFAULT_SIGMA, DEFAULT_SIGMA_ANGLE = 2e-5, np.deg2rad(0.005)


def read_chain(path: Path) -> RobotModel:
    """The chain of a robot file (only what this recording uses)."""
    data = yaml.safe_load(path.read_text(encoding="utf-8"))
    frames = tuple(
        Frame(
            f["name"], f["axis"], sign=f.get("sign", 1), xyz=tuple(np.array(f["xyz_mm"]) * 1e-3),
            rpy=tuple(np.deg2rad(f["rpy_deg"])), mass=f.get("mass_kg", 0.0),
            cog=tuple(np.array(f.get("cog_mm", (0, 0, 0))) * 1e-3),
        )
        for f in data["frames"]
    )
    return RobotModel(data["name"], frames, tuple(data["gravity_m_s2"]))


def read_series(folder: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Joint angles (n, 6), frames (n, 4, 4), covariances (n, 6, 6) and mask of the identification poses."""
    table = pd.read_csv(folder / "poses.csv").merge(pd.read_csv(folder / "frames.csv"), on="pose")
    q = np.deg2rad(table[[f"q{k}_deg" for k in range(1, 7)]].to_numpy())
    six = table[["x_mm", "y_mm", "z_mm", "roll_deg", "pitch_deg", "yaw_deg"]].to_numpy()
    T = tf.frame_from_xyzrpy(np.concatenate([six[:, :3] * 1e-3, np.deg2rad(six[:, 3:])], axis=1))
    sigma = table["sigma_mm"].to_numpy() * 1e-3 if "sigma_mm" in table else np.full(len(table), DEFAULT_SIGMA)
    turn = np.deg2rad(table["sigma_deg"].to_numpy()) if "sigma_deg" in table else np.full(
        len(table), DEFAULT_SIGMA_ANGLE)
    # the tracker's own averaging says nothing about accuracy: one weight for all, its scale is estimated
    C = np.zeros((len(table), 6, 6))
    C[:, range(3), range(3)] = float(np.median(sigma)) ** 2
    C[:, range(3, 6), range(3, 6)] = float(np.median(turn)) ** 2
    return q, T, C, (table["set"] == "identify").to_numpy()


def harmonics(model: RobotModel, orders: tuple[int, ...]) -> RobotModel:
    """The model with harmonic errors of every joint: what eccentric encoders and gears leave."""
    terms = [
        Term(f"{f.name}.harmonic{m}", f.name, "q", f"a*cos({m}*q{k}) + b*sin({m}*q{k})", {"a": 0.0, "b": 0.0},
             priors={"a": 5e-4, "b": 5e-4})
        for k, f in enumerate(model.joints, 1)
        for m in orders
    ]
    return model.with_terms(terms)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    folder = parser.parse_args().folder
    plain = read_chain(folder / "robot.yaml")
    wavy = harmonics(plain, (1, 2, 3, 4))
    rows: list[list[object]] = []
    for series in "abcd":
        q, T, C, inside = read_series(folder / f"series_{series}")
        everything = FrameObservations(np.arange(len(q)), T, C)
        train, test = everything.subset(inside), everything.subset(~inside)
        row: list[object] = [series.upper(), int(inside.sum()), int((~inside).sum())]
        elastic = 0
        for model, choice in ((plain, None), (plain, "geometry"), (plain, "standard"), (wavy, "standard")):
            kernel = Kernel(model)
            poses = kernel.poses(q)
            here, there = poses.subset(inside), poses.subset(~inside)
            if choice is None:
                robot = fit_nominal(model, here, [train])
            else:
                # Harmonics are weakly told from geometry where the joints move little: a prior keeps them small at
                # poses outside. It needs covariances of the size of the real misfit: those of the fit before.
                wave = {n: WAVE_PRIOR for t in model.terms for n in t.parameter_names}
                scale = robot.sigma0 if wave else 1.0
                train = FrameObservations(train.pose, train.world_T_tool, train.covariance * scale**2)
                robot = identify(model, here, [train], IdentifyOptions(parameters=choice, priors=wave), kernel)
            row.append(1e3 * verify(robot, there, [test]).tools["0"].rms)
            elastic = elastic if model is wavy else sum("elastic" in n for n in robot.names)
        rows.append([*row, elastic])
    table(
        "UR10 and laser tracker: RMS of the position error at kept-out poses, mm",
        ["series", "identify", "verify", "nominal", "geometry", "+ elasticity", "+ harmonics 1-4", "elastic"],
        rows,
    )


if __name__ == "__main__":
    main()
