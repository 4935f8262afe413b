"""Command export: the calibrated robot as C99 source, as URDF, as Universal Robots' calibration, and as plain data."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.cell_exports import ros_texts, write_cell_tables
from pipeline.json_io import write_json
from pipeline.robot_in_force import robot_in_force
from robcal.calibration.calibrated import CalibratedRobot
from robcal.errors import InvalidInput
from robcal.files.robot_import import read_ur_joints
from robcal.files.storage import read_bytes, write_text
from robcal.files.tables import write_table
from robcal.files.yaml_io import yaml_text
from robcal.robot.compensation import cell_frames
from robcal.robot.export.c_export import export_c, parameter_table
from robcal.robot.export.ur_kinematics import ur_kinematics
from robcal.robot.export.urdf import urdf_text
from robcal.robot.model import parameter_unit
from robcal.transforms import Array, xyzrpy_from_frame

MAX_BYTES = 20_000_000


@dataclass(frozen=True)
class Wanted:
    """What to export where; ``template`` is the file that the robot was read from (URDF or kinematics.yaml)."""

    c: Path | None = None
    table: Path | None = None
    urdf: Path | None = None
    kinematics: Path | None = None
    data: Path | None = None
    ros: Path | None = None
    template: Path | None = None


def export_run(folder: Path, wanted: Wanted, at_cycle: int | None = None) -> tuple[list[Path], list[str]]:
    """Write the wanted exports; returns the files and what has to be known of them.

    Raises
    ------
    InvalidInput : no calibrated robot in the run, or a model that has no counterpart in the format.
    """
    calibrated = robot_in_force(folder, at_cycle)
    texts: dict[Path, str] = {}
    notes: list[str] = []
    if wanted.c is not None:
        source = export_c(calibrated.model, statics=calibrated.statics, defaults=calibrated.defaults)
        texts[wanted.c / source.header_name] = source.header
        texts[wanted.c / source.source_name] = source.source
    if wanted.urdf is not None:
        template = None
        if wanted.template is not None:
            template = read_bytes(wanted.template, MAX_BYTES).decode("utf-8-sig", errors="replace")
        texts[wanted.urdf] = urdf_text(calibrated.model, template)
    if wanted.kinematics is not None:
        texts[wanted.kinematics] = _kinematics(calibrated, wanted, notes)
    if wanted.ros is not None:
        texts[wanted.ros / "robot.urdf"] = urdf_text(calibrated.model, None)
        cell, left = ros_texts(folder, cell_frames(calibrated.kernel)[0])
        texts |= {wanted.ros / name: text for name, text in cell.items()}
        notes += left
    for path, text in texts.items():
        write_text(path, text)
    written = list(texts)
    if wanted.table is not None:
        values = parameter_table(calibrated.model)
        write_table(wanted.table, {"parameter": list(values), "value": [repr(v) for v in values.values()]})
        written.append(wanted.table)
    if wanted.data is not None:
        written += [*_write_data(calibrated, wanted.data), *write_cell_tables(folder, wanted.data)]
    return written, notes


def _kinematics(calibrated: CalibratedRobot, wanted: Wanted, notes: list[str]) -> str:
    if wanted.template is None:
        raise InvalidInput(
            f"{wanted.kinematics}: needs the kinematics.yaml that the robot was read from: name it with --template"
        )
    entries, left = ur_kinematics(calibrated.model, read_ur_joints(wanted.template))
    off = 1e3 * np.linalg.norm(left[:3, 3]), np.degrees(np.arccos(np.clip((np.trace(left[:3, :3]) - 1) / 2, -1, 1)))
    notes.append(
        f"{wanted.kinematics}: the robot's flange is {off[0]:.3f} mm and {off[1]:.4f} deg off the format's, "
        "which has no place in it: measure the tool with the calibrated robot"
    )
    return yaml_text({"kinematics": {**entries, "hash": "calib_robcal"}}, "calibrated by robcal; elasticities left out")


def _write_data(calibrated: CalibratedRobot, folder: Path) -> list[Path]:
    """parameters.csv and robot.json: values, units, sigmas, covariance, base and tool."""
    model = calibrated.model
    sigma = dict(zip(calibrated.names, calibrated.sigma.tolist(), strict=True))
    values = parameter_table(model)
    columns = {
        "parameter": list(values),
        "value": [repr(v) for v in values.values()],
        "unit": [parameter_unit(model, name) for name in values],
        "sigma": [repr(sigma[name]) if name in sigma else "" for name in values],
    }
    base, tool = cell_frames(calibrated.kernel)
    data: dict[str, Any] = {
        "format": "robcal/export-1",
        "robot": model.name,
        "world_T_base": _six(base),
        "flange_T_tool": _six(tool),
        "parameters": {
            name: {"value": value, "unit": parameter_unit(model, name), "sigma": sigma.get(name)}
            for name, value in values.items()
        },
        "covariance": {"names": list(calibrated.names), "matrix": calibrated.covariance.tolist()},
    }
    write_table(folder / "parameters.csv", columns)
    write_json(folder / "robot.json", data)
    return [folder / "parameters.csv", folder / "robot.json"]


def _six(T: Array) -> dict[str, list[float]]:
    six = xyzrpy_from_frame(T)
    return {"xyz_mm": (1e3 * six[:3]).tolist(), "rpy_deg": np.degrees(six[3:]).tolist()}
