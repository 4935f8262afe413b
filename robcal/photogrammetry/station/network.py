"""Types of the station adjustment: marks, settings, unknowns and the result with its normal equations.

A station is a set of cameras at rest that watch one body in many poses. Unknown are the cameras' exterior orientations
(several per camera, one after the other, where it moved: epochs), their interior orientations, the body's pose in every
recording and, as weighted observations, the body's coordinates.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from robcal.cause import Cause
from robcal.columns import Columns
from robcal.errors import InvalidInput
from robcal.photogrammetry.core.bodies import Body, IntArray
from robcal.photogrammetry.core.camera import Camera
from robcal.transforms import Array, difference, invert

GROUPS: Mapping[str, tuple[int, ...]] = {
    "focal": (0,),
    "affinity": (1,),
    "principal": (2, 3),
    "k1": (4,),
    "k2": (5,),
    "tangential": (6, 7),
    "k3": (8,),
}
"""Unknowns of the interior orientation that are freed together. The first two are the common change of fx and fy and
their difference (both px, see :func:`robcal.photogrammetry.station.adjustment.interior_basis`), the others are the
numbers 2 to 8 of INTRINSIC_NAMES."""


@dataclass(frozen=True)
class StationMarks:
    """Identified marks of one camera: pose number (m,), target id (m,), xy (m, 2) px, covariance (m, 2, 2) px^2."""

    pose: IntArray
    target: IntArray
    xy: Array
    covariance: Array

    def __post_init__(self) -> None:
        m = len(self.pose)
        object.__setattr__(self, "pose", np.asarray(self.pose, dtype=np.int64))
        object.__setattr__(self, "target", np.asarray(self.target, dtype=np.int64))
        object.__setattr__(self, "xy", np.asarray(self.xy, dtype=float).reshape(-1, 2))
        object.__setattr__(self, "covariance", np.asarray(self.covariance, dtype=float).reshape(-1, 2, 2))
        if self.target.shape != (m,) or self.xy.shape != (m, 2) or self.covariance.shape != (m, 2, 2):
            raise InvalidInput("marks of a camera: pose, target, xy and covariance must have one row per mark")
        if not (np.isfinite(self.xy).all() and np.isfinite(self.covariance).all()):
            row = int(np.flatnonzero(~np.isfinite(self.xy).all(1) | ~np.isfinite(self.covariance).all((1, 2)))[0])
            raise InvalidInput(f"mark {row} (pose {self.pose[row]}, target {self.target[row]}) is not a number")
        if m and np.linalg.eigvalsh(self.covariance)[:, 0].min() <= 0:
            raise InvalidInput("a mark's covariance is not positive definite: sigmas must be above zero")

    def __len__(self) -> int:
        return len(self.pose)


@dataclass(frozen=True)
class StationSettings:
    """How the station is adjusted.

    Attributes
    ----------
    intrinsics : 'auto' frees what the data carry significantly, 'fixed' keeps the cameras, 'all' frees everything.
    significance : level at which a group of the interior orientation stays in ('auto').
    critical : limit of normalised residuals in data snooping.
    detect_moves : look for cameras that moved between poses and give them a new exterior orientation from there.
    detect_targets : look for targets whose body coordinates contradict the images and let them adjust freely.
    epochs : known moves: camera -> poses from which on it stands elsewhere.
    free_targets : ids whose given body coordinates are not used.
    default_sigma_px : for the first look only, the error the start values may cause in the image.
    body_sigma : m, accuracy assumed for coordinates given without covariance; 0 takes them as exact.
    max_iterations : Gauss-Newton steps of each stage.
    """

    intrinsics: str = "auto"
    significance: float = 1e-3
    critical: float = 4.0
    detect_moves: bool = True
    detect_targets: bool = True
    epochs: Mapping[str, tuple[int, ...]] = field(default_factory=dict)
    free_targets: tuple[int, ...] = ()
    default_sigma_px: float = 5.0
    body_sigma: float = 0.0
    max_iterations: int = 30

    def __post_init__(self) -> None:
        if self.intrinsics not in ("auto", "fixed", "all"):
            raise InvalidInput(f"intrinsics is auto, fixed or all, not {self.intrinsics!r}")


def movement(camera: str, pose: int, shift: Array) -> str:
    """A camera's movement (6,), translation (m) first, in words."""
    length, turn = 1e3 * np.linalg.norm(shift[:3]), np.degrees(np.linalg.norm(shift[3:]))
    return f"camera {camera} stands elsewhere from pose {pose} on, by {length:.3g} mm and {turn:.2g} deg"


