"""Tool, object and base frames from touches and matched frames."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from robcal.calibration.observations import FrameObservations
from robcal.cell.adjustment import ASSUMED_TOUCH, Adjusted, Equations, adjust
from robcal.cell.carried import CarriedFrames, PlacedFrame, measured_frames
from robcal.errors import DegenerateGeometry, InvalidInput, NotIdentifiable
from robcal.transforms import (
    Array,
    adjoint,
    difference,
    fit_frame,
    frame,
    gram_schmidt_frame,
    invert,
    retract,
    skew,
    transform,
)

PARALLEL = 0.02
"""Orientations that spread by less than this (rad, root mean square) count as parallel."""
FLAT = 0.01
"""Points whose spread across is less than this share of the whole count as lying in a line."""
CORNERS = ("origin", "x", "xy")
"""Names of the points that span a frame: its origin, a point on its x axis, one in its x-y plane with y > 0."""
Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class CellFrame:
    """A frame of the cell and how it was found.

    Attributes
    ----------
    placed : the frame with its covariance.
    of_touches : (6, 6) part of the covariance that comes from the touches' own noise.
    held : coordinates that could not be measured and are zero, by name.
    adjusted : of the adjustment; residuals : (n,) length of the misclosure of each touch, m.
    place : (3,) the fixed tip in base coordinates (tools only).
    """

    placed: PlacedFrame
    of_touches: Array = field(repr=False)
    held: tuple[str, ...]
    adjusted: Adjusted = field(repr=False)
    residuals: Array
    place: Array | None = None


def tool_from_touches(flange: CarriedFrames, points: Sequence[str], touch_sigma: float | None = None) -> CellFrame:
    """``flange_T_tool`` from one fixed tip at an unknown place, touched in several orientations.

    Parameters
    ----------
    flange : frames of the flange (of a probe held by hand: measured frames of its targets), in one fixed system.
    points : which point of the tool is at the fixed tip: ``tip`` (its origin), ``x`` (a point on its x axis, x > 0),
        ``xy`` (a point in its x-y plane, y > 0). With ``tip`` alone the orientation stays that of the flange.

    Raises
    ------
    DegenerateGeometry : parallel orientations, or tip, x and xy in a line. NotIdentifiable : too few touches.
    """
    at = np.array([CORNERS.index("origin" if name == "tip" else name) for name in points])
    oriented = bool(np.any(at > 0))
    tips = np.flatnonzero(at == 0)
    _check_orientations(flange.T[tips, :3, :3])
    # R_i t + x_i = p
    design = np.concatenate([flange.T[tips, :3, :3], np.broadcast_to(-np.eye(3), (len(tips), 3, 3))], axis=2)
    t, p = np.split(np.linalg.lstsq(design.reshape(-1, 6), -flange.T[tips, :3, 3].ravel(), rcond=None)[0], 2)
    tool = frame(np.eye(3), t)
    if oriented:
        seen = transform(invert(flange.T), p)
        tool = _spanned([t, *(_mean(seen, at == k, CORNERS[k]) for k in (1, 2))], "tip, x and xy")
    used = _corner_rows(at)
    free = np.arange(6 if oriented else 3)

    def linearise(state: tuple[Array, Array]) -> Equations:
        tool, p = state
        u = transform(invert(flange.T), p)
        z = transform(invert(tool), u)
        R = tool[:3, :3].T
        by_tool = np.concatenate([np.broadcast_to(-np.eye(3), (len(z), 3, 3)), skew(z)], axis=2)[:, :, free]
        by_place = R @ np.swapaxes(flange.T[:, :3, :3], 1, 2)
        by_flange = R @ np.concatenate([np.broadcast_to(-np.eye(3), (len(z), 3, 3)), skew(u)], axis=2)
        return _chosen(z, np.concatenate([by_tool, by_place], axis=2), by_flange, used)

    def moved(state: tuple[Array, Array], step: Array) -> tuple[Array, Array]:
        twist = np.zeros(6)
        twist[free] = step[: len(free)]
        return retract(state[0], twist), state[1] + step[len(free) :]

    (tool, p), adjusted = adjust(linearise, moved, (tool, p), flange, touch_sigma)
    return _result(tool, adjusted, flange, free, place=p)


def object_from_corners(tip: CarriedFrames, points: Sequence[str], touch_sigma: float | None = None) -> CellFrame:
    """``base_T_object`` from touches of its points ``origin``, ``x`` and ``xy``, each once or more.

    Raises
    ------
    DegenerateGeometry : the three lie in a line. InvalidInput : one of them was not touched.
    """
    at = np.array([CORNERS.index(name) for name in points])
    places = tip.T[:, :3, 3]
    start = _spanned([_mean(places, at == k, CORNERS[k]) for k in range(3)], "origin, x and xy")
    return _object(tip, np.zeros((len(at), 3)), _corner_rows(at), start, touch_sigma)


def object_from_points(tip: CarriedFrames, nominal: Array, held: Mask, touch_sigma: float | None = None) -> CellFrame:
    """``base_T_object`` that best fits touches to nominal coordinates.

    Parameters
    ----------
    nominal : (n, 3) coordinates in the object of the point that each touch is of, m.
    held : (n, 3) which of them the touch has to meet: all for a best fit, three of z, two of y and one of x for an
        alignment by the rule 3-2-1.

    Raises
    ------
    DegenerateGeometry : what is held leaves a motion of the object open; the message names it.
    """
    if len(np.unique(nominal, axis=0)) < 3:
        raise DegenerateGeometry("fewer than three different points of the object were touched: three are needed")
    try:
        start = fit_frame(tip.T[:, :3, 3], nominal)
    except DegenerateGeometry:
        raise DegenerateGeometry(
            "all touched points lie in one line: nothing holds the object's turn about it: touch a point beside it"
        ) from None
    return _object(tip, nominal, held, start, touch_sigma)


def _object(tip: CarriedFrames, nominal: Array, held: Mask, start: Array, touch_sigma: float | None) -> CellFrame:
    def linearise(frame_: Array) -> Equations:
        z = transform(invert(frame_), tip.T[:, :3, 3])
        A = np.concatenate([np.broadcast_to(-np.eye(3), (len(z), 3, 3)), skew(z)], axis=2)
        by_tip = np.zeros((len(z), 3, 6))
        by_tip[:, :, :3] = frame_[:3, :3].T @ tip.T[:, :3, :3]
        return _chosen(z - nominal, A, by_tip, held)

    _check_motions(linearise(start).A, transform(invert(start), tip.T[:, :3, 3]))
    found, adjusted = adjust(linearise, retract, start, tip, touch_sigma)
    return _result(found, adjusted, tip, np.arange(6))


def base_from_frames(
    tool: CarriedFrames, world_T_tool: Array, covariance: Array, stated: bool
) -> tuple[CellFrame, Array]:
    """``world_T_base`` from tool frames (n, 4, 4) known in the measuring system, and the misses (n, 6) as twists.

    Parameters
    ----------
    covariance : (n, 6, 6) of the measured frames' right twist; unless ``stated``, their sizes are estimated.
    """
    n = len(tool)
    observed = FrameObservations(np.arange(n), world_T_tool, covariance)
    unit = np.zeros((6 * n, 6 * n))
    for i in range(n):
        unit[6 * i : 6 * i + 6, 6 * i : 6 * i + 6] = covariance[i] / ASSUMED_TOUCH**2
    rows = np.repeat(np.arange(n), 6)
    moves = adjoint(invert(tool.T))

    def linearise(base: Array) -> Equations:
        r, B = observed.evaluate(base @ tool.T)
        return Equations(-r.ravel(), (B @ moves).reshape(-1, 6), B.reshape(-1, 6), rows, unit)

    start = world_T_tool[0] @ invert(tool.T[0])
    found, adjusted = adjust(linearise, retract, start, tool, ASSUMED_TOUCH if stated else None)
    misses = difference(found @ tool.T, world_T_tool)
    placed = PlacedFrame(found, adjusted.covariance, tool.names, adjusted.with_robot)
    result = CellFrame(placed, adjusted.of_touches, (), adjusted, np.linalg.norm(misses[:, :3], axis=1))
    return result, misses


def pivot(frames: Array, covariance: Array | None, touch_sigma: float | None = None) -> CellFrame:
    """The tip of a probe held by hand, in the frame of its own targets, from frames measured while it pivots."""
    return tool_from_touches(measured_frames(frames, covariance), ["tip"] * len(frames), touch_sigma)


def _result(
    T: Array, adjusted: Adjusted, carried: CarriedFrames, free: NDArray[np.int64], place: Array | None = None
) -> CellFrame:
    at = np.ix_(free, free)
    covariance, of_touches = np.zeros((6, 6)), np.zeros((6, 6))
    covariance[at], of_touches[at] = adjusted.covariance[at], adjusted.of_touches[at]
    shared = np.zeros((6, len(carried.names)))
    shared[free] = adjusted.with_robot[free]
    known = [i for i, name in enumerate(carried.names) if not name.startswith("carried tool.")]
    placed = PlacedFrame(T, covariance, tuple(carried.names[i] for i in known), shared[:, known])
    held = () if len(free) == 6 else ("roll", "pitch", "yaw")
    return CellFrame(placed, of_touches, held, adjusted, adjusted.touch_residuals(len(carried)), place)


def _corner_rows(at: NDArray[np.int64]) -> Mask:
    """Coordinates (n, 3) that vanish at an origin (all), on the x axis (y, z) and in the x-y plane (z)."""
    return np.array([[True] * 3, [False, True, True], [False, False, True]])[at]


def _chosen(f: Array, A: Array, B: Array, used: Mask) -> Equations:
    touch = np.broadcast_to(np.arange(len(f))[:, None], used.shape)[used]
    return Equations(f[used], A[used], B[used], touch.astype(np.int64))


def _mean(places: Array, rows: Mask, name: str) -> Array:
    if not np.any(rows):
        raise InvalidInput(f"point '{name}' was not touched: it takes all of {', '.join(CORNERS)}")
    return places[rows].mean(axis=0)


def _spanned(corners: Sequence[Array], words: str) -> Array:
    p = np.array(corners)
    u, v = p[1] - p[0], p[2] - p[0]
    if np.linalg.norm(np.cross(u, v)) < FLAT * np.linalg.norm(u) * np.linalg.norm(v) or not (np.any(u) and np.any(v)):
        raise DegenerateGeometry(f"{words} lie in one line: touch an xy that is well beside the x axis")
    return gram_schmidt_frame(p)


def _check_orientations(R: Array) -> None:
    """Refuse orientations (n, 3, 3) that leave a direction of the tip open.

    The tip moves by ``(R_i - mean R) t``: what all orientations leave alike is not seen.
    """
    if len(R) < 3:
        raise NotIdentifiable(
            f"the fixed tip was touched {len(R)} times: it takes three or more, turned about two different axes"
        )
    spread = (R - R.mean(axis=0)).reshape(-1, 3)
    values, vectors = np.linalg.eigh(spread.T @ spread / len(R))
    open_ = np.sqrt(np.clip(values, 0, None)) < PARALLEL
    if open_[1]:
        raise DegenerateGeometry(
            "all touches have parallel orientations, which leave the tip's place open: turn the tool by 30 deg or more "
            "about two different axes"
        )
    if open_[0]:
        line = ", ".join(f"{v:.2f}" for v in vectors[:, 0] * np.sign(vectors[np.argmax(np.abs(vectors[:, 0])), 0]))
        raise DegenerateGeometry(
            f"all touches are turned about one line, [{line}] of the flange, along which the tip's place stays open: "
            "add touches turned by 30 deg or more about another axis"
        )


def _check_motions(A: Array, z: Array) -> None:
    """Refuse equations (m, 6) that leave a motion of the object open; ``z`` (n, 3) touched places in the object."""
    centre = z.mean(axis=0)
    lever = float(np.sqrt(np.mean(np.sum((z - centre) ** 2, axis=1)))) or 1.0
    # a turn about the middle of the points, in units in which it moves them as far as a shift does
    about = A.copy()
    about[:, 3:] = (A[:, 3:] - A[:, :3] @ skew(centre)) / lever
    _, values, vectors = np.linalg.svd(about)
    smallest = values[5] if len(values) > 5 else 0.0
    if smallest >= FLAT * np.sqrt(len(A)):
        return
    shift, turn = vectors[5, :3], vectors[5, 3:]
    part, words = (turn, "turn about") if np.linalg.norm(turn) > 0.5 else (shift, "shift along")
    part = part / np.linalg.norm(part) * np.sign(part[np.argmax(np.abs(part))])
    direction = ", ".join(f"{v:.2f}" for v in part)
    raise DegenerateGeometry(
        f"nothing holds the object's {words} [{direction}] of its own axes: touch (or hold) a point that moves with it"
    )
