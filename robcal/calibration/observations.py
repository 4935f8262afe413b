"""Observation operators: what was measured of the tool at the poses, as residuals and their derivatives.

Every operator gives, for tool frames ``T = world_T_tool`` (n, 4, 4) of all poses, residuals ``r = measured - model``
(m, d), the derivative ``B`` (m, d, 6) of the model by a right twist (rho, omega) of the tool, and a covariance
(m, d, d). So one solver serves 6D frames, 3D points, 1D distances, a sensor in the hand, and raw pixels, also mixed.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, ClassVar, Protocol, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from robcal import transforms as tf
from robcal.calibration.wire import Wire
from robcal.errors import InvalidInput
from robcal.photogrammetry.core.camera import Camera, project_with_jacobians

Array = NDArray[np.float64]
Ints = NDArray[np.int64]
Self = TypeVar("Self", bound="_Rows")


class Observations(Protocol):
    """What the solver needs of any kind of measurement."""

    dimension: ClassVar[int]

    @property
    def pose(self) -> Ints:
        """Row of the pose of each measurement (m,)."""
        ...

    def evaluate(self, T: Array) -> tuple[Array, Array]:
        """Residuals (m, d) and derivative (m, d, 6) of the model by the tool's right twist; T is (n, 4, 4)."""
        ...

    def noise(self, T: Array) -> Array:
        """Covariance (m, d, d) of the residuals."""
        ...

    def subset(self, poses: ArrayLike) -> Any:
        """The rows of the given poses, renumbered to the order of ``poses``."""
        ...


@dataclass(frozen=True)
class _Rows:
    """Rows that belong to poses, with checks and choice common to all operators."""

    pose: Ints
    dimension: ClassVar[int] = 0

    def _check(self, shapes: dict[str, tuple[int, ...]]) -> None:
        pose = np.asarray(self.pose, dtype=np.int64)
        object.__setattr__(self, "pose", pose)
        kind = type(self).__name__
        if pose.ndim != 1 or np.any(pose < 0):
            raise InvalidInput(f"{kind}: pose must be a list of row numbers")
        for name, shape in shapes.items():
            value = np.asarray(getattr(self, name), dtype=float)
            if value.shape != (len(pose), *shape):
                raise InvalidInput(f"{kind}: {name} has shape {value.shape}, expected {(len(pose), *shape)}")
            finite = np.isfinite(value).reshape(len(pose), int(np.prod(shape))).all(axis=1)
            bad = np.flatnonzero(~finite)
            if bad.size:
                raise InvalidInput(f"{kind}: {name} of row {bad[0]} (counted from 0) is not finite: remove the row")
            object.__setattr__(self, name, value)

    def _check_covariance(self, name: str = "covariance") -> None:
        value = getattr(self, name)
        if len(value) and float(np.linalg.eigvalsh(value)[:, 0].min()) <= 0:
            row = int(np.argmin(np.linalg.eigvalsh(value)[:, 0]))
            raise InvalidInput(
                f"{type(self).__name__}: the covariance of row {row} (counted from 0) is not positive definite: "
                "give standard deviations above zero"
            )

    def subset(self: Self, poses: ArrayLike) -> Self:
        """The rows of the given poses (indices or mask), renumbered to their order."""
        chosen = np.asarray(poses)
        chosen = np.flatnonzero(chosen) if chosen.dtype == bool else chosen.astype(np.int64)
        size = int(max(self.pose.max(initial=-1), chosen.max(initial=-1))) + 1
        new = np.full(size, -1, dtype=np.int64)
        new[chosen] = np.arange(len(chosen))
        rows = new[self.pose] >= 0
        return replace(self, **self._picked(rows) | {"pose": new[self.pose[rows]]})

    def _picked(self, rows: NDArray[np.bool_]) -> dict[str, Any]:
        out: dict[str, Any] = {}
        for f in fields(self):
            value = getattr(self, f.name)
            if isinstance(value, np.ndarray) and value.shape[:1] == rows.shape:
                out[f.name] = value[rows]
        return out

    def evaluate(self, T: Array) -> tuple[Array, Array]:
        raise NotImplementedError

    def noise(self, T: Array) -> Array:
        raise NotImplementedError

    def linearise(self, T: Array, J: Array) -> tuple[Array, Array]:
        """Whitened residuals (m d,) and whitened derivative (m d, p) for parameter twists J (n, 6, p)."""
        r, B = self.evaluate(T)
        L = np.linalg.cholesky(self.noise(T))
        white = np.linalg.solve(L, np.concatenate([r[..., None], B @ J[self.pose]], axis=2))
        return white[..., 0].ravel(), white[..., 1:].reshape(-1, J.shape[2])


