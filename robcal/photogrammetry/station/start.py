"""Start values of a station: focal lengths where unknown, resections, relative orientation of the cameras by vote."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from robcal.errors import DegenerateGeometry, InvalidInput
from robcal.photogrammetry.core.bodies import Body, IntArray
from robcal.photogrammetry.core.camera import Camera
from robcal.photogrammetry.orientation.resection import Resection, Rig, TargetMarks, refine_poses, resect_images
from robcal.photogrammetry.station.network import StationMarks
from robcal.transforms import Array, difference, invert, retract

_FOCAL_FACTORS = np.geomspace(0.45, 12.0, 15)
"""Focal length by longer image side, from fish-eye-like to long tele lenses."""

_VOTE_ANGLE = np.radians(3.0)
_VOTE_SHARE = 0.06


@dataclass(frozen=True)
class ImageStart:
    """Resection of one image: camera index, pose number, rows of the camera's marks, candidate poses camera_T_body."""

    camera: int
    pose: int
    rows: IntArray
    candidates: tuple[Array, ...]
    resection: Resection


def focal_start(marks: StationMarks, body: Body, size: tuple[int, int], sigma_px: float) -> Camera:
    """Camera from the image size alone: the focal length with the best resections of the twelve richest images.

    Weakness: lens distortion is not modelled here, and frontal views of a plane contain no information on the focal
    length; the adjustment that follows needs only the order of magnitude.

    Raises
    ------
    DegenerateGeometry : no image has four targets for a resection.
    """
    poses, counts = np.unique(marks.pose, return_counts=True)
    order = np.argsort(-counts, kind="stable")[:12]
    chosen = poses[order[counts[order] >= 4]]
    if len(chosen) == 0:
        raise DegenerateGeometry("no image shows four or more targets: give a camera file with start values")
    rows = np.isin(marks.pose, chosen)
    image = np.searchsorted(np.sort(chosen), marks.pose[rows])
    ids, xy, covariance = marks.target[rows], marks.xy[rows], marks.covariance[rows] + sigma_px**2 * np.eye(2)

    def score(factor: float) -> float:
        camera = Camera.from_size(*size, focal_factor=factor)
        fits = resect_images(camera, image, ids, xy, covariance, body, gate=1e6)
        values = [r.chi2 / max(1, r.redundancy) if isinstance(r, Resection) else 1e12 for r in fits]
        return float(np.median(values))

    scores = [score(f) for f in _FOCAL_FACTORS]
    best = int(np.argmin(scores))
    lo, hi = np.log(_FOCAL_FACTORS[max(0, best - 1)]), np.log(_FOCAL_FACTORS[min(len(scores) - 1, best + 1)])
    trials = np.exp(np.linspace(lo, hi, 9))
    return Camera.from_size(*size, focal_factor=float(trials[int(np.argmin([score(f) for f in trials]))]))


def resect_station(
    names: Sequence[str], marks: Sequence[StationMarks], cameras: Sequence[Camera], body: Body, sigma_px: float
) -> tuple[list[ImageStart], list[tuple[int, int, str]]]:
    """Resections of all images; second: (camera, pose, reason) of images without one."""
    starts: list[ImageStart] = []
    failed: list[tuple[int, int, str]] = []
    for c in range(len(names)):
        m = marks[c]
        poses, image = np.unique(m.pose, return_inverse=True)
        covariance = m.covariance + sigma_px**2 * np.eye(2)
        fits = resect_images(cameras[c], image.astype(np.int64), m.target, m.xy, covariance, body)
        for i, (pose, fit) in enumerate(zip(poses, fits, strict=True)):
            if isinstance(fit, DegenerateGeometry):
                failed.append((c, int(pose), str(fit)))
                continue
            candidates = (fit.camera_T_body,) if fit.alternative is None else (fit.camera_T_body, fit.alternative)
            rows = np.flatnonzero((image == i) & fit.inliers)
            starts.append(ImageStart(c, int(pose), rows, candidates, fit))
    return starts, failed


LEAST_MISFIT = 0.25
"""Mean square misfit, in the errors that start values may cause, below which no targets are exchanged."""


def find_swap(
    marks: Sequence[StationMarks], cameras: Sequence[Camera], body: Body, sigma_px: float, images: Sequence[ImageStart]
) -> tuple[int, int] | None:
    """Two targets (body rows) whose exchange makes the images fit that do not fit as they are; None without need.

    Only small bodies (up to 12 targets) need this: in larger ones a resection leaves both out and the exchange shows in
    the measured points.
    """
    known = np.flatnonzero(body.known)
    if not 4 <= len(known) <= 12:
        return None
    richest = sorted(images, key=lambda s: -int(np.sum(marks[s.camera].pose == s.pose)))[:8]
    if not richest:
        return None

    def misfit(trial: Body) -> float:
        values = []
        for s in richest:
            m = marks[s.camera]
            rows = np.flatnonzero(m.pose == s.pose)
            image = np.zeros(len(rows), dtype=np.int64)
            covariance = m.covariance[rows] + sigma_px**2 * np.eye(2)
            fit = resect_images(cameras[s.camera], image, m.target[rows], m.xy[rows], covariance, trial, gate=1e6)[0]
            values.append(fit.chi2 / max(1, fit.redundancy) if isinstance(fit, Resection) else 1e12)
        return float(np.median(values))

    before = misfit(body)  # a body of few targets fits fairly well with two exchanged, in a mirrored pose
    if before < LEAST_MISFIT:
        return None
    trials = [(misfit(exchanged(body, int(i), int(j))), int(i), int(j)) for i, j in combinations(known, 2)]
    after, i, j = min(trials)
    return (i, j) if after < 4.0 and after < 0.02 * before else None


