"""How good a calibrated robot is where it was not identified: errors, calibration of the stated uncertainty, folds.

Errors are ``e = |(measured - model) t|`` for test vectors t of 0, 490 and 980 mm on the
tool, beside those of the nominal robot after the best fit of base and tool on the identification poses.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import stats

from robcal import transforms as tf
from robcal.calibration.calibrated import CalibratedRobot
from robcal.calibration.identifiability import repetitions
from robcal.calibration.identification import IdentifiedRobot, IdentifyOptions, identify
from robcal.calibration.observations import (
    DistanceObservations,
    FrameObservations,
    Observations,
    PointObservations,
    SensorPointObservations,
    Stack,
)
from robcal.columns import Columns
from robcal.errors import InvalidInput, NotIdentifiable
from robcal.robot.kernel import PoseInputs
from robcal.robot.kernel_cache import kernel_of
from robcal.robot.model import RobotModel

Array = NDArray[np.float64]

TEST_VECTORS: Mapping[str, tuple[float, float, float]] = {
    "0": (0.0, 0.0, 0.0),
    "500": (0.2, 0.2, 0.4),
    "1000": (0.4, 0.4, 0.8),
}
"""Test vectors on the tool in m, by their rounded length in mm."""


@dataclass(frozen=True)
class ErrorStatistics:
    """Mean, smallest, largest, standard deviation and root mean square of errors, m."""

    mean: float
    min: float
    max: float
    std: float
    rms: float

    @classmethod
    def of(cls, errors: ArrayLike) -> "ErrorStatistics":
        """Statistics of errors (n,); NaN where there are none."""
        e = np.asarray(errors, dtype=float)
        if e.size == 0:
            return cls(*[float("nan")] * 5)
        spread = float(e.std(ddof=1)) if e.size > 1 else 0.0
        return cls(float(e.mean()), float(e.min()), float(e.max()), spread, float(np.sqrt(np.mean(e**2))))


@dataclass(frozen=True)
class PoseAccuracy:
    """Terms of ISO 9283 at the poses: AP (position, m; orientation, rad) and RP (m; NaN without repetitions)."""

    ap_mean: float
    ap_max: float
    ap_orientation_mean: float
    ap_orientation_max: float
    rp_mean: float
    rp_max: float
    groups: int


@dataclass(frozen=True)
class Verification:
    """Errors at poses that took no part in the identification.

    Attributes
    ----------
    kind : 'verify-set' or 'cross-validation'.
    poses : number of poses.
    tools : statistics by test vector ('0', '500', '1000'; only '0' without measured frames).
    nominal : the same for the nominal robot after best fit of base and tool, None if it was not asked for.
    errors, nominal_errors : (n,) m by test vector.
    normalised : (n,) squared normalised errors per degree of freedom (measured against predicted; near one if the
        stated uncertainties hold); p_value : of their sum (chi-square, small if too large); coverage_95 : share of
        poses inside their 95 % region.
    predicted : (n,) standard deviation of the predicted position, m (root of the mean over directions).
    iso : ISO 9283 terms, None without measured frames.
    rows : rows of the poses in the input, in the order of the arrays.
    """

    kind: str
    poses: int
    tools: Mapping[str, ErrorStatistics]
    nominal: Mapping[str, ErrorStatistics] | None
    errors: Mapping[str, Array]
    nominal_errors: Mapping[str, Array] | None
    normalised: Array
    degrees: NDArray[np.int64]
    p_value: float
    coverage_95: float
    predicted: Array
    iso: PoseAccuracy | None
    rows: NDArray[np.int64]


def fit_nominal(
    model: RobotModel, poses: PoseInputs, observations: Sequence[Observations], options: IdentifyOptions | None = None
) -> IdentifiedRobot:
    """The uncalibrated robot after the best fit of base and tool: what every comparison starts from."""
    chosen = IdentifyOptions() if options is None else options
    nominal = model.nominal()
    bare = PoseInputs(poses.q, poses.load, poses.covariates)
    return identify(nominal, bare, observations, replace(chosen, parameters=(), robust=False, priors={}))


def tool_errors(T: Array, observations: Sequence[Observations]) -> dict[str, tuple[NDArray[np.int64], Array]]:
    """Rows of poses and errors (m) by test vector, for tool frames T (n, 4, 4) of the model.

    Frames give all three vectors; points, distances and sensor points only '0' (the residual of what was measured).
    """
    out: dict[str, tuple[NDArray[np.int64], Array]] = {}
    frames = [o for o in observations if isinstance(o, FrameObservations)]
    if frames:
        pose = np.concatenate([o.pose for o in frames])
        measured = np.concatenate([o.world_T_tool for o in frames])
        for name, vector in TEST_VECTORS.items():
            error = tf.transform(measured, vector) - tf.transform(T[pose], vector)
            out[name] = (pose, np.linalg.norm(error, axis=1))
        return out
    rows, errors = [], []
    for o in observations:
        if isinstance(o, PointObservations | SensorPointObservations | DistanceObservations):
            r, _ = o.evaluate(T)
            rows.append(o.pose)
            errors.append(np.linalg.norm(r, axis=1))
    if not rows:
        raise InvalidInput("verification in millimetres needs frames, points or distances, not pixels alone")
    return {"0": (np.concatenate(rows), np.concatenate(errors))}


def verify(
    robot: CalibratedRobot,
    poses: PoseInputs,
    observations: Sequence[Observations],
    nominal: CalibratedRobot | None = None,
) -> Verification:
    """Compare a calibrated robot with measurements at other poses.

    Parameters
    ----------
    robot : identified on other poses.
    poses, observations : the kept-out poses (n) and what was measured there.
    nominal : from :func:`fit_nominal` on the identification poses.
    """
    return _verification("verify-set", poses, observations, [_checked(robot, nominal, poses, observations)])


def cross_validate(
    model: RobotModel,
    poses: PoseInputs,
    observations: Sequence[Observations],
    options: IdentifyOptions | None = None,
    folds: int = 5,
    groups: ArrayLike | None = None,
    stated: PoseInputs | None = None,
) -> Verification:
    """k-fold verification; every choice (parameters, outliers) is made anew in each fold, on its own poses alone.

    Parameters
    ----------
    groups : (n,) labels of poses that must stay together; default: repetitions of one another.
    folds : number of folds; groups are dealt out in turn, so every fold covers the whole time.
    stated : the poses as they would be stated to predict, where that is less than what was recorded.

    Raises
    ------
    NotIdentifiable : fewer groups than folds.
    """
    chosen = IdentifyOptions() if options is None else options
    labels = repetitions(poses.q) if groups is None else np.unique(np.asarray(groups), return_inverse=True)[1]
    n_groups = int(labels.max()) + 1
    if n_groups < max(2, folds):
        raise NotIdentifiable(f"{n_groups} distinct poses cannot be divided into {folds} folds: measure more poses")
    kernel = kernel_of(model, chosen.statics)
    order = np.argsort(np.random.default_rng(0).permutation(n_groups)) % folds
    fold_of = order[labels]
    parts: list[_Checked] = []
    for k in range(folds):
        out, inside = np.flatnonzero(fold_of == k), np.flatnonzero(fold_of != k)
        train = [o.subset(inside) for o in observations]
        test = [o.subset(out) for o in observations]
        here, there = poses.subset(inside), (poses if stated is None else stated).subset(out)
        robot, nominal = identify(model, here, train, chosen, kernel), fit_nominal(model, here, train, chosen)
        parts.append(_checked(robot, nominal, there, test, out))
    return _verification("cross-validation", poses, observations, parts)


@dataclass(frozen=True)
class _Checked(Columns):
    """Predictions (n, 4, 4) with covariance (n, 6, 6) at some ``rows`` of the poses, squared normalised errors with
    their degrees (n,), and by test vector the errors of the robot and of the nominal one."""

    rows: NDArray[np.int64]
    T: Array
    covariance: Array
    normalised: Array
    degrees: NDArray[np.int64]
    errors: Mapping[str, Array]
    nominal_errors: Mapping[str, Array] | None


def _checked(
    robot: CalibratedRobot,
    nominal: CalibratedRobot | None,
    poses: PoseInputs,
    observations: Sequence[Observations],
    rows: NDArray[np.int64] | None = None,
) -> _Checked:
    """The robots against measurements at poses; ``rows`` says which of all poses they are."""
    T, covariance = robot.predict(poses)
    square, degrees = _normalised(robot, poses, observations, T, covariance)
    errors = {name: e for name, (_, e) in tool_errors(T, observations).items()}
    nominal_errors = None
    if nominal is not None:
        nominal_errors = {n: e for n, (_, e) in tool_errors(nominal.predict(poses)[0], observations).items()}
    at = np.arange(len(poses)) if rows is None else rows
    return _Checked(at, T, covariance, square, degrees, errors, nominal_errors)


def _normalised(
    robot: CalibratedRobot, poses: PoseInputs, observations: Sequence[Observations], T: Array, C_T: Array
) -> tuple[Array, NDArray[np.int64]]:
    """Squared normalised errors (n,) of the poses, per degree of freedom, and the degrees."""
    stack = Stack(observations, len(poses))
    stacked = stack.evaluate(T)
    C = stack.covariance(T) * np.where(stack.used[:, :, None] & stack.used[:, None, :], robot.covariance_scale, 1.0)
    C = C + tf.transport_covariance(stacked.B, C_T)
    white = np.linalg.solve(np.linalg.cholesky(C), stacked.r[..., None])[..., 0]
    degrees = stack.used.sum(axis=1)
    return np.sum(white**2, axis=1) / np.maximum(degrees, 1), degrees


def _verification(
    kind: str, poses: PoseInputs, observations: Sequence[Observations], parts: Sequence[_Checked]
) -> Verification:
    every = _Checked.concatenated(parts)
    square, degrees = every.normalised, every.degrees
    measured = degrees > 0
    # repetitions of one another share what the model misses there: together they count as one pose
    labels = np.unique(repetitions(poses.q)[every.rows][measured], return_inverse=True)[1]
    weight = 1.0 / np.bincount(labels)[labels]
    total = float(np.sum(weight * square[measured] * degrees[measured]))
    freedom = float(np.sum(weight * degrees[measured]))
    inside = square[measured] * degrees[measured] <= stats.chi2.isf(0.05, degrees[measured])
    errors = _by_vector([p.errors for p in parts])
    compared = [p.nominal_errors for p in parts if p.nominal_errors is not None]
    nominal = _by_vector(compared) if compared else None
    T = np.empty_like(every.T)
    T[every.rows] = every.T
    return Verification(
        kind=kind,
        poses=int(measured.sum()),
        tools={name: ErrorStatistics.of(e) for name, e in errors.items()},
        nominal=None if nominal is None else {name: ErrorStatistics.of(e) for name, e in nominal.items()},
        errors=errors,
        nominal_errors=nominal,
        normalised=square,
        degrees=degrees,
        p_value=float(stats.chi2.sf(total, max(1.0, freedom))),
        coverage_95=float(np.average(inside, weights=weight)) if inside.size else float("nan"),
        predicted=np.sqrt(np.trace(every.covariance[:, :3, :3], axis1=1, axis2=2) / 3.0),
        iso=_pose_accuracy(poses, T, observations),
        rows=every.rows,
    )


def _by_vector(parts: Sequence[Mapping[str, Array]]) -> dict[str, Array]:
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


def _pose_accuracy(poses: PoseInputs, T: Array, observations: Sequence[Observations]) -> PoseAccuracy | None:
    """AP: model against the barycentre of what was attained; RP: mean distance from it plus three sigma (ISO 9283)."""
    frames = [o for o in observations if isinstance(o, FrameObservations)]
    if not frames:
        return None
    pose = np.concatenate([o.pose for o in frames])
    twist = tf.difference(T[pose], np.concatenate([o.world_T_tool for o in frames]))
    labels = repetitions(poses.q)[pose]
    ap, ap_turn, rp = [], [], []
    for label in np.unique(labels):
        mine = twist[labels == label]
        centre = mine.mean(axis=0)
        ap.append(np.linalg.norm(centre[:3]))
        ap_turn.append(np.linalg.norm(centre[3:]))
        if len(mine) > 1:
            distance = np.linalg.norm(mine[:, :3] - centre[:3], axis=1)
            rp.append(distance.mean() + 3.0 * distance.std(ddof=1))
    return PoseAccuracy(
        float(np.mean(ap)),
        float(np.max(ap)),
        float(np.mean(ap_turn)),
        float(np.max(ap_turn)),
        float(np.mean(rp)) if rp else float("nan"),
        float(np.max(rp)) if rp else float("nan"),
        len(ap),
    )