@dataclass(frozen=True)
class FrameObservations(_Rows):
    """Measured tool frames.

    Attributes
    ----------
    pose : row of the pose (m,).
    world_T_tool : (m, 4, 4).
    covariance : (m, 6, 6) of a right perturbation (m, rad).
    stated_angles : (m, 3) the three angles as they stand in a file (rad), which may follow another convention than it
        was read by; None where there is no file.
    """

    world_T_tool: Array
    covariance: Array
    stated_angles: Array | None = None
    dimension: ClassVar[int] = 6

    def __post_init__(self) -> None:
        self._check({"world_T_tool": (4, 4), "covariance": (6, 6)})
        self._check_covariance()

    @classmethod
    def isotropic(
        cls, world_T_tool: ArrayLike, sigma: float, sigma_angle: float, pose: ArrayLike | None = None
    ) -> "FrameObservations":
        """One frame a pose with the same standard deviations (m, rad) in all directions."""
        T = np.asarray(world_T_tool, dtype=float)
        C = np.diag([sigma**2] * 3 + [sigma_angle**2] * 3)
        rows = np.arange(len(T)) if pose is None else np.asarray(pose)
        return cls(rows, T, np.broadcast_to(C, (len(T), 6, 6)))

    def evaluate(self, T: Array) -> tuple[Array, Array]:
        """``r = difference(T, measured)``; derivative exact up to second order in the turn."""
        r = tf.difference(T[self.pose], self.world_T_tool)
        B = np.zeros((len(r), 6, 6))
        B[:, :3, :3] = np.eye(3)
        B[:, :3, 3:] = -tf.skew(r[:, :3])
        turn = tf.skew(r[:, 3:])
        B[:, 3:, 3:] = np.eye(3) - 0.5 * turn + turn @ turn / 12.0
        return r, B

    def noise(self, T: Array) -> Array:
        """The covariance as given: the measured and the modelled tool differ by a small turn only."""
        return self.covariance


@dataclass(frozen=True)
class PointObservations(_Rows):
    """Targets on the tool, measured in the world.

    Attributes
    ----------
    pose : (m,); p_tool, p_world : (m, 3) m; covariance : (m, 3, 3) m2 in the world; target : id (m,).
    """

    p_tool: Array
    p_world: Array
    covariance: Array
    target: Ints
    dimension: ClassVar[int] = 3

    def __post_init__(self) -> None:
        self._check({"p_tool": (3,), "p_world": (3,), "covariance": (3, 3)})
        self._check_covariance()
        object.__setattr__(self, "target", np.asarray(self.target))

    def evaluate(self, T: Array) -> tuple[Array, Array]:
        """``r = p_world - T p_tool`` in world coordinates."""
        return _point_residuals(T[self.pose], self.p_tool, self.p_world)

    def noise(self, T: Array) -> Array:
        """As given."""
        return self.covariance


@dataclass(frozen=True)
class SensorPointObservations(_Rows):
    """Targets at rest in the world, measured by a sensor on the tool.

    Attributes
    ----------
    pose : (m,); p_sensor, p_world : (m, 3) m; covariance : (m, 3, 3) m2 of ``p_sensor``, in sensor coordinates.
    """

    p_sensor: Array
    p_world: Array
    covariance: Array
    dimension: ClassVar[int] = 3

    def __post_init__(self) -> None:
        self._check({"p_sensor": (3,), "p_world": (3,), "covariance": (3, 3)})
        self._check_covariance()

    def evaluate(self, T: Array) -> tuple[Array, Array]:
        """``r = p_world - T p_sensor`` in world coordinates."""
        return _point_residuals(T[self.pose], self.p_sensor, self.p_world)

    def noise(self, T: Array) -> Array:
        """The sensor's covariance turned into the world."""
        R = T[self.pose, :3, :3]
        return tf.transport_covariance(R, self.covariance)


