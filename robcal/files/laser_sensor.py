"""Files of laser sensors: the calibrated sensor, raw readings of a campaign, readings of a calibration."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from robcal.errors import InvalidInput
from robcal.files.measurement_tables import MeasuredTable, SharedErrors, pose_index, target_ids
from robcal.files.schemas import Entry, NotNegative, Number, Positive, read_entry
from robcal.files.storage import write_text
from robcal.files.tables import Table, read_table
from robcal.files.yaml_io import yaml_text
from robcal.photogrammetry.laser_sensors.sensor import NUMBERS, READINGS, LaserSensor
from robcal.transforms import Array

FORMAT = "robcal/sensor-1"
MM = {"distance_mm"}


class SensorEntry(Entry):
    """The whole file; ``covariance`` of the numbers in their order."""

    format: Literal["robcal/sensor-1"]
    kind: Literal["point", "section", "spot", "axial"]
    numbers: dict[str, Number]
    covariance: list[list[Number]] = Field(default_factory=list)
    noise: dict[str, Positive]
    range: dict[str, tuple[Number, Number]]
    aim_mm: NotNegative = 0.0


def read_sensor(path: Path) -> LaserSensor:
    """Read a calibrated sensor.

    Raises
    ------
    InvalidInput : numbers, noise or ranges of another kind of sensor, a covariance that is none.
    """
    entry, document = read_entry(path, SensorEntry, FORMAT)
    names, columns = NUMBERS[entry.kind], READINGS[entry.kind]
    for key, wanted in (("numbers", names), ("noise", columns), ("range", columns)):
        if set(getattr(entry, key)) != set(wanted):
            raise InvalidInput(
                f"{path}, line {document.line((key,)) or 1}: {key} of a sensor of kind '{entry.kind}' are "
                f"{', '.join(wanted)}: write the file with 'pipeline sensor calibrate'"
            )
    covariance = np.array(entry.covariance) if entry.covariance else np.zeros((len(names), len(names)))
    try:
        sensor = LaserSensor(
            entry.kind,
            np.array([entry.numbers[n] for n in names]),
            covariance,
            np.array([entry.noise[c] for c in columns]),
            np.array([entry.range[c] for c in columns]),
            entry.aim_mm / 1000.0,
        )
    except (InvalidInput, ValueError) as error:
        raise InvalidInput(f"{path}: {error}") from None
    size = np.sqrt(np.maximum(np.diag(sensor.covariance), 1e-300))
    scaled = sensor.covariance / np.outer(size, size)
    if entry.covariance and (np.abs(scaled - scaled.T).max() > 1e-6 or np.linalg.eigvalsh(scaled)[0] < -1e-6):
        raise InvalidInput(f"{path}: the covariance is not symmetric and positive: calibrate the sensor again")
    return sensor


def write_sensor(path: Path, sensor: LaserSensor, comment: str = "") -> None:
    """Write a calibrated sensor atomically."""
    columns = READINGS[sensor.kind]
    data = {
        "format": FORMAT,
        "kind": sensor.kind,
        "numbers": dict(zip(NUMBERS[sensor.kind], sensor.numbers.tolist(), strict=True)),
        "noise": dict(zip(columns, sensor.noise.tolist(), strict=True)),
        "range": dict(zip(columns, sensor.ranges.tolist(), strict=True)),
        "aim_mm": 1000.0 * sensor.aim,
        "covariance": sensor.covariance.tolist(),
    }
    write_text(path, yaml_text(data, comment))


def readings_of(table: Table, kind: str) -> Array:
    """Raw readings (m, r) of a table.

    Raises
    ------
    InvalidInput : missing columns, a cell that is no number, no rows.
    """
    table.require(READINGS[kind])
    if not len(table):
        raise InvalidInput(f"{table.path}: lists no readings")
    return np.column_stack([table.numbers(name) for name in READINGS[kind]])


def sensed_points(
    table: Table, pose_names: Sequence[str], sensor: LaserSensor, q: Array | None = None
) -> MeasuredTable:
    """Raw readings ``pose, target`` and the columns of the sensor's kind as points in the sensor, with covariance.

    Raises
    ------
    InvalidInput : as :func:`readings_of`; a reading beyond those of the calibration, an unknown pose, a doubled row.
    """
    table.require(["pose", "target"])
    readings = readings_of(table, sensor.kind)
    pose = pose_index(table, pose_names)
    target = target_ids(table)
    table.unique(["pose", "target", *(["cycle"] if table.has("cycle") else [])])
    names, ranges = READINGS[sensor.kind], sensor.ranges.tolist()
    message = ", ".join(f"{n} {low:g} to {high:g}" for n, (low, high) in zip(names, ranges, strict=True))
    table.refuse(
        sensor.outside(readings),
        lambda i: (
            f"the reading ({', '.join(f'{n} = {v:g}' for n, v in zip(names, readings[i], strict=True))}) lies beyond "
            f"those of the sensor's calibration ({message}): check the units, or calibrate over the whole range"
        ),
    )
    p, noise, J = sensor.points(readings)
    shared = SharedErrors(noise, J, sensor.covariance)
    covariates = {name: table.numbers(name) for name in ("cycle", "time_s") if table.has(name)}
    return MeasuredTable(
        "sensor_points", table.path, pose, table.rows, target, p, shared.total, covariates, shared=shared, q=q
    )


@dataclass(frozen=True)
class CalibrationRows:
    """Readings (m, r) of a target at known places (m, 3) m; ``sigma`` m of these; ``rows`` in the file."""

    readings: Array
    places: Array
    sigma: float
    rows: NDArray[np.int64]


def read_sensor_calibration(path: Path, kind: str) -> CalibrationRows:
    """A table of the readings of a kind and ``x_mm, y_mm, z_mm`` (``z_mm`` alone of one that only tells depth).

    Raises
    ------
    InvalidInput : as :func:`readings_of`; a place behind the sensor.
    """
    table = read_table(path)
    readings = readings_of(table, kind)
    axes = {"point": "z", "axial": "z", "section": "yz", "spot": "xyz"}[kind]
    table.require([f"{a}_mm" for a in axes])
    places = np.zeros((len(table), 3))
    for axis in axes:
        places[:, "xyz".index(axis)] = table.numbers(f"{axis}_mm") / 1000.0
    table.refuse(places[:, 2] <= 0, lambda i: f"z_mm = {1e3 * places[i, 2]:g} lies behind the sensor: z is its depth")
    sigma = (
        float(np.sqrt(np.mean(table.numbers("sigma_mm", positive=True) ** 2))) / 1e3 if table.has("sigma_mm") else 0.0
    )
    return CalibrationRows(readings, places, sigma, table.rows)
