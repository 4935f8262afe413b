"""Other ways to a better robot beside the full identification, on the same robot: one table.

``python -m benchmarks.comparators [--robots 5]``: about 80 poses each, measured to 0.05 mm and 0.006 deg (closed loops:
held to 0.05 mm). Errors are those of the tool's position at 500 poses all over the workspace, without load, and at
200 poses inside the grid with the orientation of the grid.

- circle point: each joint turns alone, the axis is the line through the fitted circle's centre (Mooring 1991);
- grid: the nominal robot's errors at a grid of 5 x 4 x 4 places with one orientation, interpolated in between;
- closed loops: the tip held at one point, on one plane, by a bar of 0.3 m about one centre, with the usual
  deviations of robots as a prior.

Base and tool of grid and loops are fitted to ten measured frames.
"""

import argparse
from collections import defaultdict
from dataclasses import dataclass, replace

import numpy as np
from scipy.interpolate import LinearNDInterpolator, NearestNDInterpolator

from fixtures.campaigns import make_recording
from fixtures.rigid import Array, frame, frame_from_six, inverse, rotation_from_vector, small_motion
from fixtures.touching import touching
from fixtures.true_robot import TrueRobot
from robcal.calibration.cell import with_fitted_cell
from robcal.calibration.closed_loops import loop_observations, loop_world
from robcal.calibration.identification import IdentifyOptions, identify
from robcal.calibration.observations import FrameObservations
from robcal.files.robot_file import read_robot
from robcal.files.yaml_io import yaml_text
from robcal.robot.compensation import CompensationSettings, compensate
from robcal.robot.kernel import Kernel
from robcal.robot.model import GEOMETRIC_KINDS, RobotModel

POSITION, ANGLE = 5e-5, 1e-4
MIDDLE = np.radians([0.0, 10.0, 60.0, 0.0, 50.0, 0.0])
GRID = (np.linspace(-0.2, 0.2, 4), np.linspace(-0.3, 0.3, 5), np.linspace(-0.2, 0.2, 4))
"""About the tool's place in the middle posture, m."""


@dataclass
class Case:
    """A true robot, its nominal model with the cell known to a few millimetres, and what measures it."""

    true: TrueRobot
    nominal: RobotModel
    rng: np.random.Generator
    recorded: Array
    anywhere: Array

    def measured(self, q: Array) -> Array:
        noise = self.rng.normal(0, [POSITION] * 3 + [ANGLE] * 3, (len(q), 6))
        return self.true.world_T_tool(q) @ small_motion(noise)

    def fitted(self, model: RobotModel, q: Array, T: Array) -> RobotModel:
        """The model in its best cell."""
        kernel = Kernel(model, "converged")
        return with_fitted_cell(kernel, kernel.poses(q), [FrameObservations.isotropic(T, POSITION, ANGLE)], anew=True)


def predicted(model: RobotModel, q: Array) -> Array:
    kernel = Kernel(model, "converged")
    return kernel.frames(kernel.theta0, kernel.poses(q))


def full(case: Case, q: Array) -> RobotModel:
    """Identification from measured frames."""
    kernel = Kernel(case.nominal, "converged")
    seen = FrameObservations.isotropic(case.measured(q), POSITION, ANGLE)
    return identify(case.nominal, kernel.poses(q), [seen], IdentifyOptions(statics="converged"), kernel).model


def circle_point(case: Case) -> tuple[Array, Array, Array]:
    """Axes: turns (6, 3), points (6, 3) at the middle posture, and the frame there, all measured."""
    turns, points = np.zeros((6, 3)), np.zeros((6, 3))
    for k in range(6):
        q = np.tile(MIDDLE, (13, 1))
        q[:, k] += np.linspace(-0.5, 0.5, 13) * (1.0 if k < 3 else 2.5)
        T = case.measured(q)
        # the plane's normal from positions and orientations alike: the axis is what all relative turns leave alone
        p = T[:, :3, 3]
        centre_of = p - p.mean(axis=0)
        normal = np.linalg.svd(centre_of)[2][2]
        sense = np.cross(p[6] - p[0], p[12] - p[6]) @ normal
        turns[k] = normal * np.sign(sense)
        # circle in the plane: |p - c|^2 constant
        A = np.column_stack([2 * centre_of - 0, np.ones(13)])
        A[:, :3] -= np.outer(A[:, :3] @ normal, normal)
        c = np.linalg.lstsq(A, np.sum(centre_of**2, axis=1), rcond=1e-9)[0][:3]
        points[k] = p.mean(axis=0) + c
    return turns, points, case.measured(np.tile(MIDDLE, (5, 1))).mean(axis=0)


def exponentials(found: tuple[Array, Array, Array], q: Array) -> Array:
    """Tool frames (n, 4, 4) of a product of exponentials about measured axes (Brockett 1984)."""
    turns, points, home = found
    T = np.tile(np.eye(4), (len(q), 1, 1))
    for k in range(6):
        R = rotation_from_vector((q[:, k] - MIDDLE[k])[:, None] * turns[k])
        T = T @ frame(R, points[k] - R @ points[k])
    return T @ home


def joints_at(model: RobotModel, places: Array, R: Array) -> Array:
    """Joint angles that the nominal robot takes for places (n, 3) in base coordinates, those in reach."""
    found = compensate(model, frame(R, places), near=MIDDLE, frame="base", settings=CompensationSettings("none"))
    return found.q[found.reachable]


