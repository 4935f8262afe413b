"""A robot from two tables: the joint angles that were commanded, the frames that a tracker measured.

The tables are simulated here; with your own, only the lines from ``read_any_robot`` on are needed.
"""

from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

import robcal
from fixtures.campaigns import make_campaign

LOADS = {
    "dumbbell": robcal.Payload(150.0, (0.015, -0.025, 0.210)),
    "plate_only": robcal.Payload(25.0, (0.0, 0.0, 0.090)),
}


def main() -> float:
    """Calibrate; returns the root mean square position error (m) on the poses that were kept out."""
    with TemporaryDirectory() as place:
        folder = Path(place)
        make_campaign(folder, robot="kr150", level="frames", poses=60, verify=15, seed=5)

        model = replace(robcal.read_any_robot(folder / "robot.yaml"), payloads=LOADS)
        log = robcal.read_joint_log(folder / "poses.csv", model)
        recording = robcal.read_recording(folder / "frames.csv", log)
        found = robcal.identify_robot(model, log, recording)
        verification = robcal.verify_robot(model, found, found.robot, log).delivered
        robcal.write_robot(folder / "calibrated.yaml", found.robot.model)

        frames, covariance = found.robot.predict(found.robot.inputs(log))
    sigma = 1e3 * np.sqrt(np.trace(covariance[:, :3, :3], axis1=1, axis2=2))
    error = verification.tools["0"].rms
    print(f"{len(found.robot.names)} parameters from {len(found.rows)} poses; kept out: {1e3 * error:.3f} mm rms")
    print(f"first tool at {np.round(1e3 * frames[0, :3, 3], 2)} mm, sure to {sigma[0]:.3f} mm")
    return float(error)


if __name__ == "__main__":
    main()
