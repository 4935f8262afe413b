"""Orientation of a station: joint adjustment of fixed cameras from a body that was shown to them in many poses."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from robcal.errors import DegenerateGeometry, InvalidInput, NotIdentifiable
from robcal.photogrammetry.core.bodies import Body
from robcal.photogrammetry.core.camera import Camera
from robcal.photogrammetry.station.adjustment import Adjusted, covariance_blocks, interior_basis, interior_offset
from robcal.photogrammetry.station.assembly import StationInput, StationStart, assemble
from robcal.photogrammetry.station.cleaning import drop_insignificant, resolve_contradictions, snoop
from robcal.photogrammetry.station.contradictions import LENS_AFFINITY, LENS_RADIAL, LENS_TANGENTIAL, TARGET_SWAPPED
from robcal.photogrammetry.station.network import (
    GROUPS,
    RejectedMark,
    StationCause,
    StationMarks,
    StationOrientation,
    StationSettings,
)
from robcal.photogrammetry.station.start import (
    ImageStart,
    connect_cameras,
    exchanged,
    find_swap,
    focal_start,
    resect_station,
    start_bodies,
)
from robcal.photogrammetry.station.state import StationState
from robcal.transforms import Array


def orient_station(
    observations: Mapping[str, StationMarks],
    body: Body,
    cameras: Mapping[str, Camera | None],
    sizes: Mapping[str, tuple[int, int]],
    world_T_camera: Mapping[str, Array] | None = None,
    settings: StationSettings | None = None,
) -> StationOrientation:
    """Orient the cameras of a station.

    Parameters
    ----------
    observations : camera name -> identified marks; the first camera defines the world unless one is stated.
    body : with coordinates (and their covariance) that carry the scale.
    cameras : start values of the interior orientation, None: from the image size alone.
    sizes : camera name -> (width, height) px, used where there are no start values.
    world_T_camera : exterior orientations stated in camera files; the first stated one defines the world, the others
        serve only for cameras that nothing else connects.
    settings : see :class:`StationSettings`.

    Raises
    ------
    InvalidInput : no marks at all, marks of unknown targets, or a camera that nothing connects with the others.
    DegenerateGeometry : no image carries a pose (fewer than three known targets, or all in one line).
    NotIdentifiable : the images leave unknowns undetermined.
    """
    options = settings or StationSettings()
    names = tuple(observations)
    if not names:
        raise InvalidInput("a station needs at least one camera")
    known = body.known
    if known.sum() < 3:
        raise DegenerateGeometry(
            f"body {body.name} has {known.sum()} targets with coordinates; orienting a station needs three or more"
        )
    marks = tuple(_usable(name, observations[name], body) for name in names)
    start = tuple(
        given if (given := cameras.get(n)) is not None else _self_calibrated(n, m, body, sizes[n], options, len(names))
        for n, m in zip(names, marks, strict=True)
    )
    station, images, failed, evidence = _resected(StationInput(names, marks, body, cameras, options), start)
    rejected = [RejectedMark(names[c], p, -1, reason, "no_pose") for c, p, reason in failed]
    connected, ambiguous, contradicting = _connected(station, start, images, dict(world_T_camera or {}))
    state = assemble(station, connected)
    cleaned = resolve_contradictions(state, state.robust_adjustment())
    drop_insignificant(state, cleaned.adjusted)
    adjusted, outliers = snoop(state)
    evidence += [*cleaned.evidence, *_lens_evidence(state, adjusted, cameras)]
    resection = _left_out_by_resection(names, marks, connected.images)
    left = _with_recurring([*contradicting, *rejected, *resection, *cleaned.rejected, *outliers], marks)
    return _result(state, adjusted, ambiguous, tuple(evidence), left)


def _resected(
    station: StationInput, start: Sequence[Camera]
) -> tuple[StationInput, list[ImageStart], list[tuple[int, int, str]], list[StationCause]]:
    """Resections of all images, (camera, pose, reason) of those without one; two swapped targets are exchanged."""
    names, marks, body, sigma = station.names, station.marks, station.body, station.settings.default_sigma_px
    images, failed = resect_station(names, marks, start, body, sigma)
    if not images:
        reason = failed[0][2] if failed else "no marks"
        raise DegenerateGeometry(f"no image of the station carries a pose of body {body.name}: {reason}")
    swap = find_swap(marks, start, body, sigma, images)
    if swap is None:
        return station, images, failed, []
    exchange = exchanged(body, *swap)
    return (
        replace(station, body=exchange),
        *resect_station(names, marks, start, exchange, sigma),
        [_swap_evidence(body, *swap)],
    )


def _connected(
    station: StationInput, start: tuple[Camera, ...], images: list[ImageStart], stated: dict[str, Array]
) -> tuple[StationStart, tuple[int, ...], list[RejectedMark]]:
    """Start values of the whole station, ambiguous poses, and images that contradict the other cameras."""
    names = station.names
    exterior, fixed, contradicting = connect_cameras(names, images, stated)
    rejected = [
        RejectedMark(names[c], p, -1, "image contradicts the other cameras: another pose shown?", "contradiction")
        for c, p in sorted(set(contradicting))
    ]
    good = [s for s in images if (s.camera, s.pose) not in set(contradicting)]
    if not good:
        raise DegenerateGeometry("the cameras contradict one another in every pose: images of different poses")
    bodies = start_bodies(good, station.marks, start, exterior, station.body, station.settings.default_sigma_px)
    ambiguous = [p for p, (_, cost, second, n) in bodies.items() if n == 1 and second < cost + 14 * max(1.0, cost / 4)]
    several = any(n > 1 for _, _, _, n in bodies.values())
    use = {p: T for p, (T, _, _, _) in bodies.items() if not several or p not in ambiguous}
    return StationStart(start, exterior, tuple(fixed), tuple(good), use), tuple(sorted(ambiguous)), rejected


def _self_calibrated(
    name: str, marks: StationMarks, body: Body, size: tuple[int, int], options: StationSettings, cameras: int
) -> Camera:
    """Start values of a camera without a file: from the image size; in a station of several, by itself first."""
    start = focal_start(marks, body, size, options.default_sigma_px)
    if cameras == 1:
        return start
    alone = replace(options, intrinsics="auto", detect_moves=False, detect_targets=False, epochs={})
    try:
        return orient_station({name: marks}, body, {name: None}, {name: size}, settings=alone).cameras[0]
    except NotIdentifiable:  # one camera alone may see too little (frontal views only); the others will help
        return start


def _swap_evidence(body: Body, i: int, j: int) -> StationCause:
    a, b = int(body.ids[i]), int(body.ids[j])
    text = TARGET_SWAPPED.describe(str(a), {"with": b})
    shift = body.points[j] - body.points[i]
    return StationCause(
        TARGET_SWAPPED, str(a), None, None, shift, np.zeros((3, 3)), float("inf"), 3, text, partner=str(b)
    )


def _left_out_by_resection(
    names: tuple[str, ...], marks: Sequence[StationMarks], images: Sequence[ImageStart]
) -> list[RejectedMark]:
    """Marks that the pose of their own image leaves far off."""
    out = []
    for s in images:
        m = marks[s.camera]
        for i in np.setdiff1d(np.flatnonzero(m.pose == s.pose), s.rows):
            reason = "far from where the pose of its image puts it"
            out.append(RejectedMark(names[s.camera], s.pose, int(m.target[i]), reason))
    return out


def _with_recurring(rejected: list[RejectedMark], marks: Sequence[StationMarks]) -> tuple[RejectedMark, ...]:
    """Where most marks of a target were left out it is the target, not the marks: they keep being measured."""
    seen: dict[int, int] = {}
    for m in marks:
        for t, n in zip(*np.unique(m.target, return_counts=True), strict=True):
            seen[int(t)] = seen.get(int(t), 0) + int(n)
    gone: dict[int, int] = {}
    for r in rejected:
        if r.kind == "outlier":
            gone[r.target] = gone.get(r.target, 0) + 1
    often = {t for t, n in gone.items() if n > 0.5 * seen.get(t, 1) and n >= 5}
    return tuple(replace(r, kind="recurring") if r.kind == "outlier" and r.target in often else r for r in rejected)


def _usable(name: str, marks: StationMarks, body: Body) -> StationMarks:
    at = body.index(marks.target)
    if np.any(at < 0):
        row = int(np.flatnonzero(at < 0)[0])
        raise InvalidInput(
            f"camera {name}, pose {marks.pose[row]}: target {marks.target[row]} is not on body {body.name}"
        )
    keep = body.known[at]
    key = np.column_stack([marks.pose[keep], marks.target[keep]])
    values, counts = np.unique(key, axis=0, return_counts=True)
    if np.any(counts > 1):
        pose, target = values[counts > 1][0]
        raise InvalidInput(f"camera {name}, pose {pose}: target {target} is measured more than once")
    return StationMarks(marks.pose[keep], marks.target[keep], marks.xy[keep], marks.covariance[keep])


def _lens_evidence(
    state: StationState, adjusted: Adjusted, given: Mapping[str, Camera | None]
) -> tuple[StationCause, ...]:
    """Groups that are zero in a camera's file and yet significant in the images."""
    out: list[StationCause] = []
    e = len(state.exterior_camera)
    offset = interior_offset(state.unknowns, state.prior)
    groups_of = {LENS_RADIAL: ("k1", "k2", "k3"), LENS_TANGENTIAL: ("tangential",), LENS_AFFINITY: ("affinity",)}
    for c, name in enumerate(state.names):
        if given.get(name) is None or state.settings.intrinsics == "fixed":
            continue
        for kind, groups in groups_of.items():
            found = [g for g in groups if g in state.groups[c]]
            if not found or any(g in state.kept[c] for g in groups):
                continue
            numbers = [i for g in found for i in GROUPS[g]]
            at = 6 * e + 9 * c + np.array(numbers)
            Q = adjusted.design.reduced_inverse[np.ix_(at, at)]
            d = offset[c, numbers]
            statistic = float(d @ np.linalg.solve(Q, d))
            text = f"camera {name} has {kind.words} ({', '.join(found)}) that its file does not have"
            out.append(StationCause(kind, name, None, None, d, Q, statistic, len(at), text))
    return tuple(out)


