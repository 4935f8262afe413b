"""From a robust to a clean station: recurring contradictions freed and reported, isolated gross errors left out,
interior orientation reduced to what the images carry."""

from dataclasses import dataclass

import numpy as np
from scipy import stats

from robcal.photogrammetry.station.adjustment import Adjusted, global_columns, interior_offset
from robcal.photogrammetry.station.contradictions import CAMERA_MOVED, IMAGE_REJECTED, TARGET_SHIFTED
from robcal.photogrammetry.station.network import GROUPS, RejectedMark, StationCause, movement
from robcal.photogrammetry.station.scan import scan_moves, scan_targets
from robcal.photogrammetry.station.state import StationState

_MOVE_LIMIT = 80.0
"""Chi-square (6) above which a camera is taken to have moved: about 1e-14 for one test, far beyond 1e-6 for all tests
of a campaign; smaller changes are left to the diagnosis, which knows their alternatives."""

_TARGET_LIMIT = 50.0
_ORDER = ("k3", "affinity", "tangential", "k2", "k1", "principal", "focal")


@dataclass(frozen=True)
class Cleaned:
    """Outcome of :func:`resolve_contradictions`."""

    adjusted: Adjusted
    evidence: tuple[StationCause, ...]
    rejected: tuple[RejectedMark, ...]


def resolve_contradictions(state: StationState, adjusted: Adjusted) -> Cleaned:
    """Largest recurring contradiction first: free the parameters concerned (or leave a slipped image out), adjust,
    scan again.

    Weakness: with two cameras a move is only seen as a relative one; it is booked on the camera that does not define
    the world. With fewer than six targets of which three are wrong the majority cannot be determined.
    """
    evidence: list[StationCause] = []
    rejected: list[RejectedMark] = []
    for _ in range(15):
        found = _strongest(state, adjusted)
        if found is None:
            break
        if found.kind.moves == "camera" and found.pose is not None:
            evidence.append(found)
            state.add_epoch(state.names.index(found.where), found.pose)
        elif found.kind.moves == "target":
            evidence.append(found)
            state.release_target(int(state.body.index([int(found.where)])[0]))
        else:
            rejected += _drop_image(state, found)
        adjusted = state.settle()
    return Cleaned(adjusted, tuple(evidence), tuple(rejected))


def _drop_image(state: StationState, found: StationCause) -> list[RejectedMark]:
    """Leave out an image; of two images that contradict one another, both."""
    column = int(np.searchsorted(state.poses, -1 if found.pose is None else found.pose))
    of_pose = state.marks.pose == column
    cameras = np.unique(state.marks.camera[of_pose])
    which = cameras if len(cameras) <= 2 else np.array([state.names.index(found.where)])
    state.drop(of_pose & np.isin(state.marks.camera, which))
    pose = int(state.poses[column])
    return [
        RejectedMark(
            state.names[c],
            pose,
            -1,
            f"image contradicts the other cameras (chi-square {found.statistic:.0f})",
            "contradiction",
        )
        for c in which
    ]


def _strongest(state: StationState, adjusted: Adjusted) -> StationCause | None:
    candidates: list[StationCause] = []
    marks, design = state.marks, adjusted.design
    e, c, p = len(state.exterior_camera), len(state.names), len(state.poses)
    if c > 1 and state.settings.detect_moves:
        scan = scan_moves(design, marks, c, p, global_columns(marks, e, c))
        for kind, table in ((CAMERA_MOVED, scan.from_pose), (IMAGE_REJECTED, scan.single)):
            table = table.copy()
            fixed = state.exterior_camera[list(state.fixed)]
            table[fixed] *= 1.0 - 1e-3  # of two equal answers, the camera that does not define the world
            i, k = np.unravel_index(int(np.argmax(table)), table.shape)
            if table[i, k] < _MOVE_LIMIT:
                continue
            estimate, covariance = scan.estimate_from[i, k], scan.covariance_from[i, k]
            text = (
                movement(state.names[i], state.poses[k], estimate)
                if kind == CAMERA_MOVED
                else f"camera {state.names[i]} contradicts the others in pose {state.poses[k]} only"
            )
            if kind == CAMERA_MOVED and c == 2:
                text += "; with two cameras it may as well be the other one"
            candidates.append(
                StationCause(
                    kind, state.names[i], None, int(state.poses[k]), estimate, covariance, float(table[i, k]), 6, text
                )
            )
    if state.settings.detect_targets and state.prior.points_weight is not None:
        found = _worst_target(state, adjusted)
        if found is not None:
            candidates.append(found)
    return max(candidates, key=lambda ev: ev.statistic, default=None)


