"""What a fault is looked for in, and by how much the nominal robot misses it.

Readings that are none: rows of zeros or of a sentinel, readings that stand still while the robot moves.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from robcal import transforms as tf
from robcal.calibration.identification import start_state
from robcal.calibration.observations import FrameObservations, Observations, PointObservations, Stack
from robcal.calibration.problem import Evaluator
from robcal.calibration.start_values import candidates
from robcal.errors import DegenerateGeometry, NotIdentifiable, RobcalError
from robcal.robot.hexapod import nominal_frames
from robcal.robot.kernel import Kernel, PoseInputs
from robcal.robot.model import Frame, RobotModel

Array = NDArray[np.float64]
Ints = NDArray[np.int_]

CLOSEST = 0.8
"""Share of the poses, those nearest, that a residual is taken over: blunders are no fault of the whole."""


@dataclass(frozen=True)
class Recorded:
    """A robot file, a joint log and what was measured: together, since each of them may hold the fault.

    Attributes
    ----------
    base_T_flange : (n, 4, 4) flange of the nominal robot at the poses.
    kernel : of the model, where no frames are measured that give base and tool in closed form.
    """

    model: RobotModel
    poses: PoseInputs
    base_T_flange: Array
    observations: tuple[Observations, ...]
    kernel: Kernel | None = None

    @classmethod
    def of(cls, model: RobotModel, poses: PoseInputs, observations: Sequence[Observations]) -> "Recorded":
        """With the nominal robot at the poses."""
        closed = any(isinstance(o, FrameObservations) for o in observations)
        kernel = None if closed else Kernel(model.nominal())
        return cls(model, poses, nominal_frames(model, poses.q, strict=False), tuple(observations), kernel)

    def with_q(self, q: Array) -> "Recorded":
        """The same with other joint angles (n, N)."""
        return replace(self, poses=self.poses.with_q(q), base_T_flange=nominal_frames(self.model, q, strict=False))

    def with_frames(self, frames: Sequence[Frame]) -> "Recorded":
        """The same with another chain in the robot file."""
        model = replace(self.model, frames=tuple(frames), parameters={}, terms=())
        return Recorded.of(model, self.poses, self.observations)

    def paired(self, log: Ints, measured: Ints) -> "Recorded":
        """Measurement ``measured[i]`` beside the joint angles of row ``log[i]``."""
        observations = tuple(o.subset(measured) for o in self.observations)
        poses, flange = self.poses.subset(log), self.base_T_flange[log]
        return replace(self, poses=poses, base_T_flange=flange, observations=observations)

    def subset(self, rows: Ints) -> "Recorded":
        """The given poses."""
        return self.paired(rows, rows)

    def change(self, correct: Callable[[Observations], Observations]) -> "Recorded":
        """The same with other measurements."""
        return replace(self, observations=tuple(correct(o) for o in self.observations))


@dataclass(frozen=True)
class RecordingFault:
    """A fault with its proof.

    Attributes
    ----------
    kind : 'wrong_sign', 'wrong_unit', 'exchanged_columns', 'coupled_joints', 'slipped_rows', 'exchanged_rows' or 'zero'
        of the joint log; 'measured_columns', 'measured_unit', 'orientation' or 'inverted_frames' of the measurements;
        'axis', 'length' of the robot file.
    where : what it concerns ('axis2', 'axis1 and axis3', 'from row 17', 'all joints', 'measurements').
    statement : one sentence with the proof; remedy : what to do about it.
    rms_before, rms_after : residual of the nominal robot with the best base and tool, m (angles by a lever of 1 m).
    values : by name of the robot's parameter, its start value where the fault is a legitimate deviation from the file.
    """

    kind: str
    where: str
    statement: str
    remedy: str
    rms_before: float
    rms_after: float
    values: dict[str, float]

    @property
    def legitimate(self) -> bool:
        """A robot may differ from its file in this: it is told, and identified."""
        return self.kind in ("zero", "length")


@dataclass(frozen=True)
class Trial:
    """An alternative reading of a recording; ``robust``: the worst poses do not count."""

    kind: str
    where: str
    words: str
    remedy: str
    correct: Callable[[Recorded], Recorded]
    robust: bool = True


def as_frames(observations: Sequence[Observations]) -> tuple[Observations, ...]:
    """Points of three or more targets a pose as frames: their base and tool follow in closed form."""
    out: list[Observations] = []
    for o in observations:
        if not isinstance(o, PointObservations):
            out.append(o)
            continue
        pose: list[int] = []
        frames: list[Array] = []
        for k in np.flatnonzero(np.bincount(o.pose) >= 3) if len(o.pose) else ():
            rows = o.pose == k
            try:
                frames.append(tf.fit_frame(o.p_world[rows], o.p_tool[rows]))
            except DegenerateGeometry:
                continue
            pose.append(int(k))
        if len(pose) < 0.5 * len(np.unique(o.pose)):
            out.append(o)
        else:
            out.append(FrameObservations.isotropic(np.array(frames), 1e-4, 1e-4, pose=np.array(pose)))
    return tuple(out)


def pose_residuals(recorded: Recorded) -> Array:
    """RMS residual (n,) of the nominal robot at each pose with the best base and tool, m; NaN where unmeasured.

    Raises
    ------
    RobcalError : no base and tool can be fitted.
    """
    return residuals_in(recorded, *best_cell(recorded))


def best_cell(recorded: Recorded) -> tuple[Array, Array]:
    """world_T_base and flange_T_tool (4, 4) that suit the nominal robot best.

    Raises
    ------
    RobcalError : none can be constructed.
    """
    observations = recorded.observations
    if not any(isinstance(o, FrameObservations) for o in observations):
        kernel = recorded.kernel or Kernel(recorded.model.nominal())
        evaluator = Evaluator(kernel, recorded.poses, Stack(observations, len(recorded.poses)))
        state = start_state(evaluator, observations)
        return state.world_T_base, state.flange_T_tool
    pairs = candidates(recorded.base_T_flange, observations)
    if not pairs:
        raise NotIdentifiable("no base and tool suit the measured frames: measure more poses", ("base", "tool"))
    return pairs[0] if len(pairs) == 1 else min(pairs, key=lambda pair: trimmed(residuals_in(recorded, *pair)))


def residuals_in(recorded: Recorded, world_T_base: Array, flange_T_tool: Array) -> Array:
    """RMS residual (n,) of the nominal robot at each pose with given base and tool, m; NaN where unmeasured."""
    T = world_T_base @ recorded.base_T_flange @ flange_T_tool
    square, count = np.zeros(len(T)), np.zeros(len(T))
    for o in recorded.observations:
        r, _ = o.evaluate(T)
        np.add.at(square, o.pose, np.sum(r**2, axis=1))
        np.add.at(count, o.pose, r.shape[1])
    return np.where(count > 0, np.sqrt(square / np.maximum(count, 1)), np.nan)


def rows(recorded: Recorded) -> Array:
    """All residuals (m,) of measured frames with the best base and tool, m and rad."""
    W, F = best_cell(recorded)
    T = W @ recorded.base_T_flange @ F
    return np.concatenate([o.evaluate(T)[0].ravel() for o in recorded.observations])


def trimmed(residuals: Array, share: float = CLOSEST) -> float:
    """RMS of the given share of the poses, those that are missed least; infinite where there are none."""
    known = np.sort(residuals[np.isfinite(residuals)])
    if not len(known):
        return np.inf
    return float(np.sqrt(np.mean(known[: max(1, int(np.ceil(share * len(known))))] ** 2)))


def residual_rms(recorded: Recorded, robust: bool = True) -> float:
    """RMS residual (m) of the nominal robot with the best base and tool; infinite where none can be fitted."""
    try:
        return trimmed(pose_residuals(recorded), CLOSEST if robust else 1.0)
    except RobcalError:
        return np.inf


def workspace(recorded: Recorded) -> float:
    """Size (m) of the region that the flange moves in, by the nominal robot."""
    t = recorded.base_T_flange[:, :3, 3]
    return float(np.linalg.norm(t - t.mean(axis=0), axis=1).max(initial=0.0))


def outside_limits(model: RobotModel, poses: PoseInputs) -> list[tuple[int, str, float]]:
    """Rows, joints and angles (rad or m) that leave the joint ranges of the robot file by more than rounding."""
    out = []
    for k, f in enumerate(model.joints):
        if f.limits is not None:
            tolerance = 1e-6 + 1e-3 * (f.limits[1] - f.limits[0])
            far = (poses.q[:, k] < f.limits[0] - tolerance) | (poses.q[:, k] > f.limits[1] + tolerance)
            out += [(int(row), f.name, float(poses.q[row, k])) for row in np.flatnonzero(far)]
    return sorted(out)


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
