"""State of a station while it is being oriented: assembling the unknowns, robust adjustment, noise per camera."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from robcal.errors import InvalidInput
from robcal.photogrammetry.core.bodies import Body, IntArray
from robcal.photogrammetry.core.camera import Camera
from robcal.photogrammetry.station.adjustment import (
    Adjusted,
    Prior,
    adjust_station,
    covariance_blocks,
    interior_prior,
    unknown_names,
)
from robcal.photogrammetry.station.network import GROUPS, MarkTable, StationMarks, StationSettings, Unknowns
from robcal.photogrammetry.station.start import ImageStart
from robcal.transforms import Array

_TRUST = 0.1
"""Start values from a camera file may be off by a tenth of what is possible for an unknown lens."""

_MEDIAN_CHI2_2 = 2.0 * np.log(2.0)
_HUBER = 2.0


@dataclass
class StationState:
    """What changes between the adjustments of one orientation (the only mutable thing of this package).

    ``groups`` per camera the adjusted groups of its interior orientation, ``kept`` those never dropped; ``noise`` (c,)
    estimated by stated standard deviation; ``exterior_camera``, ``exterior_first`` (e,) camera and first pose number of
    each exterior orientation; ``fixed`` the exterior orientations that define the world; ``poses`` (p,) pose numbers.
    """

    names: tuple[str, ...]
    start: tuple[Camera, ...]
    body: Body
    settings: StationSettings
    marks: MarkTable
    unknowns: Unknowns
    prior: Prior
    groups: list[set[str]]
    kept: list[set[str]]
    noise: Array
    exterior_camera: IntArray
    exterior_first: IntArray
    fixed: tuple[int, ...]
    poses: IntArray

    def active(self, *, body: bool = True) -> NDArray[np.bool_]:
        """Mask of the free global unknowns (exterior, interior, points)."""
        e, t = len(self.exterior_camera), len(self.body)
        exterior = np.ones((e, 6), dtype=bool)
        exterior[list(self.fixed)] = False
        exterior[np.bincount(self.marks.exterior, minlength=e) == 0] = False
        interior = np.zeros((len(self.names), 9), dtype=bool)
        for i, names in enumerate(self.groups):
            for name in names:
                interior[i, list(GROUPS[name])] = True
        points = np.zeros((t, 3), dtype=bool)
        if body:
            points[np.unique(self.marks.target)] = True
        return np.concatenate([exterior.ravel(), interior.ravel(), points.ravel()])

    def unknown_names(self) -> list[str]:
        """Names of the global unknowns, for messages."""
        exterior = []
        for i, c in enumerate(self.exterior_camera):
            later = c in self.exterior_camera[:i]
            exterior.append(f"{self.names[c]} from pose {self.exterior_first[i]}" if later else self.names[c])
        return unknown_names(self.names, exterior, self.body.ids)

    def adjust(self, huber: float | None, *, body: bool = True) -> Adjusted:
        """Adjust with the present marks, groups and noise; the state takes over the solution."""
        adjusted = adjust_station(
            self.marks,
            self.unknowns,
            self.start,
            self.active(body=body),
            self.prior,
            self.noise,
            self.unknown_names(),
            huber=huber,
            max_iterations=self.settings.max_iterations,
        )
        self.unknowns = adjusted.unknowns
        return adjusted

    def redundancy(self, adjusted: Adjusted) -> Array:
        """(m, 2, 2) redundancy matrices of the whitened marks."""
        return covariance_blocks(adjusted.design, self.marks, len(self.exterior_camera), len(self.names))[1]

    def update_noise(self, adjusted: Adjusted, *, robust: bool) -> None:
        """Variance component of each camera: from the median of its residuals, or from squares and redundancy."""
        R = self.redundancy(adjusted)
        for c in range(len(self.names)):
            rows = self.marks.camera == c
            if not rows.any():
                continue
            r = adjusted.design.residual[rows]
            total = float(np.einsum("mii->", R[rows]))
            if robust:
                share = max(total / (2 * rows.sum()), 0.05)
                factor2 = float(np.median(np.sum(r**2, axis=1))) / (_MEDIAN_CHI2_2 * share)
            else:
                factor2 = (1.0 + float(np.sum(r**2))) / (1.0 + total)  # one degree of freedom for the stated covariance
            self.noise[c] *= float(np.clip(np.sqrt(factor2), 0.02, 50.0))

    def robust_adjustment(self) -> Adjusted:
        """From start values to a robust solution: first what moves much (focal length, k1), then all groups."""
        tried = self.groups
        sigma = float(np.sqrt(np.median(np.einsum("mii->m", self.marks.covariance)) / 2))
        self.noise[:] = max(1.0, self.settings.default_sigma_px / sigma)
        # The body is held while lens and exterior orientations are far off: it must not bend to absorb them.
        first = [t & ({"focal", "principal", "k1"} | k) for t, k in zip(tried, self.kept, strict=True)]
        for groups in (first, tried):
            self.groups = groups
            self.update_noise(self.adjust(_HUBER, body=False), robust=True)
        return self.settle()

    def settle(self) -> Adjusted:
        """Robust adjustment with the noise that belongs to it."""
        self.update_noise(self.adjust(_HUBER), robust=True)
        return self.adjust(_HUBER)

    def release_target(self, row: int) -> None:
        """Stop using the given coordinates of a target (a weak prior of 1 m stays)."""
        if self.prior.points_weight is None:
            return
        C = np.asarray(np.linalg.inv(self.prior.points_weight))
        self.prior = replace(self.prior, points_weight=np.asarray(np.linalg.inv(_released(C, row))))

    def add_epoch(self, camera: int, first_pose: int) -> None:
        """Give a camera another exterior orientation from a pose number on."""
        old = exterior_index(self.exterior_camera, self.exterior_first, np.array([camera]), np.array([first_pose]))[0]
        frames = np.concatenate([self.unknowns.world_T_exterior, self.unknowns.world_T_exterior[old][None]])
        self.exterior_camera = np.append(self.exterior_camera, camera)
        self.exterior_first = np.append(self.exterior_first, first_pose)
        self.unknowns = replace(self.unknowns, world_T_exterior=frames)
        index = exterior_index(
            self.exterior_camera, self.exterior_first, self.marks.camera, self.poses[self.marks.pose]
        )
        self.marks = replace(self.marks, exterior=index)

    def drop(self, rows: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Leave marks out, and the rest of a pose that keeps fewer than three; returns the mask of what went."""
        left = np.bincount(self.marks.pose[~rows], minlength=len(self.poses))
        gone = rows | (left < 3)[self.marks.pose]
        self.marks = self.marks.select(~gone)
        return gone


