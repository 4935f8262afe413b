"""Real recordings of a UR10: what some series show, proved on another one of which only base and tool are fitted.

Three models from the training series: the standard one (geometry and elasticities); with an irregular error curve of
each joint over its own angle; with one curve that all joints share, each turned (and one reversed) by what the curves
themselves say. Errors at the kept-out poses of a series that took no part in the training, with base and tool from its
other poses. A second table tells the turns, and what is left.

Usage: ``python -m benchmarks.real_ur10_cross FOLDER [--picture FILE]``; FOLDER as for :mod:`benchmarks.real_ur10`.
"""

import argparse
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.real_ur10 import read_chain, read_series
from benchmarks.robots import table
from robcal import transforms as tf
from robcal.calibration.identification import identify
from robcal.calibration.observations import FrameObservations
from robcal.calibration.verification import fit_nominal
from robcal.diagnosis.core.fitting import Accepted
from robcal.diagnosis.search.likeness import likenesses
from robcal.physics.angle_error_curve import CURVE_PRIOR, periodic_curve
from robcal.physics.site import Joint
from robcal.robot.kernel import Kernel
from robcal.robot.model import RobotModel

SIGMA = np.repeat([1e-4, np.deg2rad(0.015)], 3)
"""Metres and radians: what is left at a pose once the curves are known; weighs positions against orientations."""
BUMPS = 72
SHARP = 1.0 / (0.9 * 2.0 * np.pi / BUMPS) ** 2
CENTRES = 2.0 * np.pi * np.arange(BUMPS) / BUMPS
SLOW = (1, 2)
"""Orders that each joint has for itself (eccentric mounting), and their prior in rad."""
SLOW_PRIOR = 4e-4
GEOMETRY_PRIOR, ELASTIC_PRIOR = 2e-3, 1e-5
TRAININGS = ("bcd", "acd", "abd", "abc")
ROUNDS = 5


@dataclass(frozen=True)
class Linear:
    """One series linearised at a common robot with its own base and tool.

    Attributes
    ----------
    q : (n, 6); inside : (n,) poses that are not kept out; r : (n, 6) twists measured - model;
    J : (n, 6, p) by the robot's parameters; Jq : (n, 6, 6) by the joints; cell : (n, 6, 12) by base and tool.
    """

    q: np.ndarray
    inside: np.ndarray
    r: np.ndarray
    J: np.ndarray
    Jq: np.ndarray
    cell: np.ndarray


def linearised(model: RobotModel, names: Sequence[str], series: Path) -> Linear:
    """Fit base and tool of a robot to a series and linearise there."""
    q, T, C, inside = read_series(series)
    kernel = Kernel(model)
    poses = kernel.poses(q)
    measured = FrameObservations(np.arange(len(q)), T, C)
    fitted = fit_nominal(model, poses.subset(inside), [measured.subset(inside)])
    at = kernel.with_references(fitted.kernel.world_T_base, fitted.kernel.flange_T_tool)
    F, J = at.frames_and_jacobian(kernel.theta0, poses)
    cell = [k for k, n in enumerate(kernel.names) if n.startswith(("base.", "tool."))]
    own = [kernel.index[n] for n in names]
    return Linear(q, inside, tf.difference(F, T), J[:, :, own], at.joint_jacobian(kernel.theta0, poses), J[:, :, cell])


def bumps(angle: np.ndarray) -> np.ndarray:
    """Values (n, BUMPS) of the bumps on the circle."""
    return np.exp(SHARP * (np.cos(angle[:, None] - CENTRES) - 1.0))


def slopes(angle: np.ndarray) -> np.ndarray:
    """Their derivatives by the angle."""
    return -SHARP * np.sin(angle[:, None] - CENTRES) * bumps(angle)


def own_curves(s: Linear) -> np.ndarray:
    """Columns (n, 6, 6 BUMPS) of one curve for each joint."""
    return np.concatenate([s.Jq[:, :, k, None] * bumps(s.q[:, k])[:, None, :] for k in range(6)], axis=2)


def slow(s: Linear) -> np.ndarray:
    """Columns of the slow waves of each joint."""
    waves = [f(m * s.q[:, k]) for k in range(6) for m in SLOW for f in (np.cos, np.sin)]
    at = np.repeat(np.arange(6), 2 * len(SLOW))
    return s.Jq[:, :, at] * np.stack(waves, axis=1)[:, None, :]


@dataclass(frozen=True)
class Pattern:
    """Joints that share a curve: error(q) = sense * curve(sense * q + turn)."""

    joints: tuple[int, ...]
    sense: np.ndarray
    turn: np.ndarray

    def columns(self, s: Linear) -> np.ndarray:
        """Columns (n, 6, BUMPS) of the shared curve."""
        parts = [
            s.Jq[:, :, k, None] * (self.sense[k] * bumps(self.sense[k] * s.q[:, k] + self.turn[k]))[:, None, :]
            for k in self.joints
        ]
        return np.sum(parts, axis=0)

    def turning(self, s: Linear, values: np.ndarray) -> np.ndarray:
        """Columns (n, 6, joints) of the turns, the first joint's left out: it is the reference."""
        parts = [
            s.Jq[:, :, k] * (self.sense[k] * (slopes(self.sense[k] * s.q[:, k] + self.turn[k]) @ values))[:, None]
            for k in self.joints[1:]
        ]
        return np.stack(parts, axis=2)


