"""Files of the cell: touches and nominal points in, frames and points with their covariance out."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from robcal.calibration.calibrated import CalibratedRobot
from robcal.calibration.joint_log import JointLog
from robcal.cell.adjustment import student_factor
from robcal.cell.carried import PlacedFrame
from robcal.cell.frames import CellFrame
from robcal.cell.points import TouchedPoints
from robcal.errors import InvalidInput
from robcal.files.frame_tables import SIX, six_covariance, twist_covariance, twist_from_six
from robcal.files.poses_table import read_poses
from robcal.files.schemas import Entry, Number, Triple, read_entry
from robcal.files.storage import write_text
from robcal.files.tables import read_table, write_table
from robcal.files.yaml_io import yaml_text
from robcal.transforms import Array, frame_from_xyzrpy, xyzrpy_from_frame

FORMAT = "robcal/cell-1"
SCALE = np.array([1e3] * 3 + [180.0 / np.pi] * 3)


@dataclass(frozen=True)
class Touches:
    """Joint angles at which points were touched, and the name (n,) of each point."""

    log: JointLog
    points: tuple[str, ...]
    outside: str


class RobotShare(Entry):
    """How a frame's errors go with those of the robot that it was found with."""

    parameters: list[str]
    covariance: list[list[Number]]


class PlacedEntry(Entry):
    """A frame with its uncertainty: millimetres and degrees."""

    xyz_mm: Triple = (0.0, 0.0, 0.0)
    rpy_deg: Triple = (0.0, 0.0, 0.0)
    sigma_mm: Triple | None = None
    sigma_deg: Triple | None = None
    interval_95_mm: Triple | None = None
    interval_95_deg: Triple | None = None
    covariance: list[list[Number]] | None = None
    held: list[str] = Field(default_factory=list)
    robot: RobotShare | None = None


class CellEntry(Entry):
    """A result of the cell."""

    format: Literal["robcal/cell-1"]
    flange_T_tool: PlacedEntry | None = None
    base_T_object: PlacedEntry | None = None
    world_T_base: PlacedEntry | None = None
    sigma0: Number | None = None
    redundancy: int | None = None
    touch_mm: Number | None = None
    tip_mm: Triple | None = None
    residuals_mm: dict[str, Number] = Field(default_factory=dict)
    notes: list[str] = Field(default_factory=list)


def read_touches(path: Path, robot: CalibratedRobot) -> Touches:
    """Read a table of touches: ``pose``, joint angles, ``point``, optional ``payload`` and covariates.

    Raises
    ------
    InvalidInput : missing columns, an empty name of a point.
    """
    log = read_poses(path, robot.model, robot.model.payloads, to_predict=True)
    table = read_table(path)
    table.require(["pose", "point"])
    return Touches(log, table.texts("point"), log.outside)


def read_nominal(path: Path, touches: Touches, touched: Path) -> tuple[Array, NDArray[np.bool_]]:
    """Nominal coordinates (n, 3) in m of the point of each touch and which of them are held (n, 3).

    Raises
    ------
    InvalidInput : a point that was touched and is not listed, or a coordinate that is none of x, y, z.
    """
    table = read_table(path)
    table.require(["point", "x_mm", "y_mm", "z_mm"])
    names = table.texts("point")
    table.unique(["point"])
    xyz = np.column_stack([table.numbers(f"{n}_mm") for n in "xyz"]) / 1000
    held = np.ones((len(names), 3), dtype=bool)
    if "hold" in table.columns:
        for i, cell in enumerate(table.columns["hold"]):
            letters = set(cell.lower()) - set(" |,;/+")
            if letters - set("xyz"):
                raise table.error(i, f"hold is '{cell[:40]}': name the coordinates to hold: x, y, z or several")
            held[i] = [not letters or n in letters for n in "xyz"]
    place = {name: i for i, name in enumerate(names)}
    missing = next((i for i, name in enumerate(touches.points) if name not in place), None)
    if missing is not None:
        at = int(read_table(touched).rows[missing])
        raise InvalidInput(
            f"{touched}, row {at}: point '{touches.points[missing]}' is not in {path}: list it there or remove the row"
        )
    rows = [place[name] for name in touches.points]
    return xyz[rows], held[rows]