def _worst_target(state: StationState, adjusted: Adjusted) -> StationCause | None:
    """The target whose given coordinates stand out from all others' (not merely a body of modest accuracy)."""
    seen = np.unique(state.marks.target)
    weight = state.prior.points_weight
    if weight is None:
        return None
    free = np.diag(weight)[3 * seen] < 10.0
    if (~free).sum() <= 3:
        return None
    t = len(state.body)
    Q = adjusted.design.reduced_inverse[-3 * t :, -3 * t :]
    usable = seen[~free]
    scan = scan_targets(state.unknowns.points, state.prior.points, weight, Q, usable)
    i = int(usable[np.argmax(scan.statistic[usable])])
    if scan.statistic[i] < _TARGET_LIMIT * max(1.0, scan.rest[i] / float(stats.chi2.median(3))):
        return None
    ident = int(state.body.ids[i])
    size = 1e3 * np.linalg.norm(scan.error[i])
    text = f"target {ident} of body {state.body.name} is {size:.3g} mm from its place in the file"
    return StationCause(
        TARGET_SHIFTED, str(ident), None, None, scan.error[i], scan.covariance[i], float(scan.statistic[i]), 3, text
    )


def drop_insignificant(state: StationState, adjusted: Adjusted) -> Adjusted:
    """Return groups of the interior orientation to their start values that the images do not support.

    Backward elimination, highest orders first, by Wald tests at ``settings.significance``.
    """
    if state.settings.intrinsics != "auto":
        return adjusted
    e = len(state.exterior_camera)
    for group in _ORDER:
        changed = False
        offset = interior_offset(state.unknowns, state.prior)
        for c in range(len(state.names)):
            if group not in state.groups[c] or group in state.kept[c]:
                continue
            at = 6 * e + 9 * c + np.array(GROUPS[group])
            Q = adjusted.design.reduced_inverse[np.ix_(at, at)]
            d = offset[c, list(GROUPS[group])]
            statistic = float(d @ np.linalg.solve(Q, d))
            if stats.chi2.sf(statistic, len(at)) > state.settings.significance:
                state.groups[c] = state.groups[c] - {group}
                _reset(state, c, group)
                changed = True
        if changed:
            adjusted = state.adjust(2.0)
    return adjusted


def _reset(state: StationState, c: int, group: str) -> None:
    numbers = state.unknowns.interior
    start = state.prior.interior[c]
    if group == "affinity":
        mean = 0.5 * (numbers[c, 0] + numbers[c, 1])
        numbers[c, :2] = mean * start[:2] / (0.5 * (start[0] + start[1]))
    elif group == "focal":
        numbers[c, :2] = start[:2]
    else:
        numbers[c, list(GROUPS[group])] = start[list(GROUPS[group])]


def snoop(state: StationState) -> tuple[Adjusted, tuple[RejectedMark, ...]]:
    """Leave out isolated gross errors, the worst mark of each image at a time, until all normalised residuals fit.

    Test: ``r' R^-1 r`` per mark with R its redundancy matrix (two degrees of freedom). Marks without redundancy cannot
    be tested and stay.
    """
    rejected: list[RejectedMark] = []
    limit = float(stats.chi2.isf(2 * stats.norm.sf(state.settings.critical), 2))
    # Gross errors are detected by the median's scale, which they do not spoil; what is merely large is then judged by
    # the root mean square, so that measurements with somewhat long tails are not thinned out.
    for robust, level in ((True, 4.0 * limit), (False, limit)):
        state.update_noise(state.adjust(None), robust=robust)
        adjusted = state.adjust(None)
        for _ in range(20):
            T2 = mark_statistic(adjusted.design.residual, state.redundancy(adjusted))
            image = state.marks.camera * len(state.poses) + state.marks.pose
            worst = np.zeros(int(image.max()) + 1)
            np.maximum.at(worst, image, T2)
            out = (level < T2) & (worst[image] == T2)
            if not out.any():
                break
            rejected += [
                RejectedMark(
                    state.names[state.marks.camera[i]],
                    int(state.poses[state.marks.pose[i]]),
                    int(state.body.ids[state.marks.target[i]]),
                    f"residual {np.sqrt(T2[i]):.1f} standard deviations",
                )
                for i in np.flatnonzero(out)
            ]
            state.drop(out)
            adjusted = state.adjust(None)
            state.update_noise(adjusted, robust=robust)
    for _ in range(3):
        state.update_noise(adjusted, robust=False)
        adjusted = state.adjust(None)
    return adjusted, tuple(rejected)


def mark_statistic(residual: np.ndarray, redundancy: np.ndarray) -> np.ndarray:
    """(m,) ``r' R^-1 r`` of whitened residuals (m, 2) with redundancy matrices (m, 2, 2); 0 without redundancy."""
    values, vectors = np.linalg.eigh(0.5 * (redundancy + np.swapaxes(redundancy, -1, -2)))
    along = np.einsum("mij,mi->mj", vectors, residual)
    good = values > 1e-4
    return np.sum(np.where(good, along**2 / np.where(good, values, 1.0), 0.0), axis=1)
