"""Start values of closed loops: the tip as stated or from a point that it was held at, worlds from the tips."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from robcal.calibration.closed_loops import loop_world
from robcal.calibration.instruments.cell_frame import FIXED, FREE, LOCKED, CellFrame
from robcal.transforms import Array, transform, xyzrpy_from_frame


def start_of_loops(loops: Sequence[tuple[str, Array]], tool: CellFrame) -> tuple[CellFrame, list[Array]]:
    """The tool with start values, and ``world_T_base`` (4, 4) of every loop.

    Parameters
    ----------
    loops : kind and nominal flange frames (n, 4, 4) of each. tool : what is known of it.

    Raises
    ------
    DegenerateGeometry : tips on a plane that lie in one line.
    """
    given = np.array(tool.given)
    if not np.isfinite(given[:3]).all():
        points = [flange for kind, flange in loops if kind == "point" and len(flange) >= 3]
        given[:3] = _pivot(max(points, key=len)) if points else 0.0
        given[3:] = np.where(np.isfinite(given[3:]), given[3:], 0.0)
        tool = replace(tool, given=tuple(given.tolist()))
    return tool, [loop_world(kind, transform(flange, given[:3])) for kind, flange in loops]


def loop_frame(name: str, kind: str, world_T_base: Array) -> CellFrame:
    """World of a loop at its start value; what no loop tells of it is held: turns, and places within a plane."""
    given = xyzrpy_from_frame(world_T_base)
    sigma = (FREE, FREE, FREE, FIXED, FIXED, FIXED)
    if kind == "plane":
        sigma = (FIXED, FIXED, FREE, FREE, FREE, FIXED)
        if abs(np.cos(given[4])) < 2.0 * LOCKED:  # no single angle can be held there
            sigma = (FREE,) * 6
    return CellFrame(name, "base", tuple(given.tolist()), sigma)


def _pivot(flange: Array) -> Array:
    """Tip (3,) on the flange that stands still at frames (n, 4, 4): ``R x + t = c`` by linear least squares."""
    n = len(flange)
    A = np.concatenate([flange[:, :3, :3], np.broadcast_to(-np.eye(3), (n, 3, 3))], axis=2).reshape(-1, 6)
    return np.asarray(np.linalg.lstsq(A, -flange[:, :3, 3].ravel(), rcond=1e-6)[0][:3])