RejectionKind = Literal["outlier", "recurring", "contradiction", "no_pose"]


@dataclass(frozen=True)
class StationCause(Cause):
    """Something in the data that contradicts the model again and again, with its test.

    `kind` is one of :mod:`robcal.photogrammetry.station.contradictions`; `where`: camera or target; `pose`: first pose
    concerned or None; `estimate` and `covariance` in the units of the kind (shift m, turn rad in the camera's or the
    body's coordinates); `statistic` chi-square with `degrees` of freedom; `statement` a sentence; `alone`: other data
    exclude that it was another camera; `partner`: the other one of two swapped targets.
    """

    pose: int | None
    estimate: Array
    covariance: Array
    statistic: float
    degrees: int
    statement: str
    alone: bool = False
    partner: str = ""


@dataclass(frozen=True)
class RejectedMark:
    """A mark left out: camera, pose number, target id (-1: the whole image) and why.

    ``kind``: 'outlier' (one mark), 'recurring' (most marks of its target: the target is to blame), 'contradiction'
    (the image does not fit the other cameras) or 'no_pose' (the image
    alone carries no pose; its marks may still be intersected).
    """

    camera: str
    pose: int
    target: int
    reason: str
    kind: RejectionKind = "outlier"


@dataclass(frozen=True)
class Unknowns:
    """Values of all unknowns: interior (c, 9), world_T_exterior (e, 4, 4), world_T_body (p, 4, 4), points (t, 3)."""

    interior: Array
    world_T_exterior: Array
    world_T_body: Array
    points: Array


@dataclass(frozen=True)
class Prior:
    """Weighted observations of unknowns.

    ``interior`` (c, 9) start numbers with ``interior_sigma`` (c, 9) of the adjusted unknowns; ``points`` (t, 3) given
    coordinates with the inverse covariance ``points_weight`` (3t, 3t), None: coordinates are held.
    """

    interior: Array
    interior_sigma: Array
    points: Array
    points_weight: Array | None


@dataclass(frozen=True)
class MarkTable(Columns):
    """All marks of the station in one table.

    ``camera``, ``exterior``, ``pose``, ``target`` (m,) are rows of the unknowns' arrays (``pose``: position among the
    poses adjusted; ``target``: position in the body); ``xy`` (m, 2), ``covariance`` (m, 2, 2) as measured; ``radius``
    (m,) and ``normals`` (m, 3) of the dots, NaN where unknown.
    """

    camera: IntArray
    exterior: IntArray
    pose: IntArray
    target: IntArray
    xy: Array
    covariance: Array
    radius: Array
    normals: Array

    def __len__(self) -> int:
        return len(self.camera)


@dataclass(frozen=True)
class StationDesign:
    """The linearised station at its solution, whitened: what a search for missing physics needs.

    Rows are marks; ``names`` lists the global unknowns (exterior, interior, points) of the reduced normal equations.

    Attributes
    ----------
    residual : (m, 2) whitened residuals, measured minus model.
    by_exterior, by_interior, by_point, by_pose : (m, 2, 6 | 9 | 3 | 6) derivatives of the whitened image coordinates by
        the unknowns of the mark's own exterior, camera, target and pose.
    whitening : (m, 2, 2) with W' W the inverse covariance (noise factor included).
    weights : (m,) robust weights, all one in a final result.
    active : (g,) which global unknowns were adjusted.
    reduced_inverse : (g, g) covariance of the global unknowns, zeros where not adjusted.
    pose_inverse : (p, 6, 6) inverse of each pose's own normal matrix.
    pose_response : (p, 6, g) derivative of each pose by the global unknowns.
    """

    residual: Array
    by_exterior: Array
    by_interior: Array
    by_point: Array
    by_pose: Array
    whitening: Array
    weights: Array
    active: NDArray[np.bool_]
    reduced_inverse: Array
    pose_inverse: Array
    pose_response: Array


