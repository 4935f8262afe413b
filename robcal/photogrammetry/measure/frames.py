"""From points to frames: the distance criterion, then the body fitted onto its targets with full covariance.

Errors that measured frames share through the station and the body, less what a robot's base and tool absorb.

The errors of cameras and body coordinates are the same in all poses. Most of what they do to the frames is a constant
frame on the left (the world) or on the right (the body), which every robot calibration estimates anyway. The rest, a
field that varies over the workspace, looks like robot physics: whoever weights the frames by their noise alone takes
it for such.
"""

from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from robcal.columns import Columns
from robcal.errors import DegenerateGeometry, InvalidInput
from robcal.photogrammetry.core.bodies import Body, IntArray, spans_plane
from robcal.photogrammetry.measure.distance_criterion import make_pairs
from robcal.photogrammetry.measure.elimination import (
    TOO_MANY,
    PairDeviations,
    PoseFault,
    RejectedPose,
    eliminate,
    judge_pairs,
    noise_from_lengths,
    shared_variance,
)
from robcal.photogrammetry.measure.frame_fit import FrameFit, fit_frames
from robcal.photogrammetry.measure.measured_points import MeasuredPoints, RejectedPoint
from robcal.photogrammetry.measure.recurring import Recurring, find_recurring
from robcal.photogrammetry.measure.unknown_body import body_from_points
from robcal.transforms import Array, adjoint, invert, skew

FrameMethod = Literal["points", "resection", "gram_schmidt"]


@dataclass(frozen=True)
class MeasuredFrames:
    """Frames of the body in the world.

    Attributes
    ----------
    pose : (n,) pose numbers; world_T_body : (n, 4, 4).
    covariance : (n, 6, 6) the part that is independent from pose to pose (right perturbation, translation first).
    common_covariance : (n, 6, 6) what station and body coordinates add, common to all poses; zero where not known.
    method : (n,) 'points', 'resection' (one camera: anisotropic) or 'gram_schmidt' (body without coordinates).
    targets : ids used per pose; chi2, redundancy (n,) of each fit.
    rejected_poses, rejected_points : with reason. pairs : all length deviations, for the report.
    recurring : evidence over all poses; left_out : ids not used in any fit because of it.
    noise_factor : robust estimate of the scatter of lengths by what the covariance says.
    body : the body used (estimated from the points where it had no coordinates).
    sigma : isotropic standard deviation (m) of a coordinate where no covariance was given, else None.
    """

    pose: IntArray
    world_T_body: Array
    covariance: Array
    common_covariance: Array
    method: tuple[FrameMethod, ...]
    targets: tuple[tuple[int, ...], ...]
    chi2: Array
    redundancy: IntArray
    rejected_poses: tuple[RejectedPose, ...]
    rejected_points: tuple[RejectedPoint, ...]
    pairs: PairDeviations
    recurring: Recurring
    left_out: tuple[int, ...]
    noise_factor: float
    body: Body
    sigma: float | None
    notes: tuple[str, ...] = field(default=())


@dataclass(frozen=True)
class _BodyPoints(Columns):
    """Points of a body, m of them: row of the measured points and of the body, pose, coordinates and covariance."""

    at: IntArray
    row: IntArray
    pose: IntArray
    p_world: Array
    covariance: Array