def exchanged(body: Body, i: int, j: int) -> Body:
    """The body with the coordinates of two rows exchanged (and their covariances)."""
    order = np.arange(len(body))
    order[[i, j]] = order[[j, i]]
    columns = (3 * order[:, None] + np.arange(3)).ravel()
    covariance = None if body.covariance is None else body.covariance[np.ix_(columns, columns)]
    return replace(body, points=body.points[order], covariance=covariance)


def vote_relative(first: Sequence[Sequence[Array]], second: Sequence[Sequence[Array]]) -> tuple[Array, Array]:
    """Relative orientation a_T_b that most common poses agree with, among all candidates of both cameras.

    Parameters
    ----------
    first, second : per common pose the candidate frames a_T_body and b_T_body (two where a plane is ambiguous).

    Returns
    -------
    a_T_b (4, 4) and the support (n,) in 0 .. 1 of each pose.
    """
    relatives, owner, distance = [], [], []
    for i, (us, vs) in enumerate(zip(first, second, strict=True)):
        for u in us:
            for v in vs:
                relatives.append(u @ invert(v))
                owner.append(i)
                distance.append(np.linalg.norm(v[:3, 3]))
    T, own, reach = np.array(relatives), np.array(owner), np.array(distance)
    d = difference(T[:, None], T[None])
    # the relative position is only known through the rotation times the distance: judge both against generous limits
    size = (np.linalg.norm(d[..., 3:], axis=-1) / _VOTE_ANGLE) ** 2
    size += (np.linalg.norm(d[..., :3], axis=-1) / (_VOTE_SHARE * reach)) ** 2
    agreement = np.exp(-0.5 * size)
    n = len(first)
    per_pose = np.zeros((len(T), n))
    for i in range(n):
        per_pose[:, i] = agreement[:, own == i].max(axis=1)
    best = int(np.argmax(per_pose.sum(axis=1)))
    mean = T[best]
    for _ in range(5):
        d = difference(mean, T)
        size = (np.linalg.norm(d[:, 3:], axis=-1) / _VOTE_ANGLE) ** 2
        size += (np.linalg.norm(d[:, :3], axis=-1) / (_VOTE_SHARE * reach)) ** 2
        w = np.exp(-0.5 * size)
        for i in range(n):
            rows = own == i
            w[rows] = np.where(w[rows] == w[rows].max(), w[rows], 0.0)
        mean = retract(mean, (w[:, None] * d).sum(axis=0) / w.sum())
    return mean, np.array([w[own == i].max() for i in range(n)])


def connect_cameras(
    names: Sequence[str], starts: Sequence[ImageStart], world_T_camera: Mapping[str, Array]
) -> tuple[Array, list[int], list[tuple[int, int]]]:
    """Exterior orientations from poses that cameras share, along the best supported tree.

    Returns
    -------
    world_T_camera (c, 4, 4), the cameras that define the world (held fixed; one per connected group), and
    (camera, pose) of images that contradict the relative orientation found.

    Raises
    ------
    InvalidInput : a camera shares no pose with the others and its place in the world is not given either.
    """
    c = len(names)
    by_camera: list[dict[int, tuple[Array, ...]]] = [{} for _ in range(c)]
    for s in starts:
        by_camera[s.camera][s.pose] = s.candidates
    pairs = _related_cameras(names, by_camera)
    against: Counter[tuple[int, int]] = Counter()
    for pair in pairs:
        for p, support in zip(pair.poses, pair.support, strict=True):
            worth = 1 if support < 0.01 and len(pair.poses) > 2 else -1
            against.update({(camera, p): worth for camera in (pair.first, pair.second)})
    bad = [key for key, n in against.items() if n > 0]
    stated = [i for i, name in enumerate(names) if name in world_T_camera]
    given = {i: np.asarray(world_T_camera[names[i]]) for i in stated}
    placed: dict[int, Array] = {}
    fixed: list[int] = []
    root = stated[0] if stated else 0
    while True:
        fixed.append(root)
        placed[root] = given.get(root, np.eye(4))
        _place_related(placed, pairs)
        left = [i for i in range(c) if i not in placed]
        if not left:
            break
        roots = [i for i in left if i in given]
        if not roots:
            raise InvalidInput(
                f"camera {names[left[0]]} shares no pose with {names[root]}: it cannot be oriented. Record poses in "
                "which both see at least three targets, or state world_T_camera in its camera file"
            )
        root = roots[0]
    return np.array([placed[i] for i in range(c)]), fixed, bad


