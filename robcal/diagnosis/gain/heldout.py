"""Gain on data kept out: verification poses, or folds of whole blocks of poses.

One region of the workspace kept out altogether: effects that parameters absorb show outside the range only.
"""

from collections.abc import Sequence

import numpy as np

from robcal.calibration.identifiability import repetitions
from robcal.calibration.observations import DistanceObservations, FrameObservations, PointObservations
from robcal.diagnosis.core.fitting import Accepted, Fit, damping
from robcal.diagnosis.core.recording import Recording, observation_data
from robcal.estimation.minimum_norm import solve
from robcal.physics.cause import Array, ObservationCause
from robcal.transforms import invert, transform

FOLDS = 8


def position_errors(recording: Recording, fitted: Fit, accepted: Sequence[Accepted] | None = None) -> Array:
    """Measured minus modelled positions (m_obs, 3), or lengths (m_obs, 1), with a model fitted elsewhere.

    Errors that all poses share (orientation of the station) are taken off as they were estimated there.
    """
    kernel = fitted.kernel
    inputs = recording.inputs(kernel)
    frames = kernel.frames(fitted.theta, inputs)
    obs = recording.observations
    T = frames[obs.pose]
    if isinstance(obs, FrameObservations):
        error = (invert(T) @ obs.world_T_tool)[:, :3, 3]
    elif isinstance(obs, PointObservations):
        error = obs.p_world - transform(T, obs.p_tool)
    elif isinstance(obs, DistanceObservations):
        error = (obs.distance - np.linalg.norm(T[:, :3, 3], axis=1))[:, None]
    else:
        error = obs.p_world - transform(T, obs.p_sensor)
    if recording.common is not None and fitted.common is not None:
        error = error - (recording.common @ fitted.common)[:, :3]
    variables = kernel.variables(fitted.theta, inputs)
    for item in fitted.accepted if accepted is None else accepted:
        if isinstance(item.cause, ObservationCause):
            shift = (
                item.cause.observation_shift(observation_data(recording, frames, variables), item.constants)
                @ item.values
            )
            if isinstance(obs, PointObservations):
                error = error - shift
            elif isinstance(obs, FrameObservations):
                error = error - shift[:, :3]
            else:
                error = error - shift.reshape(error.shape)
    return error


def rms(errors: Array) -> float:
    """Root mean square of the lengths of error vectors (m, k)."""
    return float(np.sqrt(np.mean(np.sum(errors**2, axis=1))))


def folds(recording: Recording, count: int = FOLDS) -> Array:
    """Fold of each pose (n,): blocks of consecutive poses, so that slow effects stay together.

    Repetitions of one another lie in the fold of the first of them, whenever they were driven.
    """
    return block_labels(recording.covariates["index"], recording.q, count)


def block_labels(index: Array, q: Array, count: int = FOLDS) -> Array:
    """The same of poses (n, joints) that were driven in the order of ``index`` (n,)."""
    order = np.argsort(np.argsort(index, kind="stable"), kind="stable")
    blocks = min(2 * count, len(order))
    labels = (order * blocks // len(order)) % count
    same = repetitions(q)
    first = np.full(int(same.max(initial=-1)) + 1, len(order))
    np.minimum.at(first, same, order)
    return np.asarray(labels[np.argsort(order)][first[same]])


def cross_validated(recording: Recording, fitted: Fit, labels: Array) -> Array:
    """Errors (m_obs, 3) of each observation predicted from the other folds, by the linearised fit.

    Only position rows count. The linearised refit is exact to second order in what a fold changes.
    """
    m = len(fitted.residual)
    per = m // len(recording.observations.pose)
    fold_of_row = labels[fitted.row_pose]
    predicted = np.empty(m)
    for fold in np.unique(labels):
        test = fold_of_row == fold
        rows = np.vstack([fitted.jacobian[~test], fitted.prior])
        step = solve(rows, np.concatenate([fitted.residual[~test], fitted.prior_residual]))
        predicted[test] = fitted.residual[test] - fitted.jacobian[test] @ step
    return recording.local(predicted[:, None], fitted.frames)[:, : min(per, 3), 0]


def noise_floor(recording: Recording, factor: float) -> float:
    """Root mean square of the position error that the measurement itself has, metres."""
    if isinstance(recording.observations, DistanceObservations):
        return float(np.sqrt(np.mean(recording.observations.sigma**2) * factor))
    covariance = recording.observations.covariance
    return float(np.sqrt(np.mean(np.trace(covariance[:, :3, :3], axis1=1, axis2=2)) * factor))


SHARE = 0.2
"""Share of the poses that lie in the region."""
LEAST_POSES = 25
"""Recordings with fewer poses are not divided."""


def outermost(frames: Array, share: float = SHARE) -> Array:
    """Poses (n,) at one end of the measured space: along the direction in which their positions (n, 4, 4) spread most.

    The end is that with the longer tail, where a model has to reach farthest.
    """
    p = frames[:, :3, 3] - frames[:, :3, 3].mean(axis=0)
    along = p @ np.linalg.svd(p, full_matrices=False)[2][0]
    if -along.min() > along.max():
        along = -along
    return np.asarray(along >= np.quantile(along, 1.0 - share))


def extrapolated(recording: Recording, fitted: Fit, region: Array) -> float:
    """Root mean square of the position errors (m) in a region (n,) of poses, predicted from all others.

    By the linearised fit; what the other poses leave open stays near the whole fit by the size that deviations have.
    """
    test = region[fitted.row_pose]
    per = len(fitted.residual) // len(recording.observations.pose)
    variables = fitted.kernel.variables(fitted.theta, fitted.inputs)
    bounds = np.diag(damping(fitted.free, fitted.jacobian.shape[1], variables))
    rows = np.vstack([fitted.jacobian[~test], bounds, fitted.prior])
    step = solve(rows, np.concatenate([fitted.residual[~test], np.zeros(len(bounds)), fitted.prior_residual]))
    predicted = np.where(test, fitted.residual - fitted.jacobian @ step, 0.0)
    errors = recording.unwhiten(predicted[:, None], fitted.frames)[:, : min(per, 3), 0]
    return rms(errors[region[recording.observations.pose]])


def region_errors(recording: Recording, before: Fit, after: Fit) -> tuple[float, float] | None:
    """Errors (m) in the outermost region, predicted from all other poses: without and with what was found."""
    if len(recording.q) < LEAST_POSES:
        return None
    region = outermost(after.frames)
    return extrapolated(recording, before, region), extrapolated(recording, after, region)