def measure_frames(
    points: MeasuredPoints, body: Body | None = None, *, tolerance: float | None = None, sigma_factor: float = 4.0
) -> MeasuredFrames:
    """Frames of a body from its measured targets.

    Parameters
    ----------
    points : from :func:`measure_points` or any other system (without covariance the noise is estimated from lengths).
    body : the body; None or without three known coordinates: the method with unknown targets.
    tolerance : m, fixed limit of a length deviation; default ``sigma_factor`` standard deviations of the pair.

    Raises
    ------
    DegenerateGeometry : the body has fewer than three targets or all in one line, or no pose carries a frame.
    InvalidInput : a tolerance that is not positive.
    """
    if tolerance is not None and not tolerance > 0:
        raise InvalidInput(f"the distance tolerance must be above zero, got {tolerance}")
    own = points.n_cameras != 1 if points.resected is not None else np.ones(len(points.pose), dtype=bool)
    body, method, notes = _body_with_coordinates(points, own, body)
    used, sigma, foreign = _points_of_body(points, own, body)
    table = make_pairs(used.pose, used.row, used.p_world, used.covariance)
    shared = shared_variance(points, used.at, table)
    recurring = find_recurring(body, table, used.pose, used.row, used.p_world, shared)
    judged, factor, note = judge_pairs(body, table, recurring, shared, tolerance, sigma_factor)
    if note:
        notes.append(note)
    left_out = _shifted_targets(body, recurring, notes)
    eliminated = eliminate(body, used.pose, used.row, table, judged, left_out)
    fit, sigma = _fit(points, used.select(eliminated.keep), body, sigma)
    faults = _faults_of_fits(fit, factor, notes)
    good = np.array([fault is None for fault in faults], dtype=bool)
    frames = _with_resected(points, fit, good, method)
    rejected_poses = _without_frame(
        points, frames.pose, [*eliminated.poses, *(fault for fault in faults if fault is not None)]
    )
    if len(frames.pose) == 0:
        reason = rejected_poses[0].reason if rejected_poses else "no points of the body"
        raise DegenerateGeometry(f"no pose carries a frame of body {body.name}: {reason}")
    return MeasuredFrames(
        frames.pose,
        frames.world_T_body,
        frames.covariance,
        frames.common_covariance,
        frames.method,
        frames.targets,
        frames.chi2,
        frames.redundancy,
        rejected_poses=rejected_poses,
        rejected_points=(*points.rejected, *foreign, *eliminated.points),
        pairs=judged,
        recurring=recurring,
        left_out=left_out,
        noise_factor=factor,
        body=body,
        sigma=sigma,
        notes=tuple(notes),
    )


def _body_with_coordinates(
    points: MeasuredPoints, own: NDArray[np.bool_], body: Body | None
) -> tuple[Body, FrameMethod, list[str]]:
    """The body (from the points where it has no coordinates), how its frames are defined, and notes."""
    if body is None or body.known.sum() < 3:
        estimated = body_from_points(points, own, None if body is None else body.ids)
        note = "the body has no coordinates: frames by Gram-Schmidt from its targets (first to second is x)"
        return estimated, "gram_schmidt", [note]
    if not spans_plane(body.points[body.known]):
        raise DegenerateGeometry(
            f"all targets of body {body.name} lie in one line: they carry no frame; put a target beside the line"
        )
    return body, "points", []


def _points_of_body(
    points: MeasuredPoints, own: NDArray[np.bool_], body: Body
) -> tuple[_BodyPoints, float | None, list[RejectedPoint]]:
    """Points of known targets, the noise estimated where none is stated, and points of no known target."""
    row = body.index(points.target)
    known = np.zeros(len(row), dtype=bool)
    known[row >= 0] = body.known[row[row >= 0]]
    reason = f"not a target of body {body.name} with coordinates"
    foreign = [RejectedPoint(int(points.pose[i]), int(points.target[i]), reason) for i in np.flatnonzero(own & ~known)]
    at = np.flatnonzero(own & known)
    pose, row, p = points.pose[at], row[at], points.p_world[at]
    if points.covariance is not None:
        return _BodyPoints(at, row, pose, p, points.covariance[at]), None, foreign
    sigma = noise_from_lengths(body, pose, row, p)
    covariance = np.broadcast_to(sigma**2 * np.eye(3), (len(at), 3, 3)).copy()
    return _BodyPoints(at, row, pose, p, covariance), sigma, foreign


def _shifted_targets(body: Body, recurring: Recurring, notes: list[str]) -> tuple[int, ...]:
    """Shifted targets are not used for frames as long as three others remain that span a plane."""
    ids = recurring.shifted_ids
    stay = body.known & ~np.isin(body.ids, ids)
    if ids and spans_plane(body.points[stay]):
        notes.append(f"left out of all frames: target {', '.join(map(str, ids))} ({recurring.statement})")
        return ids
    return ()