@dataclass(frozen=True)
class _Pair:
    """Two cameras with a relative orientation, and how far (0 .. 1) each of their common poses supports it."""

    first: int
    second: int
    first_T_second: Array
    poses: list[int]
    support: Array


def _related_cameras(names: Sequence[str], by_camera: Sequence[Mapping[int, tuple[Array, ...]]]) -> list[_Pair]:
    """All pairs of cameras that share poses."""
    pairs: list[_Pair] = []
    for a, b in combinations(range(len(names)), 2):
        common = sorted(set(by_camera[a]) & set(by_camera[b]))
        if not common:
            continue
        a_T_b, support = vote_relative([by_camera[a][p] for p in common], [by_camera[b][p] for p in common])
        if len(common) >= 5 and (support > 0.01).sum() < 0.5 * len(common):
            _refuse_slipped(names[a], names[b], by_camera[a], by_camera[b], int((support > 0.1).sum()), len(common))
        pairs.append(_Pair(a, b, a_T_b, common, support))
    return pairs


def _place_related(placed: dict[int, Array], pairs: Sequence[_Pair]) -> None:
    """Place all cameras that are linked to one placed already, along the best supported links."""
    while usable := [p for p in pairs if (p.first in placed) != (p.second in placed)]:
        best = max(usable, key=lambda p: float(p.support.sum()))
        if best.first in placed:
            placed[best.second] = placed[best.first] @ best.first_T_second
        else:
            placed[best.first] = placed[best.second] @ invert(best.first_T_second)


def _refuse_slipped(
    first: str, second: str, a: Mapping[int, tuple[Array, ...]], b: Mapping[int, tuple[Array, ...]], agree: int, n: int
) -> None:
    """Report that two cameras do not see the same poses, and whether a shift of the numbering would correct it."""
    for shift in (1, -1, 2, -2, 3, -3):
        common = sorted(p for p in a if p + shift in b)
        if len(common) < 5:
            continue
        support = vote_relative([a[p] for p in common], [b[p + shift] for p in common])[1]
        if support.sum() > 0.7 * len(common):
            when = "later" if shift > 0 else "earlier"
            raise InvalidInput(
                f"the images of camera {second} are slipped by {abs(shift)} against those of {first} (what "
                f"{first} shows in a pose, {second} shows {abs(shift)} {when}; so they agree in "
                f"{int((support > 0.1).sum())} of {len(common)} poses): rename them"
            )
    raise InvalidInput(
        f"cameras {first} and {second} agree on one relative orientation in only {agree} of {n} common poses: a camera "
        "moved between poses, images do not belong to these poses, or the targets are misnumbered"
    )


def start_bodies(
    starts: Sequence[ImageStart],
    marks: Sequence[StationMarks],
    cameras: Sequence[Camera],
    world_T_camera: Array,
    body: Body,
    sigma_px: float,
) -> dict[int, tuple[Array, float, float, int]]:
    """Body pose of each pose number: the candidate that fits all cameras best.

    Returns pose number -> (world_T_body, cost, cost of the second distinct solution, number of cameras).
    """
    by_pose: dict[int, list[ImageStart]] = {}
    for s in starts:
        by_pose.setdefault(s.pose, []).append(s)
    candidates, owner = [], []
    for pose, images in by_pose.items():
        for s in images:
            for T in s.candidates:
                candidates.append(world_T_camera[s.camera] @ T)
                owner.append(pose)
    which, camera = [], []
    parts: list[TargetMarks] = []
    for k, pose in enumerate(owner):
        for s in by_pose[pose]:
            m = marks[s.camera]
            which.append(np.full(len(s.rows), k))
            camera.append(np.full(len(s.rows), s.camera))
            covariance = m.covariance[s.rows] + sigma_px**2 * np.eye(2)
            parts.append(TargetMarks(body.points[body.index(m.target[s.rows])], m.xy[s.rows], covariance))
    rig = Rig(np.concatenate(camera), cameras, world_T_camera)
    fit = refine_poses(np.array(candidates), np.concatenate(which), TargetMarks.concatenated(parts), rig)
    out: dict[int, tuple[Array, float, float, int]] = {}
    own = np.array(owner)
    for pose, images in by_pose.items():
        rows = np.flatnonzero(own == pose)
        rows = rows[np.argsort(fit.cost[rows])]
        best = fit.reference_T_body[rows[0]]
        second = np.inf
        for other in rows[1:]:
            if np.trace(best[:3, :3].T @ fit.reference_T_body[other][:3, :3]) < 3 - 1e-4:
                second = float(fit.cost[other])
                break
        out[pose] = (best, float(fit.cost[rows[0]]), second, len(images))
    return out
