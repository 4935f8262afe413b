"""Zero offsets from one camera of 5 megapixels at 2 m: errors by axis, and do 95 % intervals hold?

``python -m benchmarks.mastering [--draws 500] [--poses 1 5 20]``: a robot identified from 80 frames; in each draw the
true robot (of fixtures) differs from it as its covariance says, has zeros off by up to a degree, and carries a plate of
25 dots of which the camera measures centres to 0.03 px. The camera's interior and exterior orientation are known.
"""

import argparse
import tempfile
from pathlib import Path

import numpy as np

from fixtures.campaigns import make_campaign
from fixtures.random_robots import LOADS, description, load_class
from fixtures.rigid import Array, frame, frame_from_six, inverse, move
from fixtures.true_robot import TrueRobot
from pipeline.runner import run_campaign
from pipeline.runs import open_run
from pipeline.stages.identify import load_calibrated
from robcal.calibration.calibrated import CalibratedRobot
from robcal.calibration.joint_log import JointLog
from robcal.calibration.observations import PixelObservations
from robcal.cell.mastering import Mastering, master
from robcal.photogrammetry.core.camera import Camera

WIDTH, HEIGHT, FOCAL = 2448, 2048, 5200.0
"""5 megapixels of 3.45 um behind 18 mm: a field of 0.95 m by 0.8 m at 2 m."""
PIXEL = 0.03
DISTANCE = 2.0
STEPS = np.linspace(-0.2, 0.2, 5)
GRID = np.array([[x, y, 0.02 * ((i + j) % 2)] for i, x in enumerate(STEPS) for j, y in enumerate(STEPS)])
MIDDLE = np.radians([10.0, 10.0, 70.0, 20.0, 40.0, 10.0])


def identified() -> CalibratedRobot:
    """A robot identified from 80 frames."""
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        make_campaign(folder / "campaign", seed=6, level="frames", poses=80, verify=8)
        run_campaign(folder / "campaign", folder / "run", until="identify")
        return load_calibrated(open_run(folder / "run"))


def looking_at(world_T_tool: Array) -> Array:
    """camera_T_world of a camera that looks at the plate from 2 m, 35 degrees off its normal."""
    R, p = world_T_tool[:3, :3], world_T_tool[:3, 3]
    ahead = R @ np.array([np.sin(np.radians(35)), 0.0, -np.cos(np.radians(35))])
    right = np.cross(ahead, R[:, 1])
    right /= np.linalg.norm(right)
    return inverse(frame(np.stack([right, np.cross(ahead, right), ahead], axis=1), p - DISTANCE * ahead))


def project(camera_T_world: Array, points: Array) -> Array:
    """Pixels (..., 2) of points (..., 3) by a pinhole without distortion."""
    p = points @ camera_T_world[:3, :3].T + camera_T_world[:3, 3]
    return np.array([(WIDTH - 1) / 2, (HEIGHT - 1) / 2]) + FOCAL * p[..., :2] / p[..., 2:]


def draw(robot: CalibratedRobot, rng: np.random.Generator, poses: int) -> tuple[Mastering, Array]:
    """One mastering and the true offsets."""
    error = rng.multivariate_normal(np.zeros(len(robot.names)), robot.covariance, method="cholesky")
    twist = {name: -float(e) for name, e in zip(robot.names, error, strict=True)}
    values = dict(robot.model.parameters)
    for name, e in twist.items():
        if not name.startswith(("base.", "tool.")):
            values[name] = values.get(name, 0.0) + e
    ends = {}
    for end, reference in (("base", robot.kernel.world_T_base), ("tool", robot.kernel.flange_T_tool)):
        six = np.array([twist.get(f"{end}.{k}", 0.0) for k in ("x", "y", "z", "roll", "pitch", "yaw")])
        ends[end] = reference @ frame_from_six(six)
    loads = {k: (m, np.array(c) / 1000.0) for k, (m, c) in LOADS[load_class("kr150")].items()}
    true = TrueRobot(
        description("kr150"), values, world_T_base=ends["base"], flange_T_tool=ends["tool"], payloads=loads
    )
    offsets = np.radians(rng.uniform(-1, 1, 6))
    q = MIDDLE + (rng.uniform(-0.12, 0.12, (poses, 6)) * np.array([1, 1, 1, 4, 3, 5]) if poses > 1 else 0.0)
    q = np.atleast_2d(q)
    T = true.world_T_tool(q + offsets)
    camera_T_world = looking_at(true.world_T_tool(MIDDLE[None] + offsets)[0])
    xy = project(camera_T_world, move(T, GRID))
    xy = xy + PIXEL * rng.standard_normal(xy.shape)
    seen = np.all((xy > 0) & (xy < [WIDTH, HEIGHT]), axis=2)
    pose, dot = np.nonzero(seen)
    marks = PixelObservations(
        pose,
        np.zeros(len(pose), dtype=np.int64),
        GRID[dot],
        xy[seen],
        np.broadcast_to(PIXEL**2 * np.eye(2), (len(pose), 2, 2)),
        (Camera(WIDTH, HEIGHT, FOCAL, FOCAL, (WIDTH - 1) / 2, (HEIGHT - 1) / 2),),
        camera_T_world[None],
    )
    log = JointLog(tuple(map(str, range(poses))), q, (None,) * poses, np.zeros(poses, bool), np.zeros_like(q))
    return master(robot, log, [marks]), offsets


def coverage(draws: int, poses: int, seed: int = 1) -> tuple[Array, Array, Array]:
    """Share of offsets within their 95 % interval, root mean square error and mean sigma in deg, by axis (6,)."""
    robot, rng = identified(), np.random.default_rng([seed, poses])
    inside, errors, sigmas = [], [], []
    for _ in range(draws):
        found, offsets = draw(robot, rng, poses)
        error = found.offsets - offsets
        inside.append(np.abs(error) <= found.wide)
        errors.append(np.degrees(error))
        sigmas.append(np.degrees(found.sigma))
    return np.mean(inside, axis=0), np.sqrt(np.mean(np.square(errors), axis=0)), np.mean(sigmas, axis=0)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--draws", type=int, default=500)
    parser.add_argument("--poses", type=int, nargs="*", default=[1, 5, 20])
    options = parser.parse_args()
    for poses in options.poses:
        share, error, sigma = coverage(options.draws, poses)
        print(f"{poses} poses, {options.draws} draws, axis 1 to 6")
        print("  error rms deg ", " ".join(f"{e:.5f}" for e in error))
        print("  mean sigma deg", " ".join(f"{s:.5f}" for s in sigma))
        print("  within 95 %   ", " ".join(f"{100 * s:7.1f}" for s in share), f"  all {100 * share.mean():.1f}")


if __name__ == "__main__":
    main()