def solve(series: Sequence[Linear], columns: Sequence[np.ndarray], priors: np.ndarray) -> np.ndarray:
    """Coefficients (c,) that all series share; base and tool of each are projected out."""
    N, b = np.diag(np.ones(len(priors))), np.zeros(len(priors))
    for s, X in zip(series, columns, strict=True):
        weight = 1.0 / SIGMA
        A = (X * weight[:, None] * priors).reshape(-1, X.shape[2])
        Q = np.linalg.qr((s.cell * weight[:, None]).reshape(-1, s.cell.shape[2]))[0]
        r = (s.r * weight).ravel()
        A, r = A - Q @ (Q.T @ A), r - Q @ (Q.T @ r)
        N, b = N + A.T @ A, b + A.T @ r
    return np.linalg.solve(N, b) * priors


def left(s: Linear, predicted: np.ndarray) -> np.ndarray:
    """Twists (n, 6) that are left with base and tool from the poses that are not kept out."""
    e = s.r - predicted
    weight = 1.0 / SIGMA
    A = (s.cell * weight[:, None])[s.inside].reshape(-1, s.cell.shape[2])
    return e - s.cell @ np.linalg.lstsq(A, (e * weight)[s.inside].ravel(), rcond=1e-12)[0]


def pattern_of(series: Sequence[Linear], values: np.ndarray) -> tuple[Pattern, dict[int, float]]:
    """Which joints have the same curve, by the curves of the training series alone; and their correlations."""
    q = np.concatenate([s.q for s in series])
    causes = [periodic_curve(Joint(k, f"axis{k}", "z", 1, False), q[:, k - 1], BUMPS) for k in range(1, 7)]
    parts = [Accepted(f, f.grid[0], v, np.zeros((0, 0))) for f, v in zip(causes, values.reshape(6, -1), strict=True)]
    sense, turn, joints, reported = np.ones(6), np.zeros(6), [0], {}
    for like in likenesses(parts, list(q.T)):
        k, i = int(like.joint[4:]) - 1, int(like.other[4:]) - 1
        if i in joints:
            sense[k] = like.sense * sense[i]
            turn[k] = sense[i] * like.shift + turn[i]
            joints.append(k)
            reported[k] = like.correlation
    return Pattern(tuple(joints), sense, turn), reported


@dataclass(frozen=True)
class Trained:
    """Everything that a training found: coefficients in the order robot, slow waves, curves."""

    robot: np.ndarray
    curves: np.ndarray
    shared: np.ndarray
    pattern: Pattern
    correlation: dict[int, float]


def trained(series: Sequence[Linear], names: Sequence[str]) -> Trained:
    """Fit the three models to training series."""
    geometry = np.array([ELASTIC_PRIOR if ".elastic_" in n else GEOMETRY_PRIOR for n in names])
    few = np.full(12 * len(SLOW), SLOW_PRIOR)
    robot = solve(series, [s.J for s in series], geometry)
    priors = np.concatenate([geometry, few, np.full(6 * BUMPS, CURVE_PRIOR)])
    curves = solve(series, [np.concatenate([s.J, slow(s), own_curves(s)], axis=2) for s in series], priors)
    pattern, reported = pattern_of(series, curves[len(names) + len(few) :])
    priors = np.concatenate([geometry, few, np.full(BUMPS, CURVE_PRIOR)])
    at = len(names) + len(few)
    shared = solve(series, [np.concatenate([s.J, slow(s), pattern.columns(s)], axis=2) for s in series], priors)
    for _ in range(ROUNDS):
        columns = [
            np.concatenate([s.J, slow(s), pattern.columns(s), pattern.turning(s, shared[at:])], axis=2) for s in series
        ]
        step = solve(series, columns, np.concatenate([priors, np.full(len(pattern.joints) - 1, 0.02)]))
        shared, turn = step[: len(priors)], pattern.turn.copy()
        turn[list(pattern.joints[1:])] += step[len(priors) :]
        pattern = Pattern(pattern.joints, pattern.sense, turn)
    return Trained(robot, curves, shared, pattern, reported)


def errors(found: Trained, s: Linear, nothing: np.ndarray) -> list[np.ndarray]:
    """Position errors (m, 3) at kept-out poses: nominal robot, standard model, curves, shared curve."""
    with_curves = np.concatenate([s.J, slow(s), own_curves(s)], axis=2) @ found.curves
    with_shared = np.concatenate([s.J, slow(s), found.pattern.columns(s)], axis=2) @ found.shared
    predictions = (s.J @ nothing, s.J @ found.robot, with_curves, with_shared)
    return [left(s, p)[~s.inside, :3] for p in predictions]


