"""Readings of a sensor in the hand from a table: ``cycle, time_s, pose, target, x_mm, y_mm, z_mm`` and more."""

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from robcal.calibration.calibrated import CalibratedRobot
from robcal.drift.reference import Readings
from robcal.errors import InvalidInput
from robcal.files.measurement_tables import MAX_METRES, point_covariance
from robcal.files.poses_table import joint_columns, parse_payload
from robcal.files.tables import Table, read_table
from robcal.robot.kernel import Kernel

MOST_MM = 5000.0
_REQUIRED = ("cycle", "time_s", "pose", "target", "x_mm", "y_mm", "z_mm")


@dataclass(frozen=True)
class ReadingsTable:
    """Readings and the table that they come from; ``content`` is what is stored of each row."""

    table: Table
    readings: Readings
    content: tuple[dict[str, Any], ...]


Angles = Callable[[str], np.ndarray | None]


def read_readings(
    path: Path, robot: CalibratedRobot, kernel: Kernel, angles: Angles, sigma: float, payload: Mapping[str, str | None]
) -> ReadingsTable:
    """Read a table of readings.

    Parameters
    ----------
    angles : joint angles of a pose whose row states none. payload : load by pose where the row states none.
    sigma : m, of coordinates without a stated covariance.

    Raises
    ------
    InvalidInput : missing columns, a measurement twice, impossible numbers, a pose without joint angles.
    """
    table = read_table(path)
    table.require(_REQUIRED)
    if not len(table):
        raise InvalidInput(f"{path}: lists no readings")
    table.unique(["cycle", "pose", "target"])
    cycle, target = table.whole_numbers("cycle"), table.whole_numbers("target")
    time = table.numbers("time_s")
    pose = table.texts("pose")
    x = np.column_stack([table.numbers(f"{k}_mm") for k in "xyz"]) / 1000
    _check_distance(table, x)
    stated = point_covariance(table)
    covariance = np.broadcast_to(sigma**2 * np.eye(3), (len(table), 3, 3)) if stated is None else stated
    q = _angles(table, robot, pose, angles)
    loads = list(parse_payload(table, robot.model.payloads))
    if "payload" not in table.columns:
        loads = [payload.get(name) for name in pose]
    known = {*_REQUIRED, "payload", *(n for n, _ in joint_columns(robot.model))}
    others = {
        name: column
        for name in table.columns
        if name not in known and not re.fullmatch(r"s[xyz]{2}_mm2|s[xyz]_mm|sigma_mm", name)
        if (column := table.number_column(name)) is not None
    }
    content = tuple(
        {
            "x": x[i].tolist(),
            "C": covariance[i].tolist(),
            "q": q[i].tolist(),
            "payload": loads[i],
            "covariates": {name: float(column[i]) for name, column in others.items()},
        }
        for i in range(len(table))
    )
    return ReadingsTable(table, made(kernel, robot, cycle, time, pose, target, content), content)


def _check_distance(table: Table, x: np.ndarray) -> None:
    far = np.abs(x).max(axis=1) > min(MOST_MM / 1000, MAX_METRES)
    if far.any():
        i = int(np.argmax(far))
        raise table.error(i, f"a target {np.abs(x[i]).max():.3g} m off the sensor: coordinates are in mm")


def made(
    kernel: Kernel,
    robot: CalibratedRobot,
    cycle: np.ndarray,
    time: np.ndarray,
    pose: tuple[str, ...],
    target: np.ndarray,
    content: tuple[dict[str, Any], ...],
) -> Readings:
    """Readings from what is stored of each row; covariates that a row does not state are those of the reference."""
    n = len(content)
    covariates: dict[str, np.ndarray] = {}
    for name in sorted({*robot.defaults, *(k for c in content for k in c["covariates"])}):
        default = robot.defaults.get(name, 0.0)
        covariates[name] = np.array([c["covariates"].get(name, default) for c in content], dtype=float)
    q = np.array([c["q"] for c in content], dtype=float).reshape(n, robot.model.n_joints)
    return Readings(
        np.asarray(cycle, dtype=np.int64),
        np.asarray(time, dtype=float),
        tuple(pose),
        np.asarray(target, dtype=np.int64),
        np.array([c["x"] for c in content], dtype=float).reshape(n, 3),
        np.array([c["C"] for c in content], dtype=float).reshape(n, 3, 3),
        kernel.poses(q, [c["payload"] for c in content], covariates),
    )


def _angles(table: Table, robot: CalibratedRobot, pose: tuple[str, ...], angles: Angles) -> np.ndarray:
    joints = joint_columns(robot.model)
    some = [name for name, _ in joints if table.has(name)]
    if some:
        table.require([name for name, _ in joints])
        return np.column_stack([table.numbers(name) * factor for name, factor in joints])
    rows = []
    for i, name in enumerate(pose):
        known = angles(name)
        if known is None:
            raise table.error(i, f"pose '{name}' has no joint angles: give {joints[0][0]} ... {joints[-1][0]} columns")
        rows.append(known)
    return np.array(rows)
