"""The frozen reference of a drift control: where the robot saw the targets at rest when it was set up.

Only changes against the reference count afterwards, so that errors of the model that stay do not matter, and neither
do the body's own coordinates: targets need to be at rest, not known.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from robcal import transforms as tf
from robcal.calibration.calibrated import CalibratedRobot
from robcal.drift.parameters import choose_parameters, thermal_sizes
from robcal.errors import InvalidInput, NotIdentifiable
from robcal.robot.kernel import Kernel, PoseInputs
from robcal.robot.kernel_cache import kernel_of
from robcal.transforms import Array

Ints = NDArray[np.int64]


@dataclass(frozen=True)
class DriftSettings:
    """What a drift control takes for granted.

    Attributes
    ----------
    sigma : m; standard deviation of a coordinate in the sensor where the readings state none.
    rate : m/s; how fast targets drift at most, as the sensor sees them; older readings of a tour count less for it.
    standstill : s; after a longer pause a tour starts anew. stale : s; a model that is older than that is out of date.
    time_constant : s; the shortest in which the robot's temperature follows a change.
    level : chance of a false alarm of one test. most_rejected : share of a tour's readings that may be left out.
    bounds : a parameter may change by so many times its expected thermal change.
    least_jump : (m, rad) smaller jumps of body or joint are no alarm.
    """

    sigma: float = 2e-5
    rate: float = 4e-8
    standstill: float = 1800.0
    stale: float = 4 * 3600.0
    time_constant: float = 3600.0
    level: float = 1e-9
    most_rejected: float = 0.25
    bounds: float = 4.0
    least_jump: tuple[float, float] = (1e-4, 1.2e-4)


@dataclass(frozen=True)
class Readings:
    """Targets as the sensor saw them, m rows.

    Attributes
    ----------
    cycle : (m,) count of production; time : (m,) s.
    pose : (m,) names; target : (m,) ids.
    x : (m, 3) m in sensor coordinates; covariance : (m, 3, 3) m2.
    inputs : what was commanded.
    """

    cycle: Ints
    time: Array
    pose: tuple[str, ...]
    target: Ints
    x: Array
    covariance: Array
    inputs: PoseInputs

    def __len__(self) -> int:
        return len(self.x)

    def subset(self, rows: Ints | NDArray[np.bool_] | Sequence[int]) -> "Readings":
        """Some of the rows (indices or mask)."""
        chosen = np.asarray(rows)
        at = np.arange(len(self))[chosen if chosen.dtype == bool else chosen.astype(np.intp)]
        return Readings(
            self.cycle[at],
            self.time[at],
            tuple(self.pose[i] for i in at),
            self.target[at],
            self.x[at],
            self.covariance[at],
            self.inputs.subset(at),
        )


def joined(parts: Sequence[Readings]) -> Readings:
    """Readings one after the other; columns that not all of them have are left out."""
    names = set.intersection(*(set(p.inputs.covariates) for p in parts))
    inputs = PoseInputs(
        np.concatenate([p.inputs.q for p in parts]),
        np.concatenate([p.inputs.load for p in parts]),
        {n: np.concatenate([p.inputs.covariates[n] for p in parts]) for n in sorted(names)},
    )
    return Readings(
        np.concatenate([p.cycle for p in parts]),
        np.concatenate([p.time for p in parts]),
        tuple(name for p in parts for name in p.pose),
        np.concatenate([p.target for p in parts]),
        np.concatenate([p.x for p in parts]),
        np.concatenate([p.covariance for p in parts]),
        inputs,
    )


@dataclass(frozen=True)
class DriftReference:
    """A reference and the parameters that may drift.

    Attributes
    ----------
    robot : the calibrated robot at the time of the reference.
    sensor : (4, 4) flange_T_sensor; None: the robot's tool is the sensor.
    poses, targets : (k,) names and ids: what one tour measures.
    q : (k, N) commanded angles of the reference; load : (k, payloads).
    p : (k, 3) m, targets in the world as the robot of that time saw them; covariance : (k, 3, 3).
    names : (p,) of the drifting parameters; sizes : (p,) m and rad, their expected thermal change.
    """

    robot: CalibratedRobot
    sensor: Array | None
    poses: tuple[str, ...]
    targets: Ints
    q: Array = field(repr=False)
    load: Array = field(repr=False)
    p: Array = field(repr=False)
    covariance: Array = field(repr=False)
    names: tuple[str, ...]
    sizes: Array
    settings: DriftSettings = DriftSettings()

    @cached_property
    def kernel(self) -> Kernel:
        """The robot with the sensor as its tool."""
        kernel = kernel_of(self.robot.model, self.robot.statics)
        return kernel if self.sensor is None else kernel.with_references(None, self.sensor)

    @cached_property
    def columns(self) -> NDArray[np.intp]:
        """Indices of the drifting parameters in the kernel's theta."""
        index = self.kernel.index
        return np.array([index[name] for name in self.names], dtype=np.intp)

    @cached_property
    def joint_columns(self) -> Array:
        """(k, 3, N) m/rad; how each joint moves the targets that the sensor sees, in the world, at the reference."""
        kernel = self.kernel
        given = {name: np.full(len(self.q), value) for name, value in self.robot.defaults.items()}
        inputs = PoseInputs(self.q, self.load, {"index": np.zeros(len(self.q)), **given})
        T = kernel.frames(kernel.theta0, inputs)
        J = kernel.joint_jacobian(kernel.theta0, inputs)
        seen = tf.transform(tf.invert(T), self.p)
        return np.asarray(T[:, :3, :3] @ (J[:, :3] - tf.skew(seen) @ J[:, 3:]))

    def theta(self, change: Array) -> Array:
        """All parameters when the drifting ones have changed by (p,)."""
        theta = self.kernel.theta0.copy()
        theta[self.columns] += change
        return theta

    def slots(self, readings: Readings) -> Ints:
        """Which of the tour's measurements each reading is, -1 where it is none of them."""
        place = {key: k for k, key in enumerate(zip(self.poses, self.targets.tolist(), strict=True))}
        keys = zip(readings.pose, readings.target.tolist(), strict=True)
        return np.array([place.get(key, -1) for key in keys], dtype=np.int64)

    def unexplained(self, readings: Readings, slots: Ints, change: Array) -> Array:
        """``r`` of :meth:`displacements` alone."""
        return np.asarray(
            self.p[slots] - tf.transform(self.kernel.frames(self.theta(change), readings.inputs), readings.x)
        )

    def displacements(self, readings: Readings, slots: Ints, change: Array) -> tuple[Array, Array, Array]:
        """What the robot, changed by (p,), does not explain: ``r = p_ref - T(x, q) x_sensor`` (m, 3) in the world.

        Also its derivative (m, 3, p) of the model by the parameters and the rotations world_R_sensor (m, 3, 3).
        """
        T, J = self.kernel.frames_and_jacobian(self.theta(change), readings.inputs, self.columns)
        R = T[:, :3, :3]
        r = self.p[slots] - tf.transform(T, readings.x)
        A = R @ (J[:, :3] - tf.skew(readings.x) @ J[:, 3:])
        return r, A, R


