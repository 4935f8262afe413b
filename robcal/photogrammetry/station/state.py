"""State of a station while it is being oriented: robust adjustment, noise per camera, freed and dropped parts."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from robcal.photogrammetry.core.bodies import Body, IntArray
from robcal.photogrammetry.core.camera import Camera
from robcal.photogrammetry.station.adjustment import Adjusted, adjust_station, covariance_blocks, unknown_names
from robcal.photogrammetry.station.network import GROUPS, MarkTable, Prior, StationSettings, Unknowns
from robcal.transforms import Array

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
