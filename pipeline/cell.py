"""Commands of the cell: tables of touches in, frames and points with their covariance out."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.runs import open_run
from pipeline.stages.identify import load_calibrated
from robcal.calibration.measurements import ASSUMED_SIGMA
from robcal.cell.adjustment import Adjusted
from robcal.cell.carried import FLANGE, CarriedFrames, carried_frames
from robcal.cell.frames import (
    CORNERS,
    CellFrame,
    base_from_frames,
    object_from_corners,
    object_from_points,
    pivot,
    tool_from_touches,
)
from robcal.cell.points import measure_points
from robcal.errors import DegenerateGeometry, InvalidInput, NotIdentifiable
from robcal.files.cell_files import (
    Touches,
    cell_data,
    read_nominal,
    read_placed,
    read_touches,
    shift_words,
    write_cell,
    write_touched_points,
)
from robcal.files.frame_tables import SIX
from robcal.files.measurement_tables import read_measurements
from robcal.files.poses_table import read_poses
from robcal.files.tables import read_table
from robcal.transforms import Array

TOOL_POINTS = ("tip", "x", "xy")


def cell_tcp(run: Path, touches: Path, out: Path, touch_mm: float | None = None) -> dict[str, Any]:
    """Tool from touches of one fixed tip; with the points tip, x and xy its orientation as well.

    Raises
    ------
    InvalidInput : a bad table, or touches that leave the tool open; the message says what is missing.
    """
    robot = load_calibrated(open_run(run))
    table = read_touches(touches, robot)
    points = table.points
    if len(set(points)) == 1:
        points = ("tip",) * len(points)
    _check_names(touches, points, TOOL_POINTS, "the fixed tip is touched by the tool's tip, a point x of its x axis")
    if "tip" not in points:
        raise InvalidInput(f"{touches}: the point 'tip' was not touched: touch the fixed tip with the tool's own tip")
    flange = carried_frames(robot, robot.inputs(table.log), FLANGE)
    found = _with_path(touches, lambda: tool_from_touches(flange, points, _metres(touch_mm)))
    return _frame_answer("flange_T_tool", found, table.points, out, _notes(table, found))


def cell_object(
    run: Path, touches: Path, out: Path, nominal: Path | None, tool: Path | None, touch_mm: float | None = None
) -> dict[str, Any]:
    """Object frame from its points origin, x and xy, or from named points with nominal coordinates.

    Raises
    ------
    InvalidInput : a bad table, touches that leave a motion of the object open, or that speak of another tool.
    """
    table, tip = _touching(run, touches, tool)
    sigma = _metres(touch_mm)
    if nominal is None:
        _check_names(touches, table.points, CORNERS, "without --nominal the frame is spanned by these")
        found = _with_path(touches, lambda: object_from_corners(tip, table.points, sigma))
    else:
        xyz, held = read_nominal(nominal, table, touches)
        found = _with_path(touches, lambda: object_from_points(tip, xyz, held, sigma))
    _check_tool(touches, tool, found.adjusted)
    return _frame_answer("base_T_object", found, table.points, out, _notes(table, found))


def cell_measure(run: Path, touches: Path, out: Path, tool: Path | None, touch_mm: float | None) -> dict[str, Any]:
    """Touched points in base coordinates.

    Raises
    ------
    InvalidInput : a bad table, or repeated touches that speak of another tool.
    """
    table, tip = _touching(run, touches, tool)
    found = measure_points(tip, table.points, _metres(touch_mm))
    if found.together is not None:
        _check_tool(touches, tool, found.together)
    write_touched_points(out, found)
    warnings = [table.outside] if table.outside else []
    if touch_mm is None and not found.estimated:
        warnings.append(f"{touches}: no point was touched twice: the noise of a touch is taken as 0.1 mm (--touch-mm)")
    worst = float(np.sqrt(np.max(np.trace(found.covariance, axis1=1, axis2=2))))
    return {
        "points": len(found.names),
        "out": str(out),
        "touch_mm": found.touch_sigma * 1e3,
        "sigma_max_mm": worst * 1e3,
        "warnings": warnings,
    }


def cell_base(run: Path, pairs: Path, out: Path | None, tool: Path | None) -> dict[str, Any]:
    """Base in the measuring system from tool frames that are known in it.

    Raises
    ------
    InvalidInput : a bad table, or frames that speak of another tool.
    """
    table, carried = _touching(run, pairs, tool, needs_points=False)
    world_T_tool, covariance, stated = _frames_of(pairs, table.log.names)
    found, _ = base_from_frames(carried, world_T_tool, covariance, stated)
    _check_tool(pairs, tool, found.adjusted)
    notes = _notes(table, found)
    return _frame_answer("world_T_base", found, table.log.names, out, notes)


def cell_probe(frames: Path, out: Path, touch_mm: float | None = None) -> dict[str, Any]:
    """Tip of a probe held by hand from frames measured while it pivots about a fixed point.

    Raises
    ------
    InvalidInput : a bad table, or a pivot that leaves the tip open.
    """
    names = read_table(frames).texts("pose") if read_table(frames).has("pose") else ()
    measured, covariance, stated = _frames_of(frames, names)
    found = _with_path(frames, lambda: pivot(measured, covariance if stated else None, _metres(touch_mm)))
    return _frame_answer("flange_T_tool", found, ("tip",) * len(measured), out, [])


def _touching(run: Path, touches: Path, tool: Path | None, needs_points: bool = True) -> tuple[Touches, CarriedFrames]:
    robot = load_calibrated(open_run(run))
    if needs_points:
        table = read_touches(touches, robot)
    else:
        log = read_poses(touches, robot.model, robot.model.payloads, to_predict=True)
        table = Touches(log, log.names, log.outside)
    placed = None if tool is None else read_placed(tool, "flange_T_tool")
    return table, carried_frames(robot, robot.inputs(table.log), placed)


def _frames_of(path: Path, names: Sequence[str]) -> tuple[Array, Array, bool]:
    """Frames (n, 4, 4) of a table in the order of the poses, their covariance (n, 6, 6), and whether it is stated."""
    table = read_table(path)
    table.require(["pose", *(f"{n}_mm" for n in SIX[:3]), *(f"{n}_deg" for n in SIX[3:])])
    measured = read_measurements(path, names)
    if len(measured) != len(names):
        raise InvalidInput(f"{path}: {len(names) - len(measured)} rows hold no frame: remove them")
    order = np.argsort(measured.pose, kind="stable")
    if measured.covariance is None:
        return measured.values[order], np.broadcast_to(ASSUMED_SIGMA**2 * np.eye(6), (len(order), 6, 6)), False
    return measured.values[order], measured.covariance[order], True


def _check_names(path: Path, points: Sequence[str], known: Sequence[str], why: str) -> None:
    wrong = next((i for i, name in enumerate(points) if name not in known), None)
    if wrong is not None:
        row = int(read_table(path).rows[wrong])
        raise InvalidInput(f"{path}, row {row}: point '{points[wrong]}' is none of {', '.join(known)}: {why}")


def _check_tool(path: Path, tool: Path | None, adjusted: Adjusted) -> None:
    """Refuse touches that only a tool in another place explains."""
    if adjusted.shift is None or adjusted.shift_sigma is None:
        return
    name = "the tool of the run" if tool is None else f"the tool of {tool}"
    raise InvalidInput(
        f"{path}: {name} is not the one on the flange: the readings fit only if it is shifted by "
        f"{shift_words(adjusted.shift, adjusted.shift_sigma)} mm in its own axes: run 'pipeline cell tcp' for the tool "
        "that is there and name it with --tool"
    )


def _with_path(path: Path, work: Callable[[], CellFrame]) -> CellFrame:
    """Do the work; what geometry or numbers lack is said with the file's name."""
    try:
        return work()
    except (DegenerateGeometry, NotIdentifiable) as error:
        raise DegenerateGeometry(f"{path}: {error}") from None
    except InvalidInput as error:
        raise InvalidInput(f"{path}: {error}") from None


def _notes(table: Touches, found: CellFrame) -> list[str]:
    notes = [table.outside] if table.outside else []
    if found.adjusted.redundancy < 3 and not np.isfinite(found.adjusted.freedom):
        notes.append("no touch more than needed: their noise is as stated, or taken as 0.1 mm, and cannot be checked")
    return notes


def _frame_answer(
    key: str, found: CellFrame, points: Sequence[str], out: Path | None, notes: Sequence[str]
) -> dict[str, Any]:
    data = cell_data(key, found, points, notes)
    if out is not None:
        write_cell(out, data)
    return {**data, "out": None if out is None else str(out), "warnings": list(notes)}


def _metres(millimetres: float | None) -> float | None:
    return None if millimetres is None else millimetres / 1e3
