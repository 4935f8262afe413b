"""Real recordings of a UR10 with a laser tracker: kept-out RMS before, after geometry, after elasticity, per series.

Two further columns with what is periodic in the joints: the first four harmonics of each, and those up to the 60th that
the identification poses ask for (forward choice by the Bayesian information criterion). The kept-out poses are only
looked at for the table.

Usage: ``python -m benchmarks.real_ur10 FOLDER`` where FOLDER holds ``robot.yaml`` and ``series_a`` .. ``series_d`` with
``poses.csv`` and ``frames.csv`` (Landgraf et al., IEEE CASE 2021; MIT licence).
"""

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas as pd
import yaml

from benchmarks.robots import table
from robcal import transforms as tf
from robcal.calibration.identification import IdentifiedRobot, IdentifyOptions, identify
from robcal.calibration.observations import FrameObservations, Stack
from robcal.calibration.problem import Evaluator, Problem, State, whitening
from robcal.calibration.verification import fit_nominal, verify
from robcal.robot.kernel import Kernel, PoseInputs
from robcal.robot.model import Frame, RobotModel, Term

WAVE_PRIOR = 5e-4
HIGHEST_ORDER = 60
PRICE = 4.0  # of a harmonic, in units of log(rows): two coefficients, joint and order
MOST_WAVES = 150
DEFAULT_SIGMA, DEFAULT_SIGMA_ANGLE = 2e-5, np.deg2rad(0.005)


