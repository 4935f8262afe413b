"""Flange frames as a controller states them, in place of a robot file and joint angles."""

from pathlib import Path

import numpy as np

from robcal.errors import InvalidInput
from robcal.files.measurement_tables import read_measurements
from robcal.files.poses_table import Poses
from robcal.files.tables import read_table
from robcal.transforms import Array


def read_flange_poses(path: Path) -> tuple[Poses, Array]:
    """Read ``pose, x_mm ... yaw_deg`` of the flange in base coordinates and optional ``set``: poses and (n, 4, 4).

    Raises
    ------
    InvalidInput : missing columns, a pose twice, impossible numbers.
    """
    table = read_table(path)
    table.require(["pose"])
    names = table.texts("pose")
    table.unique(["pose"])
    measured = read_measurements(path, names, "frames")
    kept = [names[i] for i in measured.pose]
    n = len(kept)
    verify = np.zeros(n, dtype=bool)
    if "set" in table.columns:
        cells = table.columns["set"]
        for i, cell in enumerate(cells):
            if cell not in ("identify", "verify"):
                raise table.error(i, f"set is '{cell[:40]}', it must be 'identify' or 'verify'")
        verify = np.array([cells[i] == "verify" for i in measured.pose])
    if not n:
        raise InvalidInput(f"{path}: lists no poses: one row per pose is needed")
    none = np.zeros((n, 0))
    poses = Poses(tuple(kept), none, (None,) * n, verify, none, path=path, rows=measured.rows)
    return poses, measured.values