def rms(e: np.ndarray) -> float:
    """Root mean square of lengths, mm."""
    return 1e3 * float(np.sqrt(np.mean(np.sum(e**2, axis=1))))


def picture(path: Path, series: Sequence[Linear], found: Trained, first: int) -> None:
    """Curves of the joints, each for itself, laid over one another by their turns; the shared one; its orders."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    grid = np.linspace(0.0, 2.0 * np.pi, 1441)
    figure, (above, below) = plt.subplots(2, 1, figsize=(11, 8), gridspec_kw={"height_ratios": [3, 2]})
    own = found.curves[first:].reshape(6, -1)
    for k in found.pattern.joints:
        sense, turn = found.pattern.sense[k], found.pattern.turn[k]
        q = np.concatenate([s.q[:, k] for s in series])
        here = np.sort((sense * q + turn) % (2.0 * np.pi))
        near = np.abs((grid[:, None] - here[None, ::5] + np.pi) % (2.0 * np.pi) - np.pi).min(axis=1) < np.deg2rad(2.5)
        y = sense * bumps(sense * (grid - turn)) @ own[k]
        waves = np.column_stack([np.ones(len(grid)), *(f(m * grid) for m in SLOW for f in (np.cos, np.sin))])
        y = y - waves @ np.linalg.lstsq(waves[near], y[near], rcond=1e-6)[0]
        label = f"axis {k + 1}, {'reversed, ' if sense < 0 else ''}turned by {np.degrees(turn) % 360:.1f} deg"
        above.plot(np.degrees(grid), np.degrees(np.where(near, y, np.nan)), lw=1.1, label=label)
    shared = bumps(grid) @ found.shared[first:]
    above.plot(np.degrees(grid), np.degrees(shared - shared.mean()), "k", lw=2.2, alpha=0.55, label="one curve for all")
    above.set(xlabel="angle of the joint, turned, deg", ylabel="error of the joint, deg", xlim=(0, 360))
    above.set_ylim(-0.055, 0.1)
    above.legend(fontsize=8, ncols=2, loc="upper right")
    above.grid(alpha=0.3)
    spectrum = np.abs(np.fft.rfft(shared[:-1])) * 2.0 / (len(grid) - 1)
    below.bar(np.arange(1, 46), np.degrees(spectrum[1:46]), color="0.4")
    below.set(xlabel="order (waves a turn) of the one curve", ylabel="amplitude, deg", xlim=(0, 46))
    below.grid(alpha=0.3)
    figure.tight_layout()
    figure.savefig(path, dpi=80)


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--picture", type=Path, help="file for the picture of the curves")
    options = parser.parse_args()
    folder: Path = options.folder
    plain = read_chain(folder / "robot.yaml")
    names: dict[str, None] = {}
    kernel = Kernel(plain)
    for letter in "abcd":
        q, T, C, inside = read_series(folder / f"series_{letter}")
        measured = FrameObservations(np.arange(len(q)), T, C).subset(inside)
        found = identify(plain, kernel.poses(q[inside]), [measured], kernel=kernel)
        names |= dict.fromkeys(n for n in found.names if not n.startswith(("base.", "tool.")))
    nothing = np.zeros(len(names))
    all_series = {letter: linearised(plain, list(names), folder / f"series_{letter}") for letter in "abcd"}
    rows: list[list[object]] = []
    for training in TRAININGS:
        found_here = trained([all_series[t] for t in training], list(names))
        (tested,) = set("abcd") - set(training)
        e = errors(found_here, all_series[tested], nothing)
        middle = 1e3 * float(np.median(np.linalg.norm(e[3], axis=1)))
        rows.append([training.upper(), tested.upper(), len(e[0]), *map(rms, e), middle])
    table(
        "UR10: trained on three series, base and tool alone fitted to the fourth; error at its kept-out poses, mm RMS",
        [
            "trained on",
            "tested on",
            "poses",
            "nominal",
            "standard model",
            "+ curve of each joint",
            "+ one curve for all",
            "its median",
        ],
        rows,
    )
    inside_only = [Linear(*(v[s.inside] for v in (s.q, s.inside, s.r, s.J, s.Jq, s.cell))) for s in all_series.values()]
    whole = trained(inside_only, list(names))
    rows = [[letter.upper(), *map(rms, errors(whole, s, nothing))] for letter, s in all_series.items()]
    table(
        "UR10: one robot for all four series, identified from their other poses; error at kept-out poses, mm RMS",
        ["series", "nominal", "standard model", "+ curve of each joint", "+ one curve for all"],
        rows,
    )
    pattern = whole.pattern
    table(
        "UR10: turns of the shared curve",
        ["axis", "turn deg", "sense", "correlation with an earlier axis"],
        [
            [k + 1, float(np.degrees(pattern.turn[k]) % 360.0), int(pattern.sense[k]), whole.correlation.get(k, 1.0)]
            for k in sorted(pattern.joints)
        ],
    )
    if options.picture is not None:
        picture(options.picture, inside_only, whole, len(names) + 12 * len(SLOW))


if __name__ == "__main__":
    main()
