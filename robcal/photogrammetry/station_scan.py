"""Search for recurring contradictions in an adjusted station: a camera that moved, a slipped image, a wrong target.

Each candidate is a few extra unknowns. Their test statistic is the drop of the sum of squares that they would bring
(score test in the reduced normal equations), so none has to be adjusted before it is known to matter.
Source: Baarda (1968), "A testing procedure for use in geodetic networks"; change-point form by cumulative sums.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import linalg

from robcal.photogrammetry.bodies import IntArray
from robcal.photogrammetry.grouping import sum_by
from robcal.photogrammetry.station_network import MarkTable, StationDesign
from robcal.transforms import Array


@dataclass(frozen=True)
class MoveScan:
    """Score tests of six extra unknowns of a camera's exterior orientation.

    ``from_pose`` (c, p): the camera stands elsewhere from pose column p on; ``single`` (c, p): in pose p only.
    ``estimate_from`` (c, p, 6) the change, right perturbation of the exterior orientation (m, rad); covariance
    ``covariance_from`` (c, p, 6, 6). Zero where there is nothing to test.
    """

    from_pose: Array
    single: Array
    estimate_from: Array
    covariance_from: Array


def scan_moves(design: StationDesign, marks: MarkTable, cameras: int, poses: int, columns: IntArray) -> MoveScan:
    """Test all cameras and all change points at once.

    ``columns`` (m, 18): global column numbers of each mark's exterior, interior and point unknowns. Weakness: with two
    cameras only their relative motion shows, so both get (nearly) the same statistic; the robot must tell which moved.
    """
    g = len(design.reduced_inverse)
    root = np.sqrt(design.weights)[:, None, None]
    E, r, B = root * design.by_exterior, root[:, 0] * design.residual, root * design.by_pose
    group = marks.camera * poses + marks.pose
    n = cameras * poses
    score = sum_by(group, np.einsum("mij,mi->mj", E, r), n)
    own = sum_by(group, np.swapaxes(E, -1, -2) @ E, n)
    with_pose = sum_by(group, np.swapaxes(E, -1, -2) @ B, n)
    v = sum_by(marks.pose, np.einsum("mij,mi->mj", B, r), poses)
    A = root * np.concatenate([design.by_exterior, design.by_interior, design.by_point], axis=-1)
    with_global = np.zeros((n, 6, g))
    product = np.swapaxes(E, -1, -2) @ A
    for j in range(18):  # one column of every mark at a time: no mark hits the same place twice
        np.add.at(with_global, (group[:, None], np.arange(6)[None], columns[:, j][:, None]), product[:, :, j])
    pose = np.tile(np.arange(poses), cameras)
    X = with_pose @ design.pose_inverse[pose]
    score = score - np.einsum("nij,nj->ni", X, v[pose])
    own = own - X @ np.swapaxes(with_pose, -1, -2)
    with_global = with_global - X @ np.moveaxis(design.coupling, 0, -1)[pose]
    shape = (cameras, poses)
    score, own = score.reshape(*shape, 6), own.reshape(*shape, 6, 6)
    with_global = with_global.reshape(*shape, 6, g)

    def tail(a: Array) -> Array:
        return np.flip(np.cumsum(np.flip(a, axis=1), axis=1), axis=1)

    seen = np.bincount(group, minlength=n).reshape(shape) > 0
    before = np.cumsum(seen, axis=1) - seen
    after = tail(seen.astype(float))
    usable = (before >= 2) & (after >= 2)
    stat, estimate, covariance = _statistics(tail(score), tail(own), tail(with_global), design, usable)
    single = _statistics(score, own, with_global, design, seen)[0]
    return MoveScan(stat, single, estimate, covariance)


def _statistics(
    score: Array, own: Array, with_global: Array, design: StationDesign, usable: Array
) -> tuple[Array, Array, Array]:
    M = own - with_global @ design.reduced_inverse @ np.swapaxes(with_global, -1, -2)
    M = 0.5 * (M + np.swapaxes(M, -1, -2))
    scale = np.sqrt(np.maximum(np.einsum("cpii->cpi", own), 1e-300))
    values, vectors = np.linalg.eigh(M / (scale[..., :, None] * scale[..., None, :]))
    good = (values > 1e-8) & usable[..., None]
    inverse = np.where(good, 1.0 / np.where(good, values, 1.0), 0.0)
    along = np.einsum("cpij,cpi->cpj", vectors, score / scale)
    stat = np.sum(along**2 * inverse, axis=-1)
    estimate = np.einsum("cpij,cpj->cpi", vectors, along * inverse) / scale
    covariance = np.einsum("cpij,cpj,cpkj->cpik", vectors, inverse, vectors)
    return stat, estimate, covariance / (scale[..., :, None] * scale[..., None, :])


def scan_targets(
    points: Array, given: Array, weight: Array, covariance: Array
) -> tuple[Array, Array, Array]:
    """Test every target for a gross error of its given coordinates.

    Parameters
    ----------
    points, given : (t, 3) adjusted and given coordinates; weight (3t, 3t) of the given; covariance (3t, 3t) adjusted.

    Returns
    -------
    statistic (t,) chi-square with three degrees of freedom, estimated error true minus given (t, 3), its covariance
    (t, 3, 3). Source: Baarda's test for a group of observations, ``nabla = (E'P Qv P E)^-1 E'P v``.
    """
    t = len(points)
    v = (given - points).ravel()
    pull = (weight @ v).reshape(t, 3)
    # P Qv P = P - P Q P
    S = weight - weight @ covariance @ weight
    stat, error, cov = np.zeros(t), np.zeros((t, 3)), np.zeros((t, 3, 3))
    for i in range(t):
        block = S[3 * i : 3 * i + 3, 3 * i : 3 * i + 3]
        own = weight[3 * i : 3 * i + 3, 3 * i : 3 * i + 3]
        values, vectors = linalg.eigh(0.5 * (block + block.T))
        good = values > 1e-9 * np.trace(own)
        inverse = np.where(good, 1.0 / np.where(good, values, 1.0), 0.0)
        along = vectors.T @ pull[i]
        stat[i] = float(np.sum(along**2 * inverse))
        cov[i] = (vectors * inverse) @ vectors.T
        error[i] = -cov[i] @ pull[i]
    return stat, error, cov
