"""A board that was pushed while a hand-eye calibration was recorded."""

import numpy as np

from robcal.cause import Kind
from robcal.handeye.result import Moved
from robcal.photogrammetry.station.contradictions import CAMERA_MOVED
from robcal.transforms import Array

BOARD_MOVED = Kind(
    "board_moved", "body", "board that moved", "Board {where} moved before pose {pose}", moves="target", of_order=True
)
SCALE = np.array([1e3] * 3 + [180.0 / np.pi] * 3)


def moved_content(moved: Moved, board: str, camera: str, pose: str) -> dict[str, object]:
    """The entry of diagnosis.json for a board, or a camera, that moved before the named pose.

    Shift and turn in the coordinates of what moved, mm and deg.
    """
    kind, where = (BOARD_MOVED, board) if moved.kind == "board" else (CAMERA_MOVED, camera)
    change, sigma = moved.change * SCALE, np.sqrt(np.diag(moved.covariance)) * SCALE
    shift, turn = np.linalg.norm(change[:3]), np.linalg.norm(change[3:])
    text = kind.describe(where, {"pose": pose})
    return {
        "cause": kind.name,
        "stage": kind.stage,
        "where": where,
        "direction": None,
        "parameters": {"pose": pose, "shift_mm": _listed(change[:3]), "turn_deg": _listed(change[3:])},
        "sigma": {"shift_mm": _listed(sigma[:3]), "turn_deg": _listed(sigma[3:])},
        "p_value": 0.0,
        "indistinguishable_from": [],
        "statement": f"{text}, by {shift:.3g} mm and {turn:.2g} degrees; the images on both sides are used",
    }


def _listed(values: Array) -> list[float]:
    return [float(v) for v in values]
