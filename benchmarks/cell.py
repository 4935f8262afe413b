"""Do errors of tool, object, base and points of the cell stay within their stated 95 %?

``python -m benchmarks.cell [--draws 1000]``: a robot is identified once; in each draw the true robot (of fixtures, in
base coordinates) differs from the identified one as its covariance says, its joints scatter, and touches have noise
that the command does not know. The tool found by touching a tip is then used to find an object and to measure points.
"""

import argparse
import tempfile
from collections import defaultdict
from dataclasses import replace
from pathlib import Path

import numpy as np

from fixtures.campaigns import make_campaign
from fixtures.random_robots import LOADS, description, load_class
from fixtures.rigid import Array, frame_from_six, move, six_from_frame, small_motion
from fixtures.touching import spread_postures, touching
from fixtures.true_robot import TrueRobot
from pipeline.runner import run_campaign
from pipeline.runs import open_run
from pipeline.stages.identify import load_calibrated
from robcal.calibration.calibrated import CalibratedRobot
from robcal.cell.carried import FLANGE, CarriedFrames, PlacedFrame, carried_frames
from robcal.cell.frames import (
    CellFrame,
    base_from_frames,
    object_from_corners,
    object_from_points,
    pivot,
    tool_from_touches,
)
from robcal.cell.points import measure_points
from robcal.files.cell_files import placed_data

MIDDLE = np.radians([20.0, 10.0, 60.0, 20.0, 50.0, 10.0])
TOUCH, JOINT = 5e-5, np.radians(0.0005)
TOOL = frame_from_six([0.08, -0.03, 0.25, 0.3, -0.4, 0.6])
NOMINAL = np.array([[0, 0, 0], [0.4, 0, 0], [0.4, 0.3, 0], [0, 0.3, 0.0], [0.2, 0, -0.1], [0, 0.15, -0.1]])
HELD_321 = np.array([[0, 0, 1], [0, 0, 1], [0, 0, 1], [0, 1, 0], [0, 1, 0], [1, 0, 0]], dtype=bool)
ON_321 = np.array([[0.05, 0.05, 0], [0.35, 0.04, 0], [0.2, 0.25, 0], [0.1, 0, -0.05], [0.3, 0, -0.06], [0, 0.1, -0.04]])


def identified() -> CalibratedRobot:
    """A robot identified from 40 frames."""
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        make_campaign(folder / "campaign", seed=6, level="frames", poses=40, verify=8)
        run_campaign(folder / "campaign", folder / "run", until="identify")
        return replace(load_calibrated(open_run(folder / "run")), joint_sigma=JOINT)


class Draw:
    """One true robot that the calibrated one describes within its covariance, and what it touches."""

    def __init__(self, robot: CalibratedRobot, rng: np.random.Generator) -> None:
        self.robot, self.rng = robot, rng
        values = dict.fromkeys(robot.names, 0.0) | dict(robot.model.parameters)
        error = rng.multivariate_normal(np.zeros(len(robot.names)), robot.covariance, method="cholesky")
        for name, e in zip(robot.names, error, strict=True):
            if not name.startswith(("base.", "tool.")):
                values[name] = values.get(name, 0.0) - float(e)
        loads = {k: (m, np.array(c) / 1000.0) for k, (m, c) in LOADS[load_class("kr150")].items()}
        self.true = TrueRobot(description("kr150"), values, payloads=loads)
        place = [*rng.uniform([1.1, -0.2, 0.5], [1.3, 0.2, 0.8]), *rng.uniform(-0.2, 0.2, 3)]
        self.base_T_object = frame_from_six(place)
        self.tip = move(self.base_T_object, np.array([[0.1, 0.1, 0.05]]))[0]

    def carried(self, q: Array, tool: PlacedFrame | None) -> CarriedFrames:
        """What the calibrated robot says of recorded joint angles, which scatter."""
        recorded = q + JOINT * self.rng.standard_normal(q.shape)
        return carried_frames(self.robot, self.robot.kernel.poses(recorded), tool)

    def touched(self, tool: Array, places: Array, offset: Array | None = None, wrist: float = 0.5) -> Array:
        """Joint angles that bring the tool (or a point of it) to places, with the noise of touching."""
        true = self.true.replaced(flange_T_tool=tool)
        noisy = places + TOUCH * self.rng.standard_normal(places.shape)
        start = spread_postures(self.rng, len(places), MIDDLE, wrist)
        return touching(true, start, noisy, np.zeros(3) if offset is None else offset)

    def tool(self) -> tuple[CellFrame, Array]:
        """Tool from six touches of the tip, two of x and two of xy."""
        offsets = {6: [0, 0, 0], 2: [0.1, 0, 0], -2: [0.03, 0.09, 0]}
        q = np.concatenate(
            [self.touched(TOOL, np.tile(self.tip, (abs(n), 1)), np.array(o)) for n, o in offsets.items()]
        )
        return tool_from_touches(self.carried(q, FLANGE), ["tip"] * 6 + ["x"] * 2 + ["xy"] * 2), TOOL

    def object(self, tool: PlacedFrame, how: str) -> tuple[CellFrame, Array]:
        """The object by its corners, by a best fit of six points, or by 3-2-1."""
        if how == "corners":
            at = np.array([[0, 0, 0], [0.4, 0, 0], [0.1, 0.3, 0.0]])[[0, 1, 2, 0, 1, 2]]
            tip = self.carried(self.touched(TOOL, move(self.base_T_object, at)), tool)
            return object_from_corners(tip, ["origin", "x", "xy"] * 2), self.base_T_object
        at, held = (NOMINAL, np.ones((6, 3), bool)) if how == "points" else (ON_321, HELD_321)
        tip = self.carried(self.touched(TOOL, move(self.base_T_object, at)), tool)
        return object_from_points(tip, at, held, None if how == "points" else TOUCH), self.base_T_object

    def base(self) -> tuple[CellFrame, Array]:
        """The base from eight measured frames of a tool that is known exactly."""
        world_T_base = frame_from_six([*self.rng.uniform(-1, 1, 6)])
        flange_T_tool = self.robot.kernel.flange_T_tool
        tool = PlacedFrame(flange_T_tool)
        q = spread_postures(self.rng, 8, MIDDLE) + self.rng.uniform(-0.3, 0.3, (8, 6))
        T = world_T_base @ self.true.replaced(flange_T_tool=flange_T_tool).world_T_tool(q)
        noise = np.array([5e-5] * 3 + [1e-4] * 3)
        measured = T @ small_motion(noise * self.rng.standard_normal((8, 6)))
        C = np.broadcast_to(np.diag(noise**2), (8, 6, 6))
        return base_from_frames(self.carried(q, tool), measured, C, True)[0], world_T_base

    def probe(self) -> tuple[CellFrame, Array]:
        """The tip of a probe from twelve frames while it pivots, with a tip that slips by the noise of a touch."""
        tip = np.array([0.02, 0.01, 0.2])
        turns = frame_from_six(np.concatenate([np.zeros((12, 3)), self.rng.uniform(-0.5, 0.5, (12, 3))], axis=1))
        turns[:, :3, 3] = self.tip + TOUCH * self.rng.standard_normal((12, 3)) - turns[:, :3, :3] @ tip
        noise = np.array([2e-5] * 3 + [5e-5] * 3)
        frames = turns @ small_motion(noise * self.rng.standard_normal((12, 6)))
        C = np.broadcast_to(np.diag(noise**2), (12, 6, 6))
        return pivot(frames, C), frame_from_six([*tip, 0, 0, 0])

    def points(self, tool: PlacedFrame) -> tuple[Array, Array]:
        """Normalised errors (8, 3) of measured points, and their standard deviations."""
        at = move(self.base_T_object, NOMINAL)
        tip = self.carried(self.touched(TOOL, np.concatenate([at, at])), tool)
        found = measure_points(tip, [str(i) for i in range(6)] * 2)
        sigma = np.sqrt(np.diagonal(found.covariance, axis1=1, axis2=2))
        return (found.places - at) / sigma, sigma