def _result(
    state: StationState,
    adjusted: Adjusted,
    ambiguous: tuple[int, ...],
    evidence: tuple[StationCause, ...],
    rejected: tuple[RejectedMark, ...],
) -> StationOrientation:
    marks, design, x = state.marks, adjusted.design, state.unknowns
    e, c = len(state.exterior_camera), len(state.names)
    Qpp, R = covariance_blocks(design, marks, e, c)
    diagonal = np.einsum("mii->mi", R)
    total = float(diagonal.sum())
    raw = design.residual * state.noise[marks.camera][:, None]
    sigma0 = float(np.sqrt(np.sum(raw**2) / total)) if total > 0 else float("nan")
    pixels = np.einsum("mij,mj->mi", np.linalg.inv(design.whitening), design.residual)
    cameras_of_pose = np.zeros((len(state.poses), c), dtype=bool)
    cameras_of_pose[marks.pose, marks.camera] = True
    with np.errstate(divide="ignore", invalid="ignore"):
        w = np.where(diagonal > 1e-4, design.residual / np.sqrt(np.maximum(diagonal, 1e-12)), 0.0)
    return StationOrientation(
        names=state.names,
        cameras=tuple(camera.with_vector(x.interior[i]) for i, camera in enumerate(state.start)),
        exterior_camera=state.exterior_camera,
        exterior_first_pose=state.exterior_first,
        world_T_exterior=x.world_T_exterior,
        covariance=_station_covariance(state, adjusted),
        poses=state.poses,
        world_T_body=x.world_T_body,
        body_covariance=Qpp,
        pose_cameras=cameras_of_pose.sum(axis=1),
        ambiguous_poses=ambiguous,
        body=_adjusted_body(state, adjusted),
        marks=marks,
        design=design,
        redundancy=diagonal,
        w=w,
        sigma0=sigma0,
        noise=dict(zip(state.names, map(float, state.noise), strict=True)),
        redundancy_total=total,
        rms_px=float(np.sqrt(np.mean(pixels**2))),
        rejected=rejected,
        evidence=evidence,
        free_interior={name: tuple(g for g in GROUPS if g in state.groups[i]) for i, name in enumerate(state.names)},
        converged=adjusted.summary.converged,
        iterations=adjusted.summary.iterations,
        prior=state.prior,
    )