@dataclass(frozen=True)
class DistanceObservations(_Rows):
    """Distances of the tool's origin from the world's origin, by draw-wire or interferometer.

    The residual is ``d - |t|`` (maximum likelihood); ``d^2 - |t|^2`` would scatter by 2 d sigma.

    Attributes
    ----------
    pose : (m,); distance, sigma : (m,) m. wire : how the count of a wire follows from the distance, None where it is
        the distance.
    """

    distance: Array
    sigma: Array
    wire: Wire | None = None
    dimension: ClassVar[int] = 1

    def __post_init__(self) -> None:
        self._check({"distance": (), "sigma": ()})
        if np.any(self.sigma <= 0):
            raise InvalidInput("DistanceObservations: sigma must be above zero")
        if np.any(self.distance <= 0):
            raise InvalidInput(
                f"DistanceObservations: distance of row {int(np.argmin(self.distance))} is not positive: remove the row"
            )

    def evaluate(self, T: Array) -> tuple[Array, Array]:
        """Distance residual; derivative along the direction to the tool, in tool coordinates."""
        t = T[self.pose, :3, 3]
        if self.wire is not None:
            length, gradient = self.wire.length(t)
            B = np.zeros((len(t), 1, 6))
            B[:, 0, :3] = np.einsum("mi,mij->mj", gradient, T[self.pose, :3, :3])
            return (self.distance - length)[:, None], B
        length = np.maximum(np.linalg.norm(t, axis=1), 1e-12)
        B = np.zeros((len(t), 1, 6))
        B[:, 0, :3] = np.einsum("mi,mij->mj", t / length[:, None], T[self.pose, :3, :3])
        return (self.distance - length)[:, None], B

    def noise(self, T: Array) -> Array:
        """As given."""
        return (self.sigma**2)[:, None, None]


@dataclass(frozen=True)
class PixelObservations(_Rows):
    """Targets on the tool, seen in images of fixed, oriented cameras.

    Attributes
    ----------
    pose : (m,); camera : index (m,) into ``cameras``; p_tool : (m, 3) m; xy : (m, 2) px; covariance : (m, 2, 2) px2.
    cameras : intrinsics; camera_T_world : (c, 4, 4).
    """

    camera: Ints
    p_tool: Array
    xy: Array
    covariance: Array
    cameras: tuple[Camera, ...]
    camera_T_world: Array
    dimension: ClassVar[int] = 2

    def __post_init__(self) -> None:
        self._check({"p_tool": (3,), "xy": (2,), "covariance": (2, 2)})
        self._check_covariance()
        object.__setattr__(self, "camera", np.asarray(self.camera, dtype=np.int64))
        object.__setattr__(self, "camera_T_world", np.asarray(self.camera_T_world, dtype=float))

    def _picked(self, rows: NDArray[np.bool_]) -> dict[str, Any]:
        names = ("pose", "camera", "p_tool", "xy", "covariance")
        return {name: getattr(self, name)[rows] for name in names}

    def evaluate(self, T: Array) -> tuple[Array, Array]:
        """Pixel residuals; derivative through the camera's own."""
        tool = T[self.pose]
        B_world = np.concatenate([tool[:, :3, :3], -tool[:, :3, :3] @ tf.skew(self.p_tool)], axis=2)
        p_world = tf.transform(tool, self.p_tool)
        r, B = np.zeros((len(tool), 2)), np.zeros((len(tool), 2, 6))
        for k, camera in enumerate(self.cameras):
            rows = self.camera == k
            if not np.any(rows):
                continue
            c_T_w = self.camera_T_world[k]
            xy, by_point, _ = project_with_jacobians(camera, tf.transform(c_T_w, p_world[rows]))
            r[rows] = self.xy[rows] - xy
            B[rows] = by_point @ c_T_w[:3, :3] @ B_world[rows]
        return r, B

    def noise(self, T: Array) -> Array:
        """As given."""
        return self.covariance


