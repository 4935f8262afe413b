"""Deviations from the robot file that a robot may have, but larger than robots are off: zeros of joints, lengths."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import optimize

from robcal.calibration.recording_errors.recorded import Recorded, RecordingFault, residual_rms, rows

Array = NDArray[np.float64]

GRID = np.radians(np.arange(-150.0, 181.0, 30.0))
SWEEPS = 4
FAR = 0.05
"""Residual (m, rad) from which on it pulls no harder: blunders do not decide."""
PROOF = 0.1
"""Several numbers are free here: the residual must fall further than by a single fault."""
NOTEWORTHY_ANGLE, NOTEWORTHY_LENGTH = np.radians(2.0), 0.02
"""Zeros (rad) and lengths (m) off the file by less than this are what identification is for."""


@dataclass(frozen=True)
class _Deviation:
    """Start values by name of parameter, the residual (m) with them, and what they say."""

    kind: str
    values: dict[str, float]
    after: float
    words: str


def deviating(recorded: Recorded, before: float, enough: float) -> list[RecordingFault]:
    """Zeros of joints, else one length of the robot file, that explain the residual; empty if neither does."""
    for look in (_zeros, _length):
        found = look(recorded)
        if found.values and found.after < min(PROOF * before, enough):
            proof = f"correcting it lowers the residual of the nominal robot from {1e3 * before:.3g} mm to "
            text = f"{found.words}: {proof}{1e3 * found.after:.3g} mm"
            where = " and ".join(name.split(".")[0] for name in found.values)
            remedy = "correct the robot file, or the joint log, unless the robot is so"
            return [RecordingFault(found.kind, where, text, remedy, before, found.after, found.values)]
    return []


def _zeros(recorded: Recorded) -> _Deviation:
    """Zeros of rotary joints that lower the residual: by steps of 30 degrees joint by joint, then of any size."""
    joints = recorded.model.joints

    def moved(values: Array) -> Recorded:
        return recorded.with_q(recorded.poses.q + values)

    def missed(values: Array) -> float:
        return residual_rms(moved(values))

    zeros = np.zeros(len(joints))
    best = missed(zeros)
    # base and tool take the zeros of joints at the ends
    unit = np.eye(len(joints))
    free = [k for k, f in enumerate(joints) if not f.prismatic and abs(missed(unit[k]) - best) > 0.01 * best]
    for _ in range(SWEEPS):
        last = best
        for k in free:
            tried = [zeros + unit[k] * step for step in GRID]
            found = [missed(v) for v in tried]
            if min(found) < 0.98 * best:
                zeros, best = tried[int(np.argmin(found))], min(found)
        if best > 0.98 * last:
            break
    zeros = _polished(moved, zeros, free)
    large = [k for k in free if abs(_wrapped(zeros[k])) > NOTEWORTHY_ANGLE]
    zeros = _polished(moved, np.where(np.isin(np.arange(len(zeros)), large), zeros, 0.0), large)
    values = {joints[k].zero_name: joints[k].zero_sign * _wrapped(zeros[k]) for k in large}
    parts = [f"{name.split('.')[0]} by {np.degrees(value):.4g} deg" for name, value in values.items()]
    words = f"the zero of the joint angles is off the robot file's: {', '.join(parts)}"
    return _Deviation("zero", values, missed(zeros), words)


def _wrapped(angle: float) -> float:
    return float((angle + np.pi) % (2.0 * np.pi) - np.pi)


def _polished(make: Callable[[Array], Recorded], start: Array, free: Sequence[int]) -> Array:
    """Values (k,) of which the free ones are fitted by robust least squares, base and tool in closed form beside."""
    out = start.copy()
    if not free:
        return out

    def residuals(values: Array) -> Array:
        out[list(free)] = values
        return rows(make(out))

    fitted = optimize.least_squares(
        residuals, start[list(free)], loss="soft_l1", f_scale=FAR, xtol=1e-5, ftol=1e-6, diff_step=1e-4, max_nfev=30
    )
    out[list(free)] = fitted.x
    return out


def _length(recorded: Recorded) -> _Deviation:
    """The one coordinate of a frame of the robot file that lowers the residual most."""
    found = []
    for at, f in enumerate(recorded.model.frames):
        for axis in range(3):

            def made(values: Array, at: int = at, axis: int = axis) -> Recorded:
                return _longer(recorded, at, axis, float(values[0]))

            value = _polished(made, np.zeros(1), [0])
            found.append((residual_rms(made(value)), f.name, axis, float(value[0]), f.xyz[axis]))
    after, name, axis, deviation, stated = min(found)
    measured, written = 1e3 * (stated + deviation), 1e3 * stated
    words = f"{'xyz'[axis]} of {name} is {measured:.1f} mm by the measurements, {written:.1f} mm in the robot file"
    values = {f"{name}.{'xyz'[axis]}": deviation} if abs(deviation) > NOTEWORTHY_LENGTH else {}
    return _Deviation("length", values, after, words)


def _longer(recorded: Recorded, at: int, axis: int, value: float) -> Recorded:
    frames = list(recorded.model.frames)
    xyz = list(frames[at].xyz)
    xyz[axis] += value
    frames[at] = replace(frames[at], xyz=(xyz[0], xyz[1], xyz[2]))
    return recorded.with_frames(frames)