def _released(C: Array, row: int) -> Array:
    out = C.copy()
    at = slice(3 * row, 3 * row + 3)
    out[at] = 0.0
    out[:, at] = 0.0
    out[at, at] = np.eye(3)
    return out


def exterior_index(exterior_camera: IntArray, first: IntArray, camera: IntArray, pose: IntArray) -> IntArray:
    """Which exterior orientation holds for each (camera, pose number)."""
    out = np.zeros(len(camera), dtype=np.int64)
    for c in np.unique(exterior_camera):
        rows = np.flatnonzero(exterior_camera == c)
        rows = rows[np.argsort(first[rows], kind="stable")]
        at = np.clip(np.searchsorted(first[rows], pose, side="right") - 1, 0, len(rows) - 1)
        out = np.where(camera == c, rows[at], out)
    return out


def interior_groups(
    names: Sequence[str], cameras: Mapping[str, Camera | None], settings: StationSettings
) -> tuple[list[set[str]], list[set[str]]]:
    """Per camera the groups that are tried, and those that are never dropped (given in its file and not zero)."""
    tried: list[set[str]] = []
    kept: list[set[str]] = []
    for name in names:
        camera = cameras.get(name)
        tried.append(set() if settings.intrinsics == "fixed" else set(GROUPS))
        if settings.intrinsics != "auto":
            kept.append(set(tried[-1]))
            continue
        keep = {"focal", "principal"}
        if camera is not None:
            keep |= {n for n in ("k1", "k2", "k3") if getattr(camera, n) != 0.0}
            keep |= {"tangential"} if camera.p1 or camera.p2 else set()
            keep |= {"affinity"} if camera.fx != camera.fy else set()
        kept.append(keep)
    return tried, kept


def assemble(
    names: tuple[str, ...],
    marks: Sequence[StationMarks],
    images: Sequence[ImageStart],
    bodies: Mapping[int, Array],
    body: Body,
    start: Sequence[Camera],
    exterior: Array,
    fixed: Sequence[int],
    given: Mapping[str, Camera | None],
    settings: StationSettings,
) -> StationState:
    """One table of all marks of the poses in ``bodies``, start values of all unknowns and their priors."""
    poses = np.array(sorted(bodies), dtype=np.int64)
    rows: dict[str, list[np.ndarray]] = {k: [] for k in ("camera", "pose", "target", "xy", "covariance")}
    for s in images:
        if s.pose not in bodies:
            continue
        m = marks[s.camera]
        rows["camera"].append(np.full(len(s.rows), s.camera))
        rows["pose"].append(np.full(len(s.rows), np.searchsorted(poses, s.pose)))
        rows["target"].append(body.index(m.target[s.rows]))
        rows["xy"].append(m.xy[s.rows])
        rows["covariance"].append(m.covariance[s.rows])
    table = {k: np.concatenate(v) for k, v in rows.items()}
    target, radius, normals = table["target"], 0.5 * body.diameters, body.estimated_normals()
    exterior_camera, first = np.arange(len(names)), np.full(len(names), poses[0])
    mark_table = MarkTable(
        table["camera"],
        table["camera"].copy(),
        table["pose"],
        target,
        table["xy"],
        table["covariance"],
        radius[target],
        normals[target],
    )
    unknowns = Unknowns(
        np.array([camera.vector for camera in start]),
        np.array(exterior, dtype=float),
        np.array([bodies[int(p)] for p in poses]),
        np.where(body.known[:, None], body.points, 0.0),
    )
    # without a file the prior is a lens without distortion, wherever the start values already are
    centre = [
        camera.vector
        if given.get(name) is not None
        else Camera(
            camera.width,
            camera.height,
            (f := 0.5 * (camera.fx + camera.fy)),
            f,
            0.5 * (camera.width - 1),
            0.5 * (camera.height - 1),
        ).vector
        for name, camera in zip(names, start, strict=True)
    ]
    sigma = np.array(
        [
            interior_prior(camera) * (1.0 if given.get(name) is None else _TRUST)
            for name, camera in zip(names, start, strict=True)
        ]
    )
    weight = body_weight(body, mark_table, unknowns, start, settings)
    tried, kept = interior_groups(names, given, settings)
    state = StationState(
        names,
        tuple(start),
        body,
        settings,
        mark_table,
        unknowns,
        Prior(np.array(centre), sigma, unknowns.points.copy(), weight),
        tried,
        kept,
        np.ones(len(names)),
        exterior_camera,
        first,
        tuple(fixed),
        poses,
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