@dataclass(frozen=True)
class StationOrientation:
    """Result of :func:`robcal.photogrammetry.station.orientation.orient_station`.

    Attributes
    ----------
    names : (c,) cameras in order; ``cameras`` their adjusted interior orientation.
    exterior_camera, exterior_first_pose : (e,) camera index and first pose number of each exterior orientation.
    world_T_exterior : (e, 4, 4); covariance (6e + 9c, 6e + 9c) of exterior (right perturbation) then interior numbers.
    poses : (p,) pose numbers; world_T_body (p, 4, 4), body_covariance (p, 6, 6) marginal.
    pose_cameras : (p,) how many cameras saw the pose; ambiguous_poses: single-camera plane poses with two solutions.
    body : the body with coordinates as adjusted (covariance of the adjusted coordinates inside).
    marks : the marks used (table), design : the linearised model there.
    redundancy : (m, 2) local redundancy numbers; w : (m, 2) normalised residuals.
    sigma0 : of unit weight; noise : camera -> estimated by stated standard deviation of its marks.
    redundancy_total, rms_px : totals; rejected : marks left out with reason; evidence : recurring contradictions.
    free_interior : camera -> names of the groups of the interior orientation that were adjusted.
    converged, iterations : of the final adjustment.
    prior : the weighted observations of interior orientations and body coordinates that it was adjusted with.
    """

    names: tuple[str, ...]
    cameras: tuple[Camera, ...]
    exterior_camera: IntArray
    exterior_first_pose: IntArray
    world_T_exterior: Array
    covariance: Array
    poses: IntArray
    world_T_body: Array
    body_covariance: Array
    pose_cameras: IntArray
    ambiguous_poses: tuple[int, ...]
    body: Body
    marks: MarkTable
    design: StationDesign
    redundancy: Array
    w: Array
    sigma0: float
    noise: Mapping[str, float]
    redundancy_total: float
    rms_px: float
    rejected: tuple[RejectedMark, ...]
    evidence: tuple[StationCause, ...]
    free_interior: Mapping[str, tuple[str, ...]]
    converged: bool
    iterations: int
    prior: Prior

    @property
    def world_T_camera(self) -> dict[str, Array]:
        """Exterior orientation of each camera as it was at the first pose."""
        first: dict[str, Array] = {}
        for e in np.argsort(self.exterior_first_pose, kind="stable"):
            first.setdefault(self.names[self.exterior_camera[e]], self.world_T_exterior[e])
        return {name: first[name] for name in self.names}

    def exterior_of(self, camera: int, poses: Sequence[int] | IntArray) -> IntArray:
        """Index of the exterior orientation that holds for a camera in given poses."""
        rows = np.flatnonzero(self.exterior_camera == camera)
        rows = rows[np.argsort(self.exterior_first_pose[rows])]
        at = np.searchsorted(self.exterior_first_pose[rows], np.asarray(poses), side="right") - 1
        return rows[np.clip(at, 0, len(rows) - 1)]

    def movement(self, camera: str, pose: int) -> tuple[Array, Array]:
        """Change of a camera's exterior orientation (6,) at the pose from which an epoch starts, and its covariance.

        Right perturbation of the orientation before (m, rad). Weakness: the covariance neglects the turn itself.
        """
        rows = np.flatnonzero(self.exterior_camera == self.names.index(camera))
        rows = rows[np.argsort(self.exterior_first_pose[rows])]
        k = int(np.flatnonzero(self.exterior_first_pose[rows] == pose)[0])
        before, after = rows[k - 1], rows[k]
        D = invert(self.world_T_exterior[before]) @ self.world_T_exterior[after]
        C = self.covariance[: 6 * len(self.world_T_exterior), : 6 * len(self.world_T_exterior)]
        C = C.reshape(len(self.world_T_exterior), 6, -1, 6)
        between = C[before, :, after]
        return difference(np.eye(4), D), C[after, :, after] + C[before, :, before] - between - between.T

    def camera_covariance(self, name: str) -> tuple[Array, Array]:
        """Covariances (6, 6) of a camera's exterior orientation at the first pose and (9, 9) of its interior one."""
        c = self.names.index(name)
        e = int(self.exterior_of(c, [int(self.exterior_first_pose.min())])[0])
        at = 6 * len(self.world_T_exterior) + 9 * c
        return self.covariance[6 * e : 6 * e + 6, 6 * e : 6 * e + 6], self.covariance[at : at + 9, at : at + 9]