def read_placed(path: Path, key: Literal["flange_T_tool", "base_T_object", "world_T_base"]) -> PlacedFrame:
    """A frame from a result of the cell.

    Raises
    ------
    InvalidInput : the file has none of that kind, or a covariance that is none.
    """
    entry, _ = read_entry(path, CellEntry, FORMAT)
    found: PlacedEntry | None = getattr(entry, key)
    if found is None:
        raise InvalidInput(f"{path}: holds no {key}: name the file that 'pipeline cell' wrote for it")
    six = np.array([*found.xyz_mm, *found.rpy_deg]) / SCALE
    numbers = np.zeros((6, 6))
    if found.covariance is not None:
        numbers = np.array(found.covariance, dtype=float) if _square(found.covariance) else np.full((6, 6), np.nan)
        numbers = numbers / np.outer(SCALE, SCALE)
        symmetric = np.allclose(numbers, numbers.T, rtol=1e-6, atol=1e-18)
        if not symmetric or np.linalg.eigvalsh(numbers)[0] < -1e-9 * max(np.trace(numbers), 1e-300):
            raise InvalidInput(f"{path}: {key}.covariance must be a symmetric 6x6 matrix without negative variances")
    elif found.sigma_mm is not None or found.sigma_deg is not None:
        sigma = np.array([*(found.sigma_mm or (0, 0, 0)), *(found.sigma_deg or (0, 0, 0))]) / SCALE
        numbers = np.diag(sigma**2)
    covariance = twist_covariance(six[None], numbers[None])[0]
    names: tuple[str, ...] = ()
    shared = np.zeros((6, 0))
    if found.robot is not None:
        names = tuple(found.robot.parameters)
        share = np.array(found.robot.covariance, dtype=float)
        if share.shape != (6, len(names)):
            raise InvalidInput(f"{path}: {key}.robot.covariance must have 6 rows of {len(names)} numbers")
        shared = twist_from_six(six[None])[0] @ (share / SCALE[:, None])
    return PlacedFrame(frame_from_xyzrpy(six), covariance, names, shared)


def _square(rows: list[list[float]]) -> bool:
    return len(rows) == 6 and all(len(row) == 6 for row in rows)


def placed_data(placed: PlacedFrame, of_touches: Array, freedom: float, held: Sequence[str]) -> dict[str, Any]:
    """A frame with its uncertainty as it stands in files; variances are those of its six numbers."""
    six = xyzrpy_from_frame(placed.T)
    covariance, own = (six_covariance(placed.T[None], C[None])[0] for C in (placed.covariance, of_touches))
    sigma = np.sqrt(np.clip(np.diag(covariance), 0, None)) * SCALE
    wide = sigma * student_factor(covariance, own, freedom)
    data = {
        "xyz_mm": _listed(six[:3] * 1e3),
        "rpy_deg": _listed(np.degrees(six[3:])),
        "sigma_mm": _short(sigma[:3]),
        "sigma_deg": _short(sigma[3:]),
        "interval_95_mm": _short(wide[:3]),
        "interval_95_deg": _short(wide[3:]),
        "covariance": [_short(row) for row in covariance * np.outer(SCALE, SCALE)],
    }
    if held:
        data["held"] = list(held)
    if placed.names:
        share = np.linalg.pinv(twist_from_six(six[None])[0]) @ placed.with_robot * SCALE[:, None]
        data["robot"] = {"parameters": list(placed.names), "covariance": [_short(row) for row in share]}
    return data


def cell_data(key: str, found: CellFrame, points: Sequence[str], notes: Sequence[str] = ()) -> dict[str, Any]:
    """Content of a result: the frame, sigma0, and the misses by point (root mean square of its touches)."""
    adjusted = found.adjusted
    data: dict[str, Any] = {
        "format": FORMAT,
        key: placed_data(found.placed, found.of_touches, adjusted.freedom, found.held),
        "sigma0": float(f"{adjusted.sigma0:.6g}"),
        "redundancy": adjusted.redundancy,
        "touch_mm": float(f"{adjusted.touch_sigma * 1e3:.6g}"),
    }
    if found.place is not None:
        data["tip_mm"] = _listed(found.place * 1e3)
    data["residuals_mm"] = by_point(found.residuals, points)
    if notes:
        data["notes"] = list(notes)
    return data


def by_point(residuals: Array, points: Sequence[str]) -> dict[str, float]:
    """Root mean square (mm) of the misses of each point's touches."""
    which = np.array(points)
    return {
        name: float(f"{1e3 * np.sqrt(np.mean(residuals[which == name] ** 2)):.6g}") for name in dict.fromkeys(points)
    }


def write_cell(path: Path, data: Mapping[str, Any]) -> None:
    """Write a result of the cell."""
    write_text(path, yaml_text(data))


def write_touched_points(path: Path, found: TouchedPoints) -> None:
    """Write measured points in base coordinates with their covariance."""
    columns: dict[str, Sequence[object]] = {"point": found.names}
    for k, n in enumerate("xyz"):
        columns[f"{n}_mm"] = [f"{v:.6f}" for v in found.places[:, k] * 1e3]
    for k, n in enumerate("xyz"):
        columns[f"s{n}_mm"] = [f"{v:.6g}" for v in 1e3 * np.sqrt(found.covariance[:, k, k])]
    for i, a in enumerate("xyz"):
        for k, b in list(enumerate("xyz"))[i:]:
            columns[f"s{a}{b}_mm2"] = [f"{v:.9g}" for v in 1e6 * found.covariance[:, i, k]]
    columns["touches"] = found.touches.tolist()
    write_table(path, columns)


def shift_words(shift: Array, sigma: Array) -> str:
    """A shift of a tool in words, mm in its own axes."""
    return ", ".join(f"{n} {1e3 * v:+.2f} +- {1e3 * s:.2f}" for n, v, s in zip(SIX[:3], shift, sigma, strict=True))


def _listed(values: Array) -> list[float]:
    return [float(v) + 0.0 for v in np.round(np.asarray(values, dtype=float), 9)]


def _short(values: Array) -> list[float]:
    return [float(f"{v:.9g}") for v in np.asarray(values, dtype=float)]
