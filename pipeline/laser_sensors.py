"""Commands of laser sensors: calibrate one, and points of its raw readings without a campaign."""

from pathlib import Path
from typing import Any

import numpy as np

from robcal.errors import DegenerateGeometry, InvalidInput
from robcal.files.laser_sensor import read_sensor, read_sensor_calibration, sensed_points, write_sensor
from robcal.files.tables import read_table, write_table
from robcal.photogrammetry.laser_sensors.calibration import calibrate_sensor
from robcal.photogrammetry.laser_sensors.sensor import READINGS

COVARIANCE = ("sxx_mm2", "sxy_mm2", "sxz_mm2", "syy_mm2", "syz_mm2", "szz_mm2")


def calibrate_from(table: Path, kind: str, out: Path, aim_mm: float) -> dict[str, Any]:
    """Calibrate a sensor from a table of readings at known places, and write it."""
    given = read_sensor_calibration(table, kind)
    try:
        found = calibrate_sensor(kind, given.readings, given.places, given.sigma, aim_mm / 1000.0)
    except (DegenerateGeometry, InvalidInput) as error:
        raise type(error)(f"{table}: {error}") from None
    write_sensor(out, found.sensor)
    names = READINGS[kind]
    return {
        "kind": kind,
        "places": len(given.readings),
        "redundancy": found.redundancy,
        "noise": dict(zip(names, found.sensor.noise.tolist(), strict=True)),
        "rms": dict(zip(names, np.sqrt(np.mean(found.residual**2, axis=0)).tolist(), strict=True)),
        "odd_rows": [int(given.rows[k]) for k in found.odd],
    }


def points_from(table: Path, file: Path, out: Path) -> dict[str, Any]:
    """Write the points of raw readings, each with its whole covariance."""
    raw = read_table(table)
    raw.require(["pose", "target"])
    found = sensed_points(raw, tuple(dict.fromkeys(raw.texts("pose"))), read_sensor(file))
    assert found.covariance is not None
    covariance = 1e6 * found.covariance
    columns: dict[str, list[object]] = {"pose": list(raw.texts("pose")), "target": found.target.tolist()}
    columns |= {name: values.tolist() for name, values in found.covariates.items()}
    columns |= {f"{axis}_mm": (1e3 * found.values[:, k]).tolist() for k, axis in enumerate("xyz")}
    entries = zip(COVARIANCE, zip(*np.triu_indices(3), strict=True), strict=True)
    columns |= {name: covariance[:, i, j].tolist() for name, (i, j) in entries}
    write_table(out, columns)
    return {"points": len(found), "sigma_mm": float(np.sqrt(np.mean(covariance[:, 2, 2])))}
