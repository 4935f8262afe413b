"""Search for recurring contradictions in an adjusted station: a camera that moved, a slipped image, a wrong target.

Each candidate is a few extra unknowns. Their test statistic is the drop of the sum of squares that they would bring
(score test in the reduced normal equations), so none has to be adjusted before it is known to matter.
Source: Baarda (1968), "A testing procedure for use in geodetic networks"; change-point form by cumulative sums.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from robcal.estimation.grouping import sum_by
from robcal.photogrammetry.core.bodies import IntArray
from robcal.photogrammetry.station.network import MarkTable, StationDesign
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
    cameras only their relative motion shows, so both get (nearly) the same statistic; only the robot can show which
    moved.
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
    with_global = with_global + with_pose @ design.pose_response[pose]
    shape = (cameras, poses)
    s, o, w = score.reshape(*shape, 6), own.reshape(*shape, 6, 6), with_global.reshape(*shape, 6, g)

    def tail(a: Array) -> Array:
        return np.flip(np.cumsum(np.flip(a, axis=1), axis=1), axis=1)

    seen = np.bincount(group, minlength=n).reshape(shape) > 0
    before: Array = np.cumsum(seen, axis=1) - seen.astype(float)
    after = tail(seen.astype(float))
    usable = (before >= 2) & (after >= 2)
    stat, estimate, covariance = _statistics(tail(s), tail(o), tail(w), design, usable)
    single = _statistics(s, o, w, design, seen)[0]
    return MoveScan(stat, single, estimate, covariance)


def _statistics(
    score: Array, own: Array, with_global: Array, design: StationDesign, usable: NDArray[np.bool_]
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


@dataclass(frozen=True)
class TargetScan:
    """Tests of given coordinates: ``statistic`` (t,) chi-square (3), ``error`` (t, 3) true minus given with
    ``covariance`` (t, 3, 3), and ``rest`` (t,) the median statistic of the other targets once this one is freed."""

    statistic: Array
    error: Array
    covariance: Array
    rest: Array


def scan_targets(points: Array, given: Array, weight: Array, covariance: Array, usable: IntArray) -> TargetScan:
    """Test every target for a gross error of its given coordinates.

    Parameters
    ----------
    points, given : (t, 3) adjusted and given coordinates; weight (3t, 3t) of the given; covariance (3t, 3t) adjusted.
    usable : rows of the targets to test.

    Notes
    -----
    Baarda's test for a group of observations, ``nabla = (E'P Qv P E)^-1 E'P v`` with ``P Qv P = P - P Q P``. ``rest``
    distinguishes a wrong target, after which the others fit, from a body that is inaccurate as a whole.
    """
    t = len(points)
    gradient = weight @ (given - points).ravel()
    S = weight - weight @ covariance @ weight
    S = 0.5 * (S + S.T)
    floor = 1e-9 * np.array([np.trace(weight[3 * i : 3 * i + 3, 3 * i : 3 * i + 3]) for i in range(t)])
    scan = TargetScan(np.zeros(t), np.zeros((t, 3)), np.zeros((t, 3, 3)), np.zeros(t))
    blocks = 3 * usable[:, None] + np.arange(3)
    for i, at in zip(usable, blocks, strict=True):
        inverse = _pseudo_inverse(S[np.ix_(at, at)][None], floor[i])[0]
        scan.statistic[i] = float(gradient[at] @ inverse @ gradient[at])
        scan.covariance[i] = inverse
        scan.error[i] = -inverse @ gradient[at]
        others = blocks[usable != i]
        if len(others) == 0:
            continue
        gain = S[:, at] @ inverse
        left = (gradient - gain @ gradient[at])[others]
        cross = S[at][:, others]
        conditional = S[others[:, :, None], others[:, None, :]] - np.einsum("jka,ajl->jkl", gain[others], cross)
        inner = _pseudo_inverse(conditional, np.median(floor[usable]))
        scan.rest[i] = float(np.median(np.einsum("ji,jik,jk->j", left, inner, left)))
    return scan


def _pseudo_inverse(blocks: Array, floor: float) -> Array:
    """Inverse (n, 3, 3) of symmetric blocks, directions with eigenvalues below ``floor`` left out."""
    values, vectors = np.linalg.eigh(0.5 * (blocks + np.swapaxes(blocks, -1, -2)))
    good = values > floor
    inverse = np.where(good, 1.0 / np.where(good, values, 1.0), 0.0)
    return np.einsum("nij,nj,nkj->nik", vectors, inverse, vectors)
