"""Rows of the joint log and of the measurements that do not belong together: shifted, exchanged."""

from collections.abc import Callable, Iterator
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from robcal.calibration.observations import FrameObservations
from robcal.calibration.recording_errors.recorded import Recorded, Trial, best_cell, residuals_in
from robcal.errors import RobcalError
from robcal.transforms import difference

Array = NDArray[np.float64]
Ints = NDArray[np.int_]

SHIFTS = (1, -1, 2, -2, 3, -3)
TOGETHER = "bring poses and measurements together again"
FAR, LEAST_FAR = 10.0, 5e-3
"""A pose is far if the robot misses it by this factor more than the middle pose, and by this much (m) at least."""
MOST_FAR = 12
"""Far rows among which exchanged ones are looked for."""


def row_trials(recorded: Recorded) -> Iterator[Trial]:
    """The joint log slipped as a whole, from a row on, or two of its rows exchanged."""
    n = len(recorded.poses)
    for shift in SHIFTS:
        when = "late" if shift > 0 else "early"
        words = f"the joint log is slipped by {abs(shift)} row(s) against the measurements ({when})"
        yield Trial("slipped_rows", "all rows", words, TOGETHER, _slip(0, n, shift), robust=False)
    for start in _breaks(recorded):
        for shift in (1, -1):
            when = "late" if shift > 0 else "early"
            words = f"from row {start + 1} on the joint log is slipped by one row against the measurements ({when})"
            where = f"from row {start + 1}"
            yield Trial("slipped_rows", where, words, TOGETHER, _slip(start, n, shift), robust=False)


def _slip(start: int, stop: int, shift: int) -> Callable[[Recorded], Recorded]:
    """Measurement i of the rows from start on belongs to the joint angles of row i + shift; rows without are left."""
    rows = np.arange(stop)
    source = np.where(rows >= start, rows + shift, rows)
    good = (source >= 0) & (source < stop)
    return lambda r: r.paired(source[good], rows[good])


def _breaks(recorded: Recorded) -> list[int]:
    """Row from which the measurements leave a robot fitted to the first third of the rows."""
    n = len(recorded.poses)
    if n < 30:
        return []
    head = np.arange(max(12, n // 3))
    try:
        residuals = residuals_in(recorded, *best_cell(recorded.subset(head)))
    except RobcalError:
        return []
    far = residuals > FAR * float(np.nanmedian(residuals[head])) + 1e-3
    # the first row after which most rows are far
    for k in range(len(head) // 2, n - 3):
        if far[k] and far[k:].mean() > 0.8:
            return [k]
    return []


def stray_rows(recorded: Recorded) -> Iterator[Trial]:
    """Some rows of the joint log that belong to the measurements of others: exchanged in pairs, or shifted by one.

    Needs measured frames: those of the far rows are set against the robot at the angles of the others.
    """
    frames = [o for o in recorded.observations if isinstance(o, FrameObservations)]
    if len(frames) != 1 or len(recorded.observations) != 1:
        return
    W, F = best_cell(recorded)
    residuals = residuals_in(recorded, W, F)
    limit = max(LEAST_FAR, FAR * float(np.nanmedian(residuals)))
    far = np.flatnonzero(np.nan_to_num(residuals) > limit)
    if not 2 <= len(far) <= max(MOST_FAR, len(residuals) // 4):
        return
    T = W @ recorded.base_T_flange @ F
    measured = np.full((len(T), 4, 4), np.nan)
    measured[frames[0].pose] = frames[0].world_T_tool
    near = np.sqrt(np.mean(difference(T[far][None], measured[far][:, None]) ** 2, axis=2)) < limit
    source = np.arange(len(T))
    for i, k in combinations(range(len(far)), 2):
        if near[i, k] and near[k, i]:
            source[[far[i], far[k]]] = far[k], far[i]
    if np.any(source != np.arange(len(T))):
        pairs = [f"{i + 1} and {source[i] + 1}" for i in far if i < source[i]]
        words = f"the joint angles of rows {', of '.join(pairs)} are exchanged"
        yield Trial(
            "exchanged_rows", f"rows {', '.join(pairs)}", words, "exchange these rows", _sorted_by(source), False
        )
    for shift in (1, -1):
        there = far + shift
        inside = (there >= 0) & (there < len(T))
        apart = np.sqrt(np.mean(difference(T[there[inside]], measured[far[inside]]) ** 2, axis=1))
        if len(apart) >= 3 and np.mean(apart < limit) > 0.7:
            rows = f"rows {far[0] + 1} to {far[-1] + 1}"
            words = f"in {rows} the joint log is slipped by one row against the measurements"
            belong = inside.copy()
            belong[inside] = apart < limit
            kept = np.setdiff1d(np.arange(len(T)), far[~belong])
            source = np.arange(len(T))
            source[far[belong]] = there[belong]
            yield Trial("slipped_rows", rows, words, TOGETHER, _paired(source[kept], kept), False)


def _sorted_by(source: Ints) -> Callable[[Recorded], Recorded]:
    return lambda r: r.with_q(r.poses.q[source])


def _paired(log: Ints, measured: Ints) -> Callable[[Recorded], Recorded]:
    return lambda r: r.paired(log, measured)