def _station_covariance(state: StationState, adjusted: Adjusted) -> Array:
    """Covariance of exterior and interior orientations, the interior in its nine parameters."""
    e, c = len(state.exterior_camera), len(state.names)
    size = 6 * e + 9 * c
    to_parameters = np.eye(size)
    for i, basis in enumerate(interior_basis(state.unknowns.interior)):
        at = slice(6 * e + 9 * i, 6 * e + 9 * i + 9)
        to_parameters[at, at] = basis
    return to_parameters @ adjusted.design.reduced_inverse[:size, :size] @ to_parameters.T


def _adjusted_body(state: StationState, adjusted: Adjusted) -> Body:
    """The body with adjusted coordinates; targets that no image shows keep their given ones and their covariance."""
    t = len(state.body)
    seen = np.isin(np.arange(t), state.marks.target)
    C = adjusted.design.reduced_inverse[-3 * t :, -3 * t :].copy()
    if state.body.covariance is not None and not seen.all():
        unseen = (3 * np.flatnonzero(~seen)[:, None] + np.arange(3)).ravel()
        C[np.ix_(unseen, unseen)] = state.body.covariance[np.ix_(unseen, unseen)]
    points = np.where(seen[:, None], state.unknowns.points, state.body.points)
    return replace(state.body, points=points, covariance=C)