def grid_correction(case: Case, q: Array) -> tuple[RobotModel, LinearNDInterpolator, NearestNDInterpolator]:
    """Nominal robot in its best cell, and its interpolated errors (world) by its believed place."""
    T = case.measured(q)
    model = case.fitted(case.nominal, case.recorded[:10], case.measured(case.recorded[:10]))
    believed = predicted(model, q)[:, :3, 3]
    error = T[:, :3, 3] - believed
    return model, LinearNDInterpolator(believed, error), NearestNDInterpolator(believed, error)


def corrected(grid: tuple[RobotModel, LinearNDInterpolator, NearestNDInterpolator], q: Array) -> Array:
    """Positions (n, 3) of the nominal robot with the interpolated correction; beyond the grid that of the nearest."""
    model, inside, nearest = grid
    p = predicted(model, q)[:, :3, 3]
    shift = inside(p)
    return p + np.where(np.isfinite(shift), shift, nearest(p))


def closed_loop(case: Case, kind: str) -> RobotModel:
    """Identification from a loop of 80 poses, base and tool then from ten measured frames."""
    rng, base = case.rng, case.true.replaced(world_T_base=np.eye(4))
    start = MIDDLE + rng.uniform(-0.3, 0.3, (80, 6)) * np.array([1, 1, 1, 2, 1.5, 4])
    centre = base.world_T_tool(MIDDLE[None])[0, :3, 3]
    away = rng.standard_normal((80, 3))
    away /= np.linalg.norm(away, axis=1, keepdims=True)
    away[:, 2] = np.abs(away[:, 2])
    flat = rng.uniform(-0.3, 0.3, (80, 3)) * [1, 1, 0]
    places = centre + {"point": 0.0 * away, "plane": flat, "length": 0.3 * away - [0, 0, 0.15]}[kind]
    q = touching(base, start, places + POSITION * rng.standard_normal((80, 3)))
    value = np.full(80, 0.3 if kind == "length" else 0.0)
    believed = predicted(replace(case.nominal, world_T_base=None), q)[:, :3, 3]
    model = replace(case.nominal, world_T_base=loop_world(kind, believed))
    kernel = Kernel(model, "converged")
    seen = loop_observations(kind, np.arange(80), value, np.full(80, POSITION))
    priors = {f"{f.name}.{kind}": 5e-4 if kind in "xyz" else 7e-4 for f in model.frames for kind in GEOMETRIC_KINDS}
    options = IdentifyOptions(statics="converged", robust=False, priors=priors)
    found = identify(model, kernel.poses(q), [seen], options, kernel).model
    few = case.recorded[:10]
    return case.fitted(found, few, case.measured(few))


def case_of(seed: int, scratch: str) -> Case:
    """A robot of the fixtures."""
    recording, truth = make_recording(seed=seed, level="frames", poses=80, verify=500)
    path = f"{scratch}/robot.yaml"
    with open(path, "w", encoding="utf-8") as stream:
        stream.write(yaml_text(recording.robot))
    rng = np.random.default_rng([seed, 5])
    known = [truth.robot.world_T_base, truth.robot.flange_T_tool @ frame_from_six(rng.normal(0, 1e-3, 6))]
    nominal = replace(read_robot(path), world_T_base=known[0], flange_T_tool=known[1])
    return Case(truth.robot, nominal, rng, truth.recorded.q[truth.identify], truth.recorded.q[~truth.identify])


def compared(seed: int) -> dict[str, tuple[float, float]]:
    """Mean position error (m) anywhere, and inside the grid with its orientation, by method."""
    import tempfile

    with tempfile.TemporaryDirectory() as scratch:
        case = case_of(seed, scratch)
    middle = inverse(case.true.world_T_base) @ predicted(case.nominal, MIDDLE[None])[0]
    R, p = middle[:3, :3], middle[:3, 3]
    on_grid = joints_at(case.nominal, p + np.stack(np.meshgrid(*GRID, indexing="ij"), axis=-1).reshape(-1, 3), R)
    low, high = np.array([[g[0], g[-1]] for g in GRID]).T
    inside = joints_at(case.nominal, p + case.rng.uniform(low, high, (200, 3)), R)

    def errors(positions: object) -> tuple[float, float]:
        out = []
        for q in (case.anywhere, inside):
            p = positions(q)  # type: ignore[operator]
            out.append(float(np.mean(np.linalg.norm(p - case.true.world_T_tool(q)[:, :3, 3], axis=1))))
        return out[0], out[1]

    def of_model(model: RobotModel) -> tuple[float, float]:
        return errors(lambda q: predicted(model, q)[:, :3, 3])

    axes, grid = circle_point(case), grid_correction(case, on_grid)
    results = {
        "nominal in its best cell": of_model(case.fitted(case.nominal, case.recorded, case.measured(case.recorded))),
        "full identification": of_model(full(case, case.recorded)),
        "circle point": errors(lambda q: exponentials(axes, q)[:, :3, 3]),
        "grid, interpolated": errors(lambda q: corrected(grid, q)),
    }
    for kind in ("point", "plane", "length"):
        results[f"closed loop, {kind}"] = of_model(closed_loop(case, kind))
    return results


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--robots", type=int, default=5)
    rows = defaultdict(list)
    for seed in range(parser.parse_args().robots):
        for name, values in compared(seed).items():
            rows[name].append(values)
    print(f"{'mean error in mm':28s} anywhere  in the grid")
    for name, values in rows.items():
        print(f"{name:28s} {1e3 * np.mean(values, axis=0)[0]:8.3f} {1e3 * np.mean(values, axis=0)[1]:8.3f}")


if __name__ == "__main__":
    main()