def within(found: CellFrame, truth: Array) -> tuple[Array, Array]:
    """Which of the six numbers lie within their 95 % interval, and the standard deviations in mm and deg."""
    data = placed_data(found.placed, found.of_touches, found.adjusted.freedom, found.held)
    error = six_from_frame(found.placed.T) - six_from_frame(truth)
    error[3:] = (error[3:] + np.pi) % (2 * np.pi) - np.pi
    numbers = np.abs(error) * np.array([1e3] * 3 + [180 / np.pi] * 3)
    wide = np.array([*data["interval_95_mm"], *data["interval_95_deg"]])
    n = 3 if found.held else 6
    return (numbers <= wide)[:n], np.array([*data["sigma_mm"], *data["sigma_deg"]])[:n]


def coverage(draws: int, seed: int = 1) -> dict[str, tuple[Array, Array, int]]:
    """By way of measuring: share of errors within 95 % of each number, mean standard deviation, wrong tools named."""
    robot, rng = identified(), np.random.default_rng(seed)
    inside: dict[str, list[Array]] = defaultdict(list)
    sigmas: dict[str, list[Array]] = defaultdict(list)
    alarms: dict[str, int] = defaultdict(int)
    for _ in range(draws):
        draw = Draw(robot, rng)
        tool = draw.tool()
        ways = {"tool, tip x xy": tool, "base, 8 frames": draw.base(), "probe, 12 frames": draw.probe()}
        for how in ("corners", "points", "3-2-1"):
            ways[f"object, {how}"] = draw.object(tool[0].placed, how)
        for name, (found, truth) in ways.items():
            hit, sigma = within(found, truth)
            inside[name].append(hit)
            sigmas[name].append(sigma)
            alarms[name] += found.adjusted.shift is not None
        normalised, sigma = draw.points(tool[0].placed)
        inside["points, twice"].append((np.abs(normalised) <= 1.96).mean(axis=0))
        sigmas["points, twice"].append(sigma.mean(axis=0) * 1e3)
    return {k: (np.mean(v, axis=0), np.mean(sigmas[k], axis=0), alarms[k]) for k, v in inside.items()}


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--draws", type=int, default=1000)
    draws = parser.parse_args().draws
    print(f"{draws} draws; share of errors within the stated 95 %, x y z roll pitch yaw; mean sigma, mm and deg")
    for name, (share, sigma, alarms) in coverage(draws).items():
        shares = " ".join(f"{100 * s:5.1f}" for s in share)
        print(f"{name:18s} {shares}   sigma {' '.join(f'{s:.4f}' for s in sigma)}   wrong tool named {alarms}")


if __name__ == "__main__":
    main()
