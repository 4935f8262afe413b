"""From start values of cameras and body poses to the state that the adjustments of a station work on."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from robcal.errors import InvalidInput
from robcal.photogrammetry.core.adjustable import adjustable_names
from robcal.photogrammetry.core.bodies import Body, IntArray
from robcal.photogrammetry.core.camera import INTRINSIC_NAMES, Camera
from robcal.photogrammetry.station.adjustment import interior_prior
from robcal.photogrammetry.station.network import GROUPS, MarkTable, Prior, StationMarks, StationSettings, Unknowns
from robcal.photogrammetry.station.start import ImageStart
from robcal.photogrammetry.station.state import StationState
from robcal.transforms import Array

_TRUST = 0.1
"""Start values from a camera file may be off by a tenth of what is possible for an unknown lens."""


@dataclass(frozen=True)
class StationInput:
    """What a station is given: usable marks per camera, the body, interior orientations from files or None."""

    names: tuple[str, ...]
    marks: tuple[StationMarks, ...]
    body: Body
    given: Mapping[str, Camera | None]
    settings: StationSettings


@dataclass(frozen=True)
class StationStart:
    """Start values: cameras, their exterior orientations (c, 4, 4), those that define the world, body poses.

    ``images`` with their usable marks; ``bodies``: pose number -> world_T_body (4, 4).
    """

    cameras: tuple[Camera, ...]
    exterior: Array
    fixed: tuple[int, ...]
    images: tuple[ImageStart, ...]
    bodies: Mapping[int, Array]


def interior_groups(
    names: Sequence[str], cameras: Mapping[str, Camera | None], settings: StationSettings
) -> tuple[list[set[str]], list[set[str]]]:
    """Per camera the groups that are tried, and those that are never dropped (given in its file and not zero)."""
    tried: list[set[str]] = []
    kept: list[set[str]] = []
    for name in names:
        camera = cameras.get(name)
        groups = set(GROUPS) if camera is None else _carried(camera)
        tried.append(set() if settings.intrinsics == "fixed" else groups)
        if settings.intrinsics != "auto":
            kept.append(set(tried[-1]))
            continue
        keep = {"focal", "principal"}
        if camera is not None:
            keep |= {n for n in ("k1", "k2", "k3") if getattr(camera, n) != 0.0}
            keep |= {"tangential"} if camera.p1 or camera.p2 else set()
            keep |= {"affinity"} if camera.fx != camera.fy else set()
        kept.append(keep & tried[-1])
    return tried, kept


def _carried(camera: Camera) -> set[str]:
    """Groups of numbers that the camera's lens has."""
    have = {INTRINSIC_NAMES.index(name) for name in adjustable_names(camera)}
    return {group for group, numbers in GROUPS.items() if set(numbers) <= have}


def assemble(station: StationInput, start: StationStart) -> StationState:
    """One table of all marks of the poses in ``start.bodies``, start values of all unknowns and their priors.

    Raises
    ------
    InvalidInput : the settings name a camera that the station does not have.
    """
    names, body, settings = station.names, station.body, station.settings
    poses = np.array(sorted(start.bodies), dtype=np.int64)
    marks = _mark_table(station, start, poses)
    unknowns = Unknowns(
        np.array([camera.vector for camera in start.cameras]),
        np.array(start.exterior, dtype=float),
        np.array([start.bodies[int(p)] for p in poses]),
        np.where(body.known[:, None], body.points, 0.0),
    )
    known = [station.given.get(name) is not None for name in names]
    # without a file the prior is a lens without distortion, wherever the start values already are
    expected = [c if k else _without_distortion(c) for c, k in zip(start.cameras, known, strict=True)]
    sigma = [interior_prior(c) * (_TRUST if k else 1.0) for c, k in zip(start.cameras, known, strict=True)]
    prior = Prior(
        np.array([camera.vector for camera in expected]),
        np.array(sigma),
        unknowns.points.copy(),
        body_weight(body, marks, unknowns, start.cameras, settings),
    )
    tried, kept = interior_groups(names, station.given, settings)
    state = StationState(
        names,
        start.cameras,
        body,
        settings,
        marks,
        unknowns,
        prior,
        tried,
        kept,
        noise=np.ones(len(names)),
        exterior_camera=np.arange(len(names)),
        exterior_first=np.full(len(names), poses[0]),
        fixed=start.fixed,
        poses=poses,
    )
    for name, changes in settings.epochs.items():
        if name not in names:
            raise InvalidInput(f"epochs name a camera {name} that the station does not have: {', '.join(names)}")
        for pose in sorted(changes):
            state.add_epoch(names.index(name), pose)
    for row in body.index(np.array(settings.free_targets, dtype=np.int64)):
        if row >= 0:
            state.release_target(int(row))
    return state


def _mark_table(station: StationInput, start: StationStart, poses: IntArray) -> MarkTable:
    """Marks of the images whose body poses are known; each camera has one exterior orientation."""
    body = station.body
    columns = []
    for image in start.images:
        if image.pose not in start.bodies:
            continue
        m, rows = station.marks[image.camera], image.rows
        camera, pose = np.full(len(rows), image.camera), np.full(len(rows), np.searchsorted(poses, image.pose))
        columns.append((camera, pose, body.index(m.target[rows]), m.xy[rows], m.covariance[rows]))
    camera, pose, target, xy, covariance = (np.concatenate(column) for column in zip(*columns, strict=True))
    radius, normals = 0.5 * body.diameters, body.estimated_normals()
    return MarkTable(camera, camera.copy(), pose, target, xy, covariance, radius[target], normals[target])


def _without_distortion(camera: Camera) -> Camera:
    """A camera of the same size and mean focal length, centred and without distortion."""
    f = 0.5 * (camera.fx + camera.fy)
    return Camera(camera.width, camera.height, f, f, 0.5 * (camera.width - 1), 0.5 * (camera.height - 1))


def body_weight(
    body: Body, marks: MarkTable, unknowns: Unknowns, start: Sequence[Camera], settings: StationSettings
) -> Array:
    """Inverse covariance (3t, 3t) of the given coordinates.

    A surveyed body's covariance is singular along the motions of its own datum; there the coordinates are held a
    hundred times tighter than they are known otherwise. Coordinates without covariance get 2 % of the size of a mark's
    error in space (or ``body_sigma``): too tight to move, loose enough to be tested.
    """
    t = len(body)
    if body.covariance is not None:
        C = np.array(body.covariance)
        C = np.where(np.isfinite(C), C, 0.0)
        return np.asarray(np.linalg.inv(C + max(1e-4 * float(np.mean(np.diag(C))), 1e-18) * np.eye(3 * t)))
    sight = unknowns.world_T_exterior[marks.exterior][:, :3, 3] - unknowns.world_T_body[marks.pose][:, :3, 3]
    f = np.array([camera.fx for camera in start])[marks.camera]
    size = np.linalg.norm(sight, axis=1) / f * np.sqrt(np.einsum("mii->m", marks.covariance) / 2)
    return np.eye(3 * t) / max(0.02 * float(np.median(size)), settings.body_sigma) ** 2