def _point_residuals(tool: Array, p_tool: Array, p_world: Array) -> tuple[Array, Array]:
    R = tool[:, :3, :3]
    B = np.concatenate([R, -R @ tf.skew(p_tool)], axis=2)
    return p_world - tf.transform(tool, p_tool), B


def basis_points(frames: FrameObservations, sigma: float | None = None) -> PointObservations:
    """Basis norm: each frame as its images of the three unit vectors, equally weighted.

    Weakness: it fixes the weight of angles against lengths (one metre of lever) whatever was measured how well.
    """
    m = len(frames.pose)
    if sigma is None:
        sigma = float(np.sqrt(np.mean(np.trace(frames.covariance[:, :3, :3], axis1=1, axis2=2) / 3.0))) if m else 1.0
    e = np.tile(np.eye(3), (m, 1))
    pose = np.repeat(frames.pose, 3)
    p_world = tf.transform(np.repeat(frames.world_T_tool, 3, axis=0), e)
    C = np.broadcast_to(sigma**2 * np.eye(3), (3 * m, 3, 3))
    return PointObservations(pose, e, p_world, C, np.tile(np.arange(3), m))


@dataclass(frozen=True)
class Stacked:
    """Rows of all observations, arranged by pose and padded: what the solver works on.

    Attributes
    ----------
    r : (n, D) residuals, zero where padded.
    B : (n, D, 6) by the tool's twist.
    used : (n, D) true where there is a residual.
    """

    r: Array
    B: Array
    used: NDArray[np.bool_]


class Stack:
    """Arranges several observation operators by pose, so that errors common to a pose can be weighted.

    Parameters
    ----------
    observations : operators whose pose numbers are below n_poses.
    n_poses : number of poses n.

    Raises
    ------
    InvalidInput : no observations, or one of a pose that does not exist.
    """

    def __init__(self, observations: Sequence[Observations], n_poses: int) -> None:
        self.observations = list(observations)
        self.n = n_poses
        fill = np.zeros(n_poses, dtype=np.int64)
        self.slots: list[tuple[Ints, Ints]] = []
        for o in self.observations:
            if len(o.pose) and int(o.pose.max()) >= n_poses:
                raise InvalidInput(f"an observation belongs to pose {int(o.pose.max())}, there are {n_poses} poses")
            order = np.argsort(o.pose, kind="stable")
            counts = np.bincount(o.pose, minlength=n_poses)
            rank = np.empty(len(o.pose), dtype=np.int64)
            rank[order] = np.arange(len(order)) - np.repeat(np.cumsum(counts) - counts, counts)
            first = fill[o.pose] + rank * o.dimension
            self.slots.append((o.pose, first[:, None] + np.arange(o.dimension)))
            fill += counts * o.dimension
        self.depth = int(fill.max(initial=0))
        if self.depth == 0:
            raise InvalidInput("there is no measurement of any pose: nothing to identify from")
        self.used = np.arange(self.depth) < fill[:, None]
        self.rows = int(fill.sum())

    def evaluate(self, T: Array, observations: Sequence[Observations] | None = None) -> Stacked:
        """Raw residuals and derivatives by pose; ``observations`` : the same at other values of their parameters."""
        r, B = np.zeros((self.n, self.depth)), np.zeros((self.n, self.depth, 6))
        for o, (pose, slot) in zip(observations or self.observations, self.slots, strict=True):
            r_o, B_o = o.evaluate(T)
            r[pose[:, None], slot] = r_o
            B[pose[:, None], slot] = B_o
        return Stacked(r, B, self.used)

    def covariance(self, T: Array) -> Array:
        """Block-diagonal covariance (n, D, D) by pose; identity where padded."""
        C = np.zeros((self.n, self.depth, self.depth))
        index = np.arange(self.depth)
        C[:, index, index] = ~self.used
        for o, (pose, slot) in zip(self.observations, self.slots, strict=True):
            C[pose[:, None, None], slot[:, :, None], slot[:, None, :]] = o.noise(T)
        return C