def read_chain(path: Path) -> RobotModel:
    """The chain of a robot file (only what this recording uses)."""
    data = yaml.safe_load(path.read_text(encoding="utf-8"))
    frames = tuple(
        Frame(
            f["name"],
            f["axis"],
            sign=f.get("sign", 1),
            xyz=tuple(np.array(f["xyz_mm"]) * 1e-3),
            rpy=tuple(np.deg2rad(f["rpy_deg"])),
            mass=f.get("mass_kg", 0.0),
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
    turn = (
        np.deg2rad(table["sigma_deg"].to_numpy()) if "sigma_deg" in table else np.full(len(table), DEFAULT_SIGMA_ANGLE)
    )
    # the tracker's own averaging says nothing about accuracy: one weight for all, its scale is estimated
    C = np.zeros((len(table), 6, 6))
    C[:, range(3), range(3)] = float(np.median(sigma)) ** 2
    C[:, range(3, 6), range(3, 6)] = float(np.median(turn)) ** 2
    return q, T, C, (table["set"] == "identify").to_numpy()


def harmonics(model: RobotModel, waves: Sequence[tuple[int, int]]) -> RobotModel:
    """The model with harmonic errors (joint counted from 1, order): what eccentric encoders and gears leave."""
    joints = model.joints
    terms = [
        Term(
            f"{joints[k - 1].name}.harmonic{m}",
            joints[k - 1].name,
            "q",
            f"a*cos({m}*q{k}) + b*sin({m}*q{k})",
            {"a": 0.0, "b": 0.0},
            priors={"a": WAVE_PRIOR, "b": WAVE_PRIOR},
        )
        for k, m in waves
    ]
    return model.with_terms(terms)


def waves_by_evidence(robot: IdentifiedRobot, poses: PoseInputs, measured: FrameObservations) -> list[tuple[int, int]]:
    """Joints and orders whose harmonics lower the sum of squares by more than they cost, one after the other."""
    inside = np.flatnonzero(robot.used)
    stack = Stack([measured.subset(inside)], len(inside))
    poses = poses.subset(inside)
    evaluator = Evaluator(robot.kernel, poses, stack)
    state = State(robot.kernel.theta0, robot.kernel.world_T_base, robot.kernel.flange_T_tool)
    white = whitening(evaluator, state)
    r, A = Problem(evaluator, robot.columns, white).blocks(state)
    Jq = white @ evaluator(state).B @ robot.kernel.joint_jacobian(robot.kernel.theta0, poses)
    names = [(k, m) for k in range(1, poses.q.shape[1] + 1) for m in range(1, HIGHEST_ORDER + 1)]
    columns = [Jq[:, :, k - 1] * wave(m * poses.q[:, k - 1])[:, None] for k, m in names for wave in (np.cos, np.sin)]
    p, rows = A.shape[2], r.size
    J = np.concatenate([A, np.stack(columns, axis=2)], axis=2).reshape(rows, -1)
    scale = np.linalg.norm(J, axis=0)
    J /= scale
    N, b, rest = J.T @ J, J.T @ r.ravel(), float(r.ravel() @ r.ravel())
    chosen: list[int] = []
    for _ in range(MOST_WAVES):
        inside_columns = [*range(p), *(p + 2 * i + e for i in chosen for e in (0, 1))]
        inverse = np.linalg.inv(N[np.ix_(inside_columns, inside_columns)] + 1e-9 * np.eye(len(inside_columns)))
        x = inverse @ b[inside_columns]
        left = b - N[:, inside_columns] @ x
        total = rest - float(b[inside_columns] @ x)
        gains = np.zeros(len(names))
        for i in range(len(names)):
            if i in chosen:
                continue
            two = [p + 2 * i, p + 2 * i + 1]
            across = N[np.ix_(inside_columns, two)]
            pivot = N[np.ix_(two, two)] - across.T @ inverse @ across
            gains[i] = left[two] @ np.linalg.solve(pivot + 1e-6 * np.eye(2), left[two])
        best = int(np.argmax(gains))
        if gains[best] < PRICE * total / rows * np.log(rows):
            break
        chosen.append(best)
    return sorted(names[i] for i in chosen)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    folder = parser.parse_args().folder
    plain = read_chain(folder / "robot.yaml")
    low = [(k, m) for k in range(1, 7) for m in (1, 2, 3, 4)]
    rows: list[list[object]] = []
    orders: list[str] = []
    for series in "abcd":
        q, T, C, inside = read_series(folder / f"series_{series}")
        everything = FrameObservations(np.arange(len(q)), T, C)
        train, test = everything.subset(inside), everything.subset(~inside)
        row: list[object] = [series.upper(), int(inside.sum()), int((~inside).sum())]
        inputs = Kernel(plain).poses(q)
        here, there = inputs.subset(inside), inputs.subset(~inside)
        robots = [fit_nominal(plain, here, [train])]
        robots += [identify(plain, here, [train], IdentifyOptions(parameters=p)) for p in ("geometry", "standard")]
        found = robots[-1]
        waves = waves_by_evidence(found, here, train)
        # Harmonics are weakly told from geometry where the joints move little: a prior keeps them small at poses
        # outside. It needs covariances of the size of the real misfit: those of the fit before.
        scaled = FrameObservations(train.pose, train.world_T_tool, train.covariance * found.sigma0**2)
        for chosen in (low, waves):
            model = harmonics(plain, chosen)
            priors = {n: WAVE_PRIOR for t in model.terms for n in t.parameter_names}
            robots.append(identify(model, here, [scaled], IdentifyOptions(priors=priors)))
        row += [1e3 * verify(robot, there, [test]).tools["0"].rms for robot in robots]
        elastic = sum("elastic" in n for n in found.names)
        rows.append([*row, elastic, len(waves)])
        orders.append(
            f"  {series.upper()}: "
            + "; ".join(f"axis {k}: {', '.join(str(m) for j, m in waves if j == k)}" for k in range(1, 7))
        )
    table(
        "UR10 and laser tracker: RMS of the position error at kept-out poses, mm",
        [
            "series",
            "identify",
            "verify",
            "nominal",
            "geometry",
            "+ elasticity",
            "+ harmonics 1-4",
            "or by evidence",
            "elastic",
            "waves",
        ],
        rows,
    )
    print("  orders chosen by evidence\n" + "\n".join(orders))


if __name__ == "__main__":
    main()
