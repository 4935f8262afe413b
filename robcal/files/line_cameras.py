"""Files of linear cameras: readings (lines.csv), the calibrated system, known places of lights."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from pydantic import Field

from robcal.errors import InvalidInput
from robcal.files.measurement_tables import MeasuredTable, SharedErrors, few, point_covariance, pose_index, target_ids
from robcal.files.placement import PlacementEntry, placement_data
from robcal.files.schemas import Entry, Number, Positive, Text, proposal, read_entry
from robcal.files.storage import write_text
from robcal.files.tables import Table, read_table
from robcal.files.yaml_io import yaml_text
from robcal.photogrammetry.line_cameras.camera import NUMBERS, LineCamera, LineCameraSystem, Readings
from robcal.photogrammetry.line_cameras.intersection import LightPoints, intersect_planes
from robcal.transforms import Array

FORMAT = "robcal/line-cameras-1"
UNITS = np.array([1000.0] * 2 + [180.0 / np.pi] * 3 + [1.0] * 4)
"""Of the numbers of a camera in the file: mm, deg, px."""
FARTHEST = 3.0
"""A tangent of the angle off the axis beyond which no such lens sees."""
READING = ["pose", "target", "camera", "u_px"]


class LineCameraEntry(Entry):
    """One linear camera."""

    f_px: Positive
    c_px: Number
    k1: Number = 0.0
    k2: Number = 0.0
    world_T_camera: PlacementEntry
    range_px: tuple[Number, Number] | None = None

    def camera(self) -> LineCamera:
        """The camera in SI units."""
        return LineCamera(self.world_T_camera.matrix(), self.f_px, self.c_px, self.k1, self.k2, self.range_px)


class LineCamerasEntry(Entry):
    """The whole file; ``covariance`` is of all numbers, camera by camera, in mm, deg and px."""

    format: Literal["robcal/line-cameras-1"]
    cameras: dict[Text, LineCameraEntry]
    noise_px: Positive
    covariance: list[list[Number]] = Field(default_factory=list)


def read_line_cameras(path: Path) -> LineCameraSystem:
    """Read a calibrated system.

    Raises
    ------
    InvalidInput : fewer than three cameras, a covariance of another size or that is none.
    """
    entry, document = read_entry(path, LineCamerasEntry, FORMAT)
    cameras = tuple(e.camera() for e in entry.cameras.values())
    k = len(NUMBERS) * len(cameras)
    where = f"{path}, line {document.line(('covariance',)) or 1}"
    if entry.covariance and [len(row) for row in entry.covariance] != [k] * k:
        raise InvalidInput(
            f"{where}: the covariance of {len(cameras)} cameras has {k} rows of {k} numbers ({', '.join(NUMBERS)} "
            "of each): write the file with 'pipeline lines calibrate'"
        )
    covariance = np.array(entry.covariance) if entry.covariance else np.zeros((k, k))
    scale = np.tile(UNITS, len(cameras))
    covariance = covariance / np.outer(scale, scale)
    size = np.sqrt(np.maximum(np.diag(covariance), 1e-300))
    if np.abs(covariance - covariance.T).max() > 1e-6 * np.abs(covariance).max(initial=0.0) or (
        entry.covariance and np.linalg.eigvalsh(covariance / np.outer(size, size))[0] < -1e-6
    ):
        raise InvalidInput(f"{where}: the covariance is not symmetric and positive: calibrate the system again")
    try:
        return LineCameraSystem(tuple(entry.cameras), cameras, covariance, entry.noise_px)
    except InvalidInput as error:
        raise InvalidInput(f"{path}: {error}") from None


def write_line_cameras(path: Path, system: LineCameraSystem, comment: str = "") -> None:
    """Write a calibrated system atomically."""
    scale = np.tile(UNITS, len(system.cameras))
    cameras = {
        name: {
            "f_px": float(camera.f),
            "c_px": float(camera.c),
            "k1": float(camera.k1),
            "k2": float(camera.k2),
            **({} if camera.calibrated is None else {"range_px": list(camera.calibrated)}),
            "world_T_camera": placement_data(camera.world_T_camera),
        }
        for name, camera in zip(system.names, system.cameras, strict=True)
    }
    covariance = (system.covariance * np.outer(scale, scale)).tolist()
    data = {"format": FORMAT, "noise_px": float(system.noise), "cameras": cameras, "covariance": covariance}
    write_text(path, yaml_text(data, comment))


@dataclass(frozen=True)
class LightTable:
    """Readings of a table, light by light.

    ``keys`` : (pose, target) of each light as cells; ``first`` : record of its first reading; ``stated`` : whether
    the table has ``sigma_px``.
    """

    readings: Readings
    keys: tuple[tuple[str, str], ...]
    first: np.ndarray
    stated: bool


def light_table(table: Table, names: Sequence[str], noise: float) -> LightTable:
    """Readings of linear cameras from a table ``pose, target, camera, u_px``, optional ``sigma_px``.

    Raises
    ------
    InvalidInput : missing columns, a camera that the system does not have, a reading that stands twice.
    """
    table.require(READING)
    if not len(table):
        raise InvalidInput(f"{table.path}: lists no readings")
    cells = table.texts("camera")
    known = list(names)
    table.refuse(
        [cell not in known for cell in cells],
        lambda i: f"camera '{cells[i]}' is not in the system{proposal(cells[i], known)}",
    )
    table.unique(READING[:3])
    camera = np.array([known.index(cell) for cell in cells])
    stated = table.has("sigma_px")
    sigma = table.numbers("sigma_px", positive=True) if stated else np.full(len(table), noise)
    pairs = list(zip(table.texts("pose"), table.texts("target"), strict=True))
    place = {pair: i for i, pair in enumerate(dict.fromkeys(pairs))}
    point = np.array([place[pair] for pair in pairs])
    first = np.unique(point, return_index=True)[1]
    return LightTable(Readings(point, camera, table.numbers("u_px"), sigma), tuple(place), first, stated)


def lights_of(table: Table, system: LineCameraSystem) -> tuple[LightTable, LightPoints]:
    """The lights of a table of readings, and their places by the system.

    Raises
    ------
    InvalidInput : as :func:`light_table`; a reading far outside the camera; no light that three cameras saw.
    """
    lights = light_table(table, system.names, system.noise)
    camera = [system.cameras[k] for k in lights.readings.camera]
    off = np.array([(u - c.c) / c.f for u, c in zip(lights.readings.u, camera, strict=True)])
    table.refuse(
        np.abs(off) > FARTHEST,
        lambda i: (
            f"u_px = {lights.readings.u[i]:g} is {np.degrees(np.arctan(abs(off[i]))):.0f} deg off the axis of camera "
            f"'{table.columns['camera'][i]}': readings are in pixels from the start of the line"
        ),
    )
    found = intersect_planes(system, lights.readings)
    if not np.isfinite(found.p_world).any():
        reason = next(iter(found.reasons.values()), "no reading")
        raise InvalidInput(
            f"{table.path}: no light has a place (the first: {reason}): check the names of the cameras, and that the "
            "system was calibrated for these readings"
        )
    return lights, found


def measured_lights(table: Table, pose_names: Sequence[str], system: LineCameraSystem) -> MeasuredTable:
    """Readings as a table of points, with what the calibration of the system adds to all of them.

    Raises
    ------
    InvalidInput : as :func:`lights_of`; a pose that is not in the table of poses.
    """
    table.require(READING)
    pose = pose_index(table, pose_names)
    target = target_ids(table)
    notes: list[str] = []
    lights, found = lights_of(table, system)
    good = np.asarray(np.isfinite(found.p_world).all(axis=1))
    shared = SharedErrors(found.covariance[good], found.jacobian[good], system.covariance)
    if found.reasons:
        told = [f"target {t} of pose '{p}': {found.reasons[i]}" for i, (p, t) in enumerate(lights.keys) if not good[i]]
        notes.append(f"{table.path.name}: {len(told)} lights without a place: {few(told)}")
    dropped = int(np.count_nonzero(~found.used & good[lights.readings.point]))
    if dropped:
        notes.append(f"{table.path.name}: {dropped} readings contradict the other cameras and were left out")
    for k, camera in enumerate(system.cameras):
        far = int(np.count_nonzero(camera.beyond(lights.readings.u[lights.readings.camera == k])))
        if far and camera.calibrated is not None:
            low, high = camera.calibrated
            notes.append(
                f"{table.path.name}: {far} readings of camera '{system.names[k]}' lie beyond those of its calibration "
                f"({low:.0f} to {high:.0f} px): calibrate it with places all over the volume"
            )
    at = lights.first[good]
    return MeasuredTable(
        "points",
        table.path,
        pose[at],
        table.rows[at],
        target[at],
        found.p_world[good],
        shared.total,
        {},
        tuple(notes),
        shared=shared,
    )


@dataclass(frozen=True)
class CalibrationReadings:
    """Readings of lights at known places: names of the cameras, places (n, 3) m and their covariance (n, 3, 3);
    ``rows`` (m,) of the readings in their file."""

    names: tuple[str, ...]
    readings: Readings
    places: Array
    covariance: Array
    stated: bool
    rows: np.ndarray


def read_calibration(lines: Path, places: Path) -> CalibrationReadings:
    """Readings ``pose, target, camera, u_px`` and known places ``pose, target, x_mm, y_mm, z_mm`` of the same lights.

    ``target`` may be left out of the places where each pose has one light; ``sigma_mm`` or a covariance says how well
    the places are known, without it they count as exact.

    Raises
    ------
    InvalidInput : contradictions of a table, lights without a known place.
    """
    table, known = read_table(lines), read_table(places)
    table.require(READING)
    names = tuple(dict.fromkeys(table.texts("camera")))
    if len(names) < 3:
        raise InvalidInput(
            f"{lines}: has readings of {len(names)} cameras: three are needed, each reading gives one plane"
        )
    lights = light_table(table, names, 1.0)
    keys = ["pose", "target"] if known.has("target") else ["pose"]
    known.require([*keys, "x_mm", "y_mm", "z_mm"])
    known.unique(keys)
    at = {cells: i for i, cells in enumerate(zip(*(known.texts(key) for key in keys), strict=True))}
    rows = [at.get(light[: len(keys)], -1) for light in lights.keys]
    missing = [i for i, row in enumerate(rows) if row < 0]
    if missing:
        pose, target = lights.keys[missing[0]]
        raise table.error(
            int(lights.first[missing[0]]),
            f"target {target} of pose '{pose}' has no known place in {places.name} ({len(missing)} such lights): add "
            "it there or remove the readings",
        )
    xyz = np.column_stack([known.numbers(f"{axis}_mm") for axis in "xyz"]) / 1000.0
    covariance = point_covariance(known)
    spread = np.zeros((len(xyz), 3, 3)) if covariance is None else covariance
    return CalibrationReadings(names, lights.readings, xyz[rows], spread[rows], lights.stated, table.rows)
