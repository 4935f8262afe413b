"""Residuals as a table: measured minus modelled of everything that was measured."""

from collections.abc import Mapping, Sequence

import numpy as np

from robcal.calibration.calibrated import CalibratedRobot
from robcal.calibration.closed_loops import PlaneObservations
from robcal.calibration.measurements import RobotObservations
from robcal.calibration.observations import (
    DistanceObservations,
    FrameObservations,
    PointObservations,
    SensorPointObservations,
)
from robcal.files.poses_table import Poses

_KINDS: Mapping[type, str] = {
    FrameObservations: "frame",
    PointObservations: "point",
    DistanceObservations: "distance",
    PlaneObservations: "height",
    SensorPointObservations: "sensor_point",
}


def residual_columns(
    poses: Poses, robot: CalibratedRobot, observations: Sequence[RobotObservations]
) -> dict[str, list[object]]:
    """Columns in mm and deg: frames as a turn vector and in tool coordinates, points in the world."""
    T = robot.predict(poses.inputs(robot.kernel))[0]
    names = ("dx_mm", "dy_mm", "dz_mm", "rx_deg", "ry_deg", "rz_deg")
    columns: dict[str, list[object]] = {n: [] for n in ("pose", "set", "kind", "target", *names, "normalised")}
    for o in observations:
        r, _ = o.evaluate(T)
        white = np.linalg.solve(np.linalg.cholesky(o.noise(T)), r[..., None])[..., 0]
        scaled = r * np.array([1000.0] * 3 + [180 / np.pi] * 3)[: r.shape[1]]
        for i, pose in enumerate(o.pose):
            columns["pose"].append(poses.names[pose])
            columns["set"].append("verify" if poses.verify[pose] else "identify")
            columns["kind"].append(_KINDS[type(o)])
            columns["target"].append(int(o.target[i]) if isinstance(o, PointObservations) else "")
            for k, name in enumerate(names):
                columns[name].append(f"{scaled[i, k]:.6f}" if k < scaled.shape[1] else "")
            columns["normalised"].append(f"{np.sqrt(np.mean(white[i] ** 2)):.4f}")
    return columns
