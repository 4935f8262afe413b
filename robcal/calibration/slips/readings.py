"""Readings that are none: rows of zeros or of a sentinel, readings that stand still while the robot moves."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

SENTINELS = (-1.0, 99.0, 999.0, 9999.0, 99999.0, 999999.0, 1e6, 1e9, 1e10, 1e38)
"""What programs write where they measured nothing, beside zero; of either sign."""
STILL = 1e-9
"""A reading (m, rad) that differs by less than this from the one before is the same one."""
MOVED = 2e-3
"""Way of the tool (m) from one pose to the next that no measurement can miss."""


def empty_readings(numbers: Array) -> Mask:
    """Rows (m,) of which all coordinates (m, d) in the unit of the file are zero, or all the same sentinel.

    With one column (distances) only zero and sentinels of four digits and more count.
    """
    rows = np.asarray(numbers, dtype=float)
    same = np.all(rows == rows[:, :1], axis=1)
    size = np.abs(rows[:, 0])
    known = np.isin(size, [s for s in SENTINELS if rows.shape[1] > 1 or s > 9998])
    return np.asarray(same & ((size == 0) | known))


def frozen_readings(pose: NDArray[np.int64], readings: Array, places: Array) -> Mask:
    """Rows (m,) that repeat the reading of the row before while the robot moved on.

    Parameters
    ----------
    pose : (m,) row of the pose of each reading; readings : (m, d) as measured, of one target.
    places : (n, 3) where the nominal robot's flange is at the poses, m.
    """
    frozen = np.zeros(len(pose), dtype=bool)
    if len(pose) < 2:
        return frozen
    order = np.argsort(pose, kind="stable")
    still = np.max(np.abs(np.diff(readings[order], axis=0)), axis=1) <= STILL
    way = np.linalg.norm(np.diff(places[pose[order]], axis=0), axis=1)
    frozen[order[1:]] = still & (way > MOVED)
    return frozen
