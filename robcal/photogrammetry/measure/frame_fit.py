"""Least-squares frames of a body onto measured points, all poses together, with full covariances."""

from dataclasses import dataclass

import numpy as np

from robcal.estimation.batched import NormalEquations, minimise_each
from robcal.estimation.grouping import members, sum_by, whitener
from robcal.estimation.summary import TerminationSettings
from robcal.photogrammetry.core.bodies import Body, IntArray
from robcal.transforms import Array, fit_frame, retract, skew, transform


@dataclass(frozen=True)
class FrameFit:
    """Frames (n, 4, 4) with the covariance (n, 6, 6) that the points' noise causes, the common part from station and
    body coordinates, targets used, chi-square and redundancy of each fit."""

    pose: IntArray
    world_T_body: Array
    covariance: Array
    common_covariance: Array
    targets: tuple[tuple[int, ...], ...]
    chi2: Array
    redundancy: IntArray


def fit_frames(
    pose: IntArray,
    row: IntArray,
    p_world: Array,
    covariance: Array,
    body: Body,
    station_jacobian: Array | None = None,
    station_covariance: Array | None = None,
) -> FrameFit:
    """Fit body_T onto points: weights from the points' noise plus the body's own (marginal) uncertainty.

    Parameters
    ----------
    pose, row : (m,) pose number and row of the body of each point; at least three per pose, not in one line.
    p_world, covariance : (m, 3) m, (m, 3, 3) m^2.
    station_jacobian, station_covariance : (m, 3, k), (k, k) for the common part.

    Notes
    -----
    The estimate is linear in the errors, ``d = K e``: the noise part of the covariance is ``K C_noise K'`` and the
    common part ``K (J S J' + R C_body R') K'`` with all correlations between targets.
    """
    poses, index = np.unique(pose, return_inverse=True)
    n = len(poses)
    empty = np.empty((0, 6, 6))
    if n == 0:
        none = np.empty(0, dtype=np.int64)
        return FrameFit(none, np.empty((0, 4, 4)), empty, empty, (), np.empty(0), none)
    order = np.argsort(index, kind="stable")
    groups = np.split(order, np.flatnonzero(np.diff(index[order])) + 1)
    X = body.points[row]
    T = np.array([fit_frame(p_world[g], X[g]) for g in groups])
    own = np.array([body.marginal(i) for i in range(len(body))])[row]

    def whitened(frames: Array, rows: IntArray, place: IntArray) -> tuple[Array, Array, Array, Array]:
        R = frames[place][:, :3, :3]
        W = whitener(covariance[rows] + R @ own[rows] @ np.swapaxes(R, -1, -2))
        J = W @ np.concatenate([R, -R @ skew(X[rows])], axis=-1)
        r = np.einsum("mij,mj->mi", W, p_world[rows] - transform(frames[place], X[rows]))
        return r, J, W, R

    def equations(frames: Array, chosen: IntArray) -> NormalEquations:
        rows, place = members(index, chosen, n)
        r, J, _, _ = whitened(frames, rows, place)
        return NormalEquations.of_rows(place, r, J, len(chosen))

    T = minimise_each(equations, retract, T, TerminationSettings(10, negligible=1e-10)).state
    r, J, W, R = whitened(T, np.arange(len(index)), index)
    Q = np.linalg.inv(sum_by(index, np.swapaxes(J, -1, -2) @ J, n))
    K = Q[index] @ np.swapaxes(J, -1, -2) @ W
    noise = sum_by(index, K @ covariance @ np.swapaxes(K, -1, -2), n)
    common = np.zeros((n, 6, 6))
    if station_jacobian is not None and station_covariance is not None:
        G = sum_by(index, K @ station_jacobian, n)
        common += G @ station_covariance @ np.swapaxes(G, -1, -2)
    if body.covariance is not None:
        common += _from_body(-K @ R, index * len(body) + row, body.covariance, n)
    count = np.bincount(index, minlength=n)
    targets = tuple(tuple(int(body.ids[row[k]]) for k in g) for g in groups)
    chi2 = sum_by(index, np.sum(r**2, axis=1), n)
    return FrameFit(poses, T, noise, common, targets, chi2, (3 * count - 6).astype(np.int64))


def _from_body(by_target: Array, place: IntArray, covariance: Array, n: int) -> Array:
    """(n, 6, 6) what the body's covariance (3t, 3t) adds to n frames.

    ``by_target`` (m, 6, 3): derivative of the frames by the target of each point; ``place`` (m,): frame * t + target.
    """
    t = len(covariance) // 3
    H = np.moveaxis(sum_by(place, by_target, n * t).reshape(n, t, 6, 3), 1, 2).reshape(n, 6, 3 * t)
    # targets without coordinates have no covariance either and no part in any fit
    return np.asarray(H @ np.nan_to_num(covariance) @ np.swapaxes(H, -1, -2))
