"""Commands of linear cameras: calibrate a system, and points of its readings without a campaign."""

from pathlib import Path
from typing import Any

import numpy as np

from robcal.errors import DegenerateGeometry, InvalidInput
from robcal.files.line_cameras import lights_of, read_calibration, read_line_cameras, write_line_cameras
from robcal.files.tables import read_table, write_table
from robcal.photogrammetry.line_cameras.calibration import calibrate
from robcal.photogrammetry.line_cameras.camera import NUMBERS

MOST_REPORTED = 5


def calibrate_lines(lines: Path, places: Path, out: Path) -> dict[str, Any]:
    """Calibrate a system from readings of lights at known places, and write it."""
    given = read_calibration(lines, places)
    try:
        found = calibrate(given.names, given.readings, given.places, given.covariance, stated=given.stated)
    except DegenerateGeometry as error:
        raise DegenerateGeometry(f"{places}: {error}") from None
    if not found.summary.converged:
        raise InvalidInput(
            f"{lines}: readings and places do not fit any linear cameras ({found.summary.termination}): check that the "
            "rows of both tables name the same lights and that places are in mm"
        )
    write_line_cameras(out, found.system)
    rejected = []
    for i in np.flatnonzero(found.rejected)[:MOST_REPORTED]:
        camera = given.names[given.readings.camera[i]]
        rejected.append({"row": int(given.rows[i]), "camera": camera, "residual_px": float(found.residual[i])})
    sigma = np.sqrt(np.diag(found.system.covariance)).reshape(-1, len(NUMBERS))
    kept = ~found.rejected
    return {
        "cameras": {
            name: {
                "rms_px": float(np.sqrt(np.mean(found.residual[kept & (given.readings.camera == k)] ** 2))),
                "sigma_f_px": float(sigma[k, NUMBERS.index("f")]),
            }
            for k, name in enumerate(given.names)
        },
        "places": len(np.unique(given.readings.point)),
        "noise_px": found.system.noise,
        "sigma0": found.sigma0,
        "rejected": int(np.count_nonzero(found.rejected)),
        "rejected_rows": rejected,
    }


def points_of_lines(lines: Path, system: Path, out: Path) -> dict[str, Any]:
    """Write the points of readings, each with its whole covariance."""
    calibrated = read_line_cameras(system)
    lights, found = lights_of(read_table(lines), calibrated)
    good = np.flatnonzero(np.isfinite(found.p_world).all(axis=1))
    J = found.jacobian[good]
    covariance = (found.covariance[good] + J @ calibrated.covariance @ np.swapaxes(J, -1, -2)) * 1e6
    columns: dict[str, list[object]] = {
        "pose": [lights.keys[i][0] for i in good],
        "target": [lights.keys[i][1] for i in good],
    }
    for k, axis in enumerate("xyz"):
        columns[f"{axis}_mm"] = [f"{v:.6f}" for v in 1000.0 * found.p_world[good, k]]
    for name, i, j in (("xx", 0, 0), ("xy", 0, 1), ("xz", 0, 2), ("yy", 1, 1), ("yz", 1, 2), ("zz", 2, 2)):
        columns[f"s{name}_mm2"] = [f"{v:.9g}" for v in covariance[:, i, j]]
    columns["cameras"] = [int(found.n_cameras[i]) for i in good]
    write_table(out, columns)
    lost = [{"pose": lights.keys[i][0], "target": lights.keys[i][1], "reason": r} for i, r in found.reasons.items()]
    sigma = np.sqrt(np.trace(covariance, axis1=1, axis2=2) / 3.0)
    return {"points": len(good), "sigma_mm": float(np.sqrt(np.mean(sigma**2))), "lost": lost}
