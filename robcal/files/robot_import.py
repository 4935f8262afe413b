"""Nominal robots of other programs: URDF, Denavit-Hartenberg tables, Universal Robots' factory calibration.

Denavit-Hartenberg table ``dh.csv``: a row for each joint, ``a_mm, alpha_deg, d_mm, theta_deg`` and, optional, ``type``
(revolute | prismatic), ``convention`` (standard | modified, the same in all rows), ``name``, ``sign``.
Universal Robots' ``kinematics.yaml`` (package ur_calibration): origin and orientation of six joints, each turning about
the z axis of its own frame; behind the last one stands the controller's own flange (tool0).
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

import numpy as np

from robcal.errors import InvalidInput
from robcal.files.robot_file import read_robot
from robcal.files.storage import read_bytes
from robcal.files.tables import read_table
from robcal.files.ur_calibration import read_ur_calibration
from robcal.files.yaml_io import read_yaml
from robcal.robot.dh import DHRow, frames_from_dh
from robcal.robot.model import RobotModel
from robcal.robot.urdf_chain import UrdfStep, model_from_steps, model_from_urdf
from robcal.transforms import frame_from_xyzrpy

_MAX_BYTES = 20_000_000
_UR_JOINTS = {
    "shoulder": "shoulder_pan",
    "upper_arm": "shoulder_lift",
    "forearm": "elbow",
    "wrist_1": "wrist_1",
    "wrist_2": "wrist_2",
    "wrist_3": "wrist_3",
}


def read_any_robot(path: Path | str, base_link: str | None = None, tip_link: str | None = None) -> RobotModel:
    """Robot of a file of the project or of another program, told by suffix and content.

    Parameters
    ----------
    base_link, tip_link : ends of the chain in a URDF, where they are not the only ones possible.

    Raises
    ------
    InvalidInput : no robot in the file, or links named for a format that has none.
    """
    file = Path(path)
    suffix = file.suffix.lower()
    if suffix in (".urdf", ".xml", ".xacro"):
        text = read_bytes(file, _MAX_BYTES).decode("utf-8-sig", errors="replace")
        return _named(file, lambda: model_from_urdf(text, base_link, tip_link))
    if base_link or tip_link:
        raise InvalidInput(f"{file}: base_link and tip_link choose links of a URDF, this is none")
    if suffix == ".csv":
        return _read_dh(file)
    if suffix == ".conf":
        rows = read_ur_calibration(file)
        return _named(file, lambda: RobotModel(file.stem, frames_from_dh(rows)))
    data = read_yaml(file).data
    if "format" not in data and isinstance(data.get("kinematics"), Mapping):
        return _read_ur(file, data["kinematics"])
    return read_robot(file)


def _named(file: Path, read: Any) -> RobotModel:
    try:
        model: RobotModel = read()
    except InvalidInput as error:
        raise InvalidInput(f"{file}: {error}") from None
    return model


def _read_dh(file: Path) -> RobotModel:
    table = read_table(file)
    table.require(["a_mm", "alpha_deg", "d_mm", "theta_deg"])
    columns = {name: table.texts(name) for name in ("type", "convention", "name") if name in table.columns}
    conventions = set(columns.get("convention", ())) or {"standard"}
    if len(conventions) > 1 or not conventions <= {"standard", "modified"}:
        raise InvalidInput(f"{file}: convention must be standard or modified, the same in all rows")
    types = columns.get("type", ("revolute",) * len(table))
    for row, kind in zip(table.rows, types, strict=True):
        if kind not in ("revolute", "prismatic"):
            raise InvalidInput(f"{file}, row {int(row)}: type must be revolute or prismatic, found '{kind}'")
    signs = table.numbers("sign") if "sign" in table.columns else np.ones(len(table))
    if not np.all(np.abs(signs) == 1):
        raise InvalidInput(f"{file}: sign must be 1 or -1")
    theta, alpha = (np.radians(table.numbers(name)) for name in ("theta_deg", "alpha_deg"))
    d, a = (table.numbers(name) / 1000 for name in ("d_mm", "a_mm"))
    rows = [
        DHRow(
            theta=float(theta[k]),
            d=float(d[k]),
            a=float(a[k]),
            alpha=float(alpha[k]),
            prismatic=types[k] == "prismatic",
            sign=int(signs[k]),
            name=columns["name"][k] if "name" in columns else None,
        )
        for k in range(len(table))
    ]
    convention: Literal["standard", "modified"] = "modified" if conventions == {"modified"} else "standard"
    return _named(file, lambda: RobotModel(file.stem, frames_from_dh(rows, convention)))


def _read_ur(file: Path, kinematics: Mapping[str, Any]) -> RobotModel:
    return model_from_steps(file.stem, _ur_steps(file, kinematics))


def read_ur_joints(path: Path) -> list[UrdfStep]:
    """The six joints of Universal Robots' factory calibration.

    Raises
    ------
    InvalidInput : the file holds none.
    """
    kinematics = read_yaml(path).data.get("kinematics")
    if not isinstance(kinematics, Mapping):
        raise InvalidInput(f"{path}: holds no 'kinematics': name the kinematics.yaml that the robot was read from")
    return _ur_steps(path, kinematics)


def _ur_steps(file: Path, kinematics: Mapping[str, Any]) -> list[UrdfStep]:
    steps = []
    for link, joint in _UR_JOINTS.items():
        entry = kinematics.get(link)
        values = entry if isinstance(entry, Mapping) else {}
        numbers: list[Any] = [values.get(k) for k in ("x", "y", "z", "roll", "pitch", "yaw")]
        if not all(isinstance(v, int | float) and np.isfinite(v) for v in numbers):
            raise InvalidInput(f"{file}: kinematics.{link} must give x, y, z (m) and roll, pitch, yaw (rad)")
        origin = frame_from_xyzrpy([float(v) for v in numbers])
        steps.append(UrdfStep(joint, "revolute", origin, np.array([0.0, 0.0, 1.0]), None, 0.0, np.zeros(3), link))
    return steps