def _fit(points: MeasuredPoints, used: _BodyPoints, body: Body, sigma: float | None) -> tuple[FrameFit, float | None]:
    """Fitted frames; a noise that was estimated from lengths is estimated again from the fits."""
    station = None if points.station_jacobian is None else points.station_jacobian[used.at]
    fit = fit_frames(used.pose, used.row, used.p_world, used.covariance, body, station, points.station_covariance)
    if sigma is None or fit.redundancy.sum() < 30:
        return fit, sigma
    # lengths gave a robust first value; the accepted fits give the efficient one
    scale = float(np.sqrt(fit.chi2.sum() / fit.redundancy.sum()))
    return replace(fit, covariance=fit.covariance * scale**2, chi2=fit.chi2 / scale**2), sigma * scale


def _faults_of_fits(fit: FrameFit, factor: float, notes: list[str]) -> list[RejectedPose | None]:
    """Fits not to be trusted; misfits in many poses are evidence, named in ``notes`` and not rejected."""
    faults = [_fault_of_fit(fit, i, factor) for i in range(len(fit.pose))]
    misfits = sum(fault is not None and fault.fault is PoseFault.MISFIT for fault in faults)
    if misfits <= TOO_MANY * len(faults):
        return faults
    notes.append(f"in {misfits} of {len(faults)} poses the body does not fit: evidence, not rejected")
    return [None if fault is None or fault.fault is PoseFault.MISFIT else fault for fault in faults]


def _fault_of_fit(fit: FrameFit, i: int, factor: float) -> RejectedPose | None:
    """Why a fit is not to be trusted although its lengths are (a mirrored or wrongly numbered body)."""
    pose, chi2, redundancy, covariance = int(fit.pose[i]), fit.chi2[i], int(fit.redundancy[i]), fit.covariance[i]
    if not np.isfinite(covariance).all() or np.sqrt(np.trace(covariance[3:, 3:])) > 0.2:
        text = "the targets measured do not determine the orientation of the body (or their sigmas are too large)"
        return RejectedPose(pose, PoseFault.UNDETERMINED, text)
    if redundancy > 0 and stats.chi2.sf(chi2 / max(factor, 1.0) ** 2, redundancy) < 1e-12:
        return RejectedPose(
            pose,
            PoseFault.MISFIT,
            f"lengths agree but the body does not fit (chi-square {chi2:.0f} with {redundancy}): "
            "mirrored or misnumbered targets",
        )
    return None


@dataclass(frozen=True)
class _Frames(FrameFit):
    """Fitted and resected frames in the order of their poses."""

    method: tuple[FrameMethod, ...]


def _with_resected(points: MeasuredPoints, fit: FrameFit, good: NDArray[np.bool_], method: FrameMethod) -> _Frames:
    """Good fits, and frames by resection in the poses without one."""
    columns: list[Any] = [fit.pose, fit.world_T_body, fit.covariance, fit.common_covariance, fit.chi2, fit.redundancy]
    columns = [column[good] for column in columns]
    methods: list[FrameMethod] = [method] * int(good.sum())
    targets = [t for t, g in zip(fit.targets, good, strict=True) if g]
    r = points.resected
    if r is not None:
        new = ~np.isin(r.pose, columns[0])
        n = int(new.sum())
        resected = [r.pose, r.world_T_body, r.covariance, r.common_covariance]
        more = [*(column[new] for column in resected), np.full(n, np.nan), np.zeros(n, dtype=np.int64)]
        columns = [np.concatenate(pair) for pair in zip(columns, more, strict=True)]
        methods += ["resection"] * n
        targets += [t for t, chosen in zip(r.targets, new, strict=True) if chosen]
    order = np.argsort(columns[0], kind="stable")
    pose, T, C, common, chi2, redundancy = (column[order] for column in columns)
    return _Frames(
        pose, T, C, common, tuple(targets[i] for i in order), chi2, redundancy, tuple(methods[i] for i in order)
    )