def freeze(
    robot: CalibratedRobot,
    readings: Readings,
    *,
    sensor: Array | None = None,
    parameters: Sequence[str] | None = None,
    settings: DriftSettings | None = None,
    bounds: Mapping[str, float] | None = None,
) -> DriftReference:
    """A reference from the readings of one tour or of several, which are averaged.

    Parameters
    ----------
    parameters : names of those that drift; None chooses those that the tour can tell.
    bounds : expected thermal change (m, rad) of single parameters, where better known than by rule.

    Raises
    ------
    InvalidInput : fewer than three targets, an unknown parameter.
    NotIdentifiable : the tour cannot tell any of them.
    """
    keys = list(dict.fromkeys(zip(readings.pose, readings.target.tolist(), strict=True)))
    targets = np.array([target for _, target in keys], dtype=np.int64)
    if len(set(targets.tolist())) < 3 or len(keys) < 6:
        raise InvalidInput(
            f"the reference has {len(keys)} measurements of {len(set(targets.tolist()))} targets: at least six "
            "measurements of three targets are needed"
        )
    kernel = kernel_of(robot.model, robot.statics)
    kernel = kernel if sensor is None else kernel.with_references(None, sensor)
    place = {key: k for k, key in enumerate(keys)}
    slot = np.array([place[key] for key in zip(readings.pose, readings.target.tolist(), strict=True)])
    p, covariance = _mean_places(kernel, readings, slot, len(keys))
    first = np.array([int(np.argmax(slot == k)) for k in range(len(keys))])
    sizes = thermal_sizes(robot.model) | dict(bounds or {})
    names = tuple(parameters) if parameters is not None else tuple(sizes)
    for name in names:
        if name not in kernel.index:
            raise InvalidInput(f"robot '{robot.model.name}' has no parameter '{name}': names are like axis2.x")
    size = np.array([sizes.get(n, 1e-4 if n.rsplit(".", 1)[-1] in "xyz" else 2.6e-4) for n in names])
    made = DriftReference(
        robot,
        sensor,
        tuple(pose for pose, _ in keys),
        targets,
        readings.inputs.q[first],
        readings.inputs.load[first],
        p,
        covariance,
        names,
        size,
        settings or DriftSettings(),
    )
    one_tour = readings.subset(first)
    kept = choose_parameters(made, one_tour, required=parameters is not None)
    if not len(kept):
        raise NotIdentifiable("the tour can tell none of the parameters that drift: measure from more directions")
    return replace(made, names=tuple(names[i] for i in kept), sizes=size[kept])


def _mean_places(kernel: Kernel, readings: Readings, slot: Ints, n: int) -> tuple[Array, Array]:
    """Places (n, 3) in the world, means of the readings of each ``slot`` (m,), with covariance (n, 3, 3)."""
    T = kernel.frames(kernel.theta0, readings.inputs)
    seen = tf.transform(T, readings.x)
    count = np.bincount(slot, minlength=n).astype(float)
    p = np.stack([np.bincount(slot, seen[:, i], n) / count for i in range(3)], axis=1)
    covariance = np.zeros((n, 3, 3))
    np.add.at(covariance, slot, tf.transport_covariance(T[:, :3, :3], readings.covariance))
    return p, covariance / count[:, None, None] ** 2
