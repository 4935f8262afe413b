"""Likely causes of a fit that fails: slips in the recording, each proved by the fit after mending it.

A robot misses its nominal model by millimetres; a wrong sign, an exchanged column, a slipped row or a wrong unit by
decimetres. So the nominal robot with the best base and tool is enough to tell.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from robcal import transforms as tf
from robcal.calibration.identification import start_state
from robcal.calibration.observations import FrameObservations, Observations, PointObservations, Stack
from robcal.calibration.problem import Evaluator
from robcal.errors import RobcalError
from robcal.robot.kernel import Kernel, PoseInputs
from robcal.robot.model import RobotModel

Array = NDArray[np.float64]

SUSPICIOUS_SHARE = 0.01
"""Share of the size of the workspace that a nominal robot may miss before anything is suspected."""
PROOF = 0.25
"""A cause is likely if mending it lowers the miss below this share, and to what nominal robots miss."""

FEWEST_POSES = 8
"""Fewer poses fit too many explanations."""

_SIX = ("x", "y", "z", "roll", "pitch", "yaw")


@dataclass(frozen=True)
class LikelyCause:
    """A slip in the recording.

    Attributes
    ----------
    kind : 'slipped_rows', 'exchanged_columns', 'wrong_sign' or 'wrong_unit' of the joint log, 'measured_columns' or
        'measured_unit' of the measurements.
    where : what it concerns ('axis2', 'axis1 and axis3', 'from row 17', 'all joints', 'measurements').
    statement : one sentence with the proof.
    rms_before, rms_after : miss of the nominal robot with the best base and tool, m (angles by a lever of one metre).
    """

    kind: str
    where: str
    statement: str
    rms_before: float
    rms_after: float


def nominal_miss(kernel: Kernel, poses: PoseInputs, observations: Sequence[Observations]) -> tuple[float, Array]:
    """RMS miss (m) of the model with the best base and tool, and that of each pose (n,).

    Raises
    ------
    RobcalError : no base and tool can be fitted.
    """
    evaluator = Evaluator(kernel, poses, Stack(observations, len(poses)))
    state = start_state(evaluator, observations)
    r = evaluator(state).r
    count = evaluator.stack.used.sum(axis=1)
    per_pose = np.sqrt(np.sum(r**2, axis=1) / np.maximum(count, 1))
    return float(np.sqrt(np.sum(r**2) / max(1, count.sum()))), per_pose


def outside_limits(model: RobotModel, poses: PoseInputs) -> list[tuple[int, str, float]]:
    """Rows, joints and angles (rad or m) that leave the joint ranges of the robot file by more than rounding."""
    out = []
    for k, f in enumerate(model.joints):
        if f.limits is not None:
            slack = 1e-6 + 1e-3 * (f.limits[1] - f.limits[0])
            far = (poses.q[:, k] < f.limits[0] - slack) | (poses.q[:, k] > f.limits[1] + slack)
            out += [(int(row), f.name, float(poses.q[row, k])) for row in np.flatnonzero(far)]
    return sorted(out)


def likely_causes(
    model: RobotModel,
    poses: PoseInputs,
    observations: Sequence[Observations],
    kernel: Kernel | None = None,
    share: float = SUSPICIOUS_SHARE,
) -> list[LikelyCause]:
    """Slips that explain why the nominal robot misses the measurements by far; best explanation first.

    ``share`` of the workspace that the nominal robot may miss before anything is suspected; zero looks in any case.
    Empty if the nominal robot fits as robots do, or if nothing known mends the miss.
    """
    kernel = Kernel(model) if kernel is None else kernel
    size = _workspace(kernel, poses)
    try:
        before, per_pose = nominal_miss(kernel, poses, observations)
    except RobcalError:
        before, per_pose = np.inf, np.full(len(poses), np.inf)
    if share > 0 and before < max(2e-3, share * size):
        return []
    if len(poses) < FEWEST_POSES:
        return []
    found: list[LikelyCause] = []
    for kind, where, sentence, mended in _repairs(model, poses, per_pose, kernel, observations):
        try:
            new_poses, new_observations = mended()
            # the slip leaves at the ends rows without counterpart: compare on the same rows
            after, _ = nominal_miss(kernel, new_poses, new_observations)
        except RobcalError:
            continue
        as_robots_do = max(2e-3, 2.0 * SUSPICIOUS_SHARE * _workspace(kernel, new_poses))
        if after < min(PROOF * before, as_robots_do):
            proof = f"{sentence}: mending it lowers the miss of the nominal robot from {1e3 * before:.3g} mm to "
            found.append(LikelyCause(kind, where, f"{proof}{1e3 * after:.3g} mm", before, after))
    found.sort(key=lambda c: c.rms_after)
    return [c for c in found if c.rms_after < 3.0 * found[0].rms_after]


Repair = tuple[str, str, str, Callable[[], tuple[PoseInputs, Sequence[Observations]]]]


def _repairs(
    model: RobotModel, poses: PoseInputs, per_pose: Array, kernel: Kernel, observations: Sequence[Observations]
) -> Iterator[Repair]:
    names = [f.name for f in model.joints]
    rotary = np.array([not f.prismatic for f in model.joints])
    q, n = poses.q, len(poses)

    def with_q(new: Array) -> Callable[[], tuple[PoseInputs, Sequence[Observations]]]:
        return lambda: (poses.with_q(new), observations)

    for factor, words in (
        (np.pi / 180, "degrees stand where radians are expected"),
        (180 / np.pi, "radians stand where degrees are expected"),
    ):
        yield (
            "wrong_unit",
            "all joints",
            f"the joint angles have a wrong unit ({words})",
            with_q(np.where(rotary, q * factor, q)),
        )
    for k, name in enumerate(names):
        new = q.copy()
        new[:, k] *= -1
        yield "wrong_sign", name, f"joint {k + 1} ({name}) is counted with the wrong sign", with_q(new)
    for i, k in combinations(range(len(names)), 2):
        new = q.copy()
        new[:, [i, k]] = q[:, [k, i]]
        yield (
            "exchanged_columns",
            f"{names[i]} and {names[k]}",
            f"the columns of joints {i + 1} and {k + 1} are exchanged",
            with_q(new),
        )
    yield from _measurement_repairs(poses, observations)
    for shift in (1, -1, 2, -2):
        yield (
            "slipped_rows",
            "all rows",
            f"the joint log is slipped by {abs(shift)} row(s) against the measurements "
            f"({'late' if shift > 0 else 'early'})",
            _slip(poses, observations, 0, n, shift),
        )
    for start in _breaks(kernel, poses, observations):
        for shift in (1, -1):
            yield (
                "slipped_rows",
                f"from row {start + 1}",
                f"from row {start + 1} on the joint log is slipped by one "
                f"row against the measurements ({'late' if shift > 0 else 'early'})",
                _slip(poses, observations, start, n, shift),
            )


def _measurement_repairs(poses: PoseInputs, observations: Sequence[Observations]) -> Iterator[Repair]:
    """Columns of the measurements that are exchanged, have the wrong sign or unit."""

    def mended(change: Callable[[Observations], Observations]) -> Callable[[], tuple[PoseInputs, list[Observations]]]:
        return lambda: (poses, [change(o) for o in observations])

    def of_frames(change: Callable[[Array], Array]) -> Callable[[Observations], Observations]:
        def apply(o: Observations) -> Observations:
            if not isinstance(o, FrameObservations):
                return o
            return replace(o, world_T_tool=tf.frame_from_xyzrpy(change(tf.xyzrpy_from_frame(o.world_T_tool))))

        return apply

    kind, where = "measured_columns", "measurements"
    if any(isinstance(o, FrameObservations) for o in observations):
        for i, k in ((0, 1), (0, 2), (1, 2), (3, 5)):
            order = np.arange(6)
            order[[i, k]] = k, i
            words = f"the measured {_SIX[i]} and {_SIX[k]} are exchanged"
            yield kind, where, words, mended(of_frames(lambda six, order=order: six[:, order]))  # type: ignore[misc]
        for i in range(6):
            signs = np.where(np.arange(6) == i, -1.0, 1.0)
            words = f"the measured {_SIX[i]} has the wrong sign"
            yield kind, where, words, mended(of_frames(lambda six, signs=signs: six * signs))  # type: ignore[misc]
        for factor, words in (
            (180 / np.pi, "the measured angles are in radians where degrees are expected"),
            (np.pi / 180, "the measured angles are in degrees where radians are expected"),
        ):
            scale = np.where(np.arange(6) < 3, 1.0, factor)
            yield "measured_unit", where, words, mended(of_frames(lambda six, s=scale: six * s))  # type: ignore[misc]
    if any(isinstance(o, PointObservations) for o in observations):
        words = "the measured points are mirrored (two columns exchanged, or one with the wrong sign)"

        def mirror(o: Observations) -> Observations:
            return replace(o, p_world=o.p_world * [1.0, 1.0, -1.0]) if isinstance(o, PointObservations) else o

        yield kind, where, words, mended(mirror)


def _slip(
    poses: PoseInputs, observations: Sequence[Observations], start: int, stop: int, shift: int
) -> Callable[[], tuple[PoseInputs, Sequence[Observations]]]:
    """Give measurement i of the rows from start on the joint angles of row i + shift; drop rows without counterpart."""
    rows = np.arange(stop)
    source = np.where(rows >= start, rows + shift, rows)
    good = (source >= 0) & (source < stop)

    def mend() -> tuple[PoseInputs, Sequence[Observations]]:
        return poses.subset(source[good]), [o.subset(rows[good]) for o in observations]

    return mend


def _breaks(kernel: Kernel, poses: PoseInputs, observations: Sequence[Observations]) -> list[int]:
    """Row from which the measurements leave a robot fitted to the first third of the rows."""
    n = len(poses)
    head = np.arange(max(12, n // 3))
    if n < 30:
        return []
    try:
        evaluator = Evaluator(kernel, poses.subset(head), Stack([o.subset(head) for o in observations], len(head)))
        state = start_state(evaluator, [o.subset(head) for o in observations])
        everything = Evaluator(kernel, poses, Stack(observations, n))(state)
    except RobcalError:
        return []
    miss = np.linalg.norm(everything.r, axis=1)
    limit = 10.0 * float(np.median(miss[head])) + 1e-3
    far = miss > limit
    # the first row after which most rows are far
    for k in range(len(head) // 2, n - 3):
        if far[k] and far[k:].mean() > 0.8:
            return [k]
    return []


def _workspace(kernel: Kernel, poses: PoseInputs) -> float:
    """Size (m) of the region that the flange moves in, by the nominal robot."""
    t = kernel.with_references(np.eye(4), np.eye(4)).frames(kernel.theta0, poses)[:, :3, 3]
    return float(np.linalg.norm(t - t.mean(axis=0), axis=1).max(initial=0.0))