def _without_frame(
    points: MeasuredPoints, with_frame: IntArray, rejected: list[RejectedPose]
) -> tuple[RejectedPose, ...]:
    """Every pose without a frame, also those of which no point of the body was left."""
    have = set(with_frame.tolist())
    out = [r for r in rejected if r.pose not in have]
    reason_of: dict[int, str] = {}
    for point in points.rejected:
        reason_of.setdefault(point.pose, point.reason)
    for q in sorted({*points.pose.tolist(), *reason_of} - have - {r.pose for r in out}):
        because = f" ({reason_of[q]})" if q in reason_of else ""
        out.append(RejectedPose(q, PoseFault.FEW_TARGETS, f"fewer than three targets measured{because}"))
    return tuple(out)


def frame_sensitivities(points: MeasuredPoints, frames: MeasuredFrames) -> tuple[Array, Array]:
    """Derivatives of the frames' right perturbation by what they share.

    Returns
    -------
    by_station : (n, 6, k) by the parameters of ``points.station_covariance`` (k = 0 where there is none).
    by_body : (n, 6, 3t) by the coordinates of the body's targets. Zero for frames from resections.
    """
    n, body = len(frames.pose), frames.body
    k = 0 if points.station_jacobian is None else points.station_jacobian.shape[2]
    by_station, by_body = np.zeros((n, 6, k)), np.zeros((n, 6, 3 * len(body)))
    if points.covariance is None:
        return by_station, by_body
    for i, pose in enumerate(frames.pose):
        rows = np.flatnonzero((points.pose == pose) & np.isin(points.target, frames.targets[i]))
        if frames.method[i] == "resection" or len(rows) < 3:
            continue
        R = frames.world_T_body[i, :3, :3]
        at = body.index(points.target[rows])
        B = np.concatenate([np.broadcast_to(R, (len(rows), 3, 3)), -R @ skew(body.points[at])], axis=2)
        BW = np.swapaxes(B, 1, 2) @ np.linalg.inv(points.covariance[rows])
        N = np.sum(BW @ B, axis=0)
        if points.station_jacobian is not None:
            by_station[i] = np.linalg.solve(N, np.sum(BW @ points.station_jacobian[rows], axis=0))
        gain = np.linalg.solve(N, BW @ R)  # a target that lies farther out than its file says pulls the frame back
        for row, target in enumerate(at):
            by_body[i, :, 3 * target : 3 * target + 3] -= gain[row]
    return by_station, by_body


def unabsorbed_covariance(points: MeasuredPoints, frames: MeasuredFrames) -> Array:
    """(n, 6, 6) what station and body add to the uncertainty of each frame beside a constant world and body frame.

    Weakness: only each pose's own block is returned; the correlation between poses, which makes these errors look
    smooth, has to be neglected by whoever weights pose by pose.
    """
    by_station, by_body = frame_sensitivities(points, frames)
    n = len(frames.pose)
    left = adjoint(invert(frames.world_T_body)).reshape(-1, 6)
    constant = np.concatenate([left, np.tile(np.eye(6), (n, 1))], axis=1)
    lower = np.linalg.inv(np.linalg.cholesky(frames.covariance))
    whitened = (lower @ constant.reshape(n, 6, 12)).reshape(-1, 12)
    Q = np.linalg.svd(whitened, full_matrices=False)
    basis = Q[0][:, Q[1] > 1e-9 * Q[1][0]]
    total = np.zeros((n, 6, 6))
    for K, covariance in ((by_station, points.station_covariance), (by_body, frames.body.covariance)):
        if covariance is None or K.shape[2] == 0:
            continue
        rest = (lower @ K).reshape(-1, K.shape[2])
        rest -= basis @ (basis.T @ rest)
        K_rest = np.linalg.solve(lower, rest.reshape(n, 6, -1))
        total += K_rest @ np.nan_to_num(covariance) @ np.swapaxes(K_rest, 1, 2)
    return total
