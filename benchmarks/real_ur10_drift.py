"""Does the UR10 of the public series A drift over its 100 hours? From poses that were measured again later.

Two visits of nearly the same pose differ by drift, repeatability and the tracker's noise; what no model explains about
the pose cancels. Weakness: body temperatures were not recorded, air changed by 0.8 K only.

    python -m benchmarks.real_ur10_drift FOLDER    # the folder of series A: poses.csv, frames.csv, ../robot.yaml
"""

import sys
from pathlib import Path

import numpy as np

from robcal.calibration.calibrated import CalibratedRobot
from robcal.calibration.start_values import hand_eye
from robcal.files.measurement_tables import read_measurements
from robcal.files.poses_table import read_poses
from robcal.files.robot_import import read_any_robot


def main() -> None:
    """Print the comparison of twins."""
    folder = Path(sys.argv[1])
    model = read_any_robot(folder.parent / "robot.yaml")
    log = read_poses(folder / "poses.csv", model, model.payloads)
    table = read_measurements(folder / "frames.csv", log.names)
    kernel = CalibratedRobot(model=model).kernel
    flange = kernel.frames(kernel.theta0, log.inputs(kernel))[table.pose]
    (base, tool), _ = hand_eye(flange, table.values)
    r = table.values[:, :3, 3] - (base @ flange @ tool)[:, :3, 3]
    q, hours = log.q[table.pose], log.covariates["time_s"][table.pose] / 3600
    air = log.covariates["temp_air_c"][table.pose]
    pairs = [
        (i, j) for i in range(len(q) - 1) for j in np.flatnonzero(np.abs(q[i + 1 :] - q[i]).max(axis=1) < 0.02) + i + 1
    ]
    i, j = np.array(pairs).T
    gap, change = hours[j] - hours[i], 1e3 * (r[j] - r[i])
    print(f"{len(pairs)} pairs of visits within 0.02 rad")
    for low, high in ((0, 0.25), (0.25, 1), (1, 5), (5, 24), (24, 200)):
        rows = (np.abs(gap) >= low) & (np.abs(gap) < high)
        if rows.any():
            size = np.linalg.norm(change[rows], axis=1)
            mean = np.linalg.norm((np.sign(gap[rows])[:, None] * change[rows]).mean(axis=0))
            print(
                f"  {low:6.2f} to {high:6.2f} h: {rows.sum():5d} pairs, median {np.median(size):.3f} mm, "
                f"rms {np.sqrt(np.mean(size**2)):.3f}, common shift {mean:.3f}"
            )
    for name, cause in (("per day", gap / 24), ("per K of air", air[j] - air[i])):
        slope = change.T @ cause / (cause @ cause)
        explained = 1 - np.sum((change - np.outer(cause, slope)) ** 2) / np.sum(change**2)
        rng = np.random.default_rng(0)
        flips = [
            np.linalg.norm((change * rng.choice([-1, 1], len(gap))[:, None]).T @ cause / (cause @ cause))
            for _ in range(999)
        ]
        p = (1 + np.sum(np.array(flips) >= np.linalg.norm(slope))) / 1000
        text = ", ".join(f"{v:+.4f}" for v in slope)
        print(f"  shift {name}: {text} mm; explains {100 * explained:.1f} % of the squares, p = {p:.3f}")


if __name__ == "__main__":
    main()
