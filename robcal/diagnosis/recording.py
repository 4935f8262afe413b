"""What a diagnosis works on: a robot, poses, observations; and one linearised fit of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property

import numpy as np

from robcal.calibration.observations import (
    DistanceObservations,
    FrameObservations,
    PointObservations,
    SensorPointObservations,
)
from robcal.diagnosis.decorrelation import CommonNoise, SharedNoise
from robcal.diagnosis.scan import orthonormal_basis
from robcal.errors import InvalidInput
from robcal.physics.family import Array, Constants, Family, ObservationData
from robcal.robot.kernel import Kernel, PoseInputs
from robcal.robot.kernel_cache import kernel_of
from robcal.robot.model import RobotModel, Term
from robcal.transforms import transform

UNDETERMINED = 1e-6
"""Directions of the scaled Jacobian below this share of the largest stay as they are: their sigma would be a radian."""
MOST_FREE = 12
"""A law with more amplitudes than these is a Gaussian process: its prior goes into the fit."""
TERM_PARTS = 24
"""Amplitudes in one expression of the kernel, which may not grow without end."""
MANY = 120
"""Parameters from which normal equations replace the singular values of the Jacobian."""
SpatialObservations = FrameObservations | PointObservations | DistanceObservations | SensorPointObservations


@dataclass(frozen=True)
class Recording:
    """Recorded poses and what was measured in them.

    Attributes
    ----------
    q : (n, joints) in the sense of q, rad or m.
    payload : name of the payload of each pose, or None.
    covariates : per pose, (n,) each: index, approachK, time_s, temp_*_c ...
    names : of the poses.
    observations : one kind of measurement; `pose` in it counts rows of q.
    body : name of the measuring body; ids : its targets.
    shared : repeatability of the joints as estimated.
    common : (m_obs, 3 | 6, k) displacements of points or frames by one
        standard deviation of errors common to all poses (orientation of the station, coordinates of the body).
    own_station : measured by cameras whose own images are diagnosed: their moves are told from those.
    """

    q: Array
    payload: tuple[str | None, ...]
    covariates: Mapping[str, Array]
    names: tuple[str, ...]
    observations: SpatialObservations
    body: str = "body"
    ids: tuple[int, ...] = ()
    shared: SharedNoise | None = None
    common: Array | None = None
    own_station: bool = False

    def linearise(self, frames: Array, J: Array) -> tuple[Array, Array]:
        """Whitened residuals (m,) and Jacobian (m, p) at modelled frames (n, 4, 4) with right twists (n, 6, p)."""
        residual, jacobian = self.observations.linearise(frames, J)
        if self.shared is None and self.common is None:
            return residual, jacobian
        return self._decorrelate(residual), self._decorrelate(jacobian)

    def whiten(self, displacement: Array, frames: Array) -> Array:
        """Whitened rows (m, p) of displacements (m_obs, k, p) of the observations; frames (n, 4, 4) as modelled."""
        L = np.linalg.cholesky(self.observations.noise(frames))
        return self._decorrelate(np.linalg.solve(L, displacement).reshape(-1, displacement.shape[2]))

    def unwhiten(self, rows: Array, frames: Array) -> Array:
        """Displacements (m_obs, k, p) of whitened rows (m, p); inverse of :meth:`whiten`."""
        plain = rows if self._common is None else self._common.unwhiten(rows)
        plain = plain if self.shared is None else self.shared.unwhiten(plain)
        L = np.linalg.cholesky(self.observations.noise(frames))
        return np.asarray(L @ plain.reshape(len(L), -1, rows.shape[1]))

    def local(self, rows: Array, frames: Array) -> Array:
        """Displacements (m_obs, k, p) of whitened rows (m, p) without what the errors common to all poses explain."""
        plain = rows if self._common is None else self._common.whiten(rows)
        plain = plain if self.shared is None else self.shared.unwhiten(plain)
        L = np.linalg.cholesky(self.observations.noise(frames))
        return np.asarray(L @ plain.reshape(len(L), -1, rows.shape[1]))

    def beside_common(self, rows: Array) -> Array:
        """Rows (m, ...) that are whitened pose by pose, beside the errors common to all poses."""
        return rows if self._common is None else self._common.whiten(rows)

    def common_errors(self, residual: Array) -> Array | None:
        """Most probable errors common to all poses (k,), in their standard deviations, from whitened residuals (m,)."""
        return None if self._common is None else self._common.estimate(residual)

    def _decorrelate(self, rows: Array) -> Array:
        rows = rows if self.shared is None else self.shared.whiten(rows)
        return rows if self._common is None else self._common.whiten(rows)

    @cached_property
    def _common(self) -> CommonNoise | None:
        if self.common is None:
            return None
        L = np.linalg.cholesky(self.observations.noise(np.tile(np.eye(4), (len(self.q), 1, 1))))
        columns = np.linalg.solve(L, self.common).reshape(-1, self.common.shape[2])
        return CommonNoise(columns if self.shared is None else self.shared.whiten(columns))

    @cached_property
    def laws(self) -> dict[tuple[str | float, ...], Array]:
        """Values (n,) of expressions already evaluated that depend on the recording alone, not on the model."""
        return {}

    def pose_name(self, index: float) -> str:
        """Name of the pose with a value of the covariate `index`."""
        nearest = int(np.argmin(np.abs(self.covariates["index"] - index)))
        return self.names[nearest]

    def inputs(self, kernel: Kernel) -> PoseInputs:
        """The poses as the kernel wants them."""
        return kernel.poses(self.q, payload=self.payload, covariates=self.covariates)

    @property
    def observations_are_spatial(self) -> bool:
        """Whether the observations tell directions (frames and points do, distances do not)."""
        return not isinstance(self.observations, DistanceObservations)

    def row_groups(self, rows: int) -> Array:
        """Label of the observation to which each row of the residuals belongs."""
        return np.repeat(np.arange(len(self.observations.pose)), rows // len(self.observations.pose))

    def without_observations(self, drop: Array) -> Recording:
        """Without the observations of the given indices."""
        keep = np.setdiff1d(np.arange(len(self.observations.pose)), drop)
        shared = None if self.shared is None else self.shared.subset(keep)
        common = None if self.common is None else self.common[keep]
        return replace(self, observations=_rows(self.observations, keep), shared=shared, common=common)

    def subset(self, keep: Array) -> Recording:
        """Only the poses where `keep` (n,) is true; observations of the others are left out."""
        rows = np.flatnonzero(keep)
        number = np.full(len(self.q), -1)
        number[rows] = np.arange(len(rows))
        chosen = np.flatnonzero(keep[self.observations.pose])
        observations = _rows(self.observations, chosen)
        observations = replace(observations, pose=number[observations.pose])
        return replace(
            self,
            q=self.q[rows],
            payload=tuple(self.payload[i] for i in rows),
            names=tuple(self.names[i] for i in rows),
            covariates={name: np.asarray(values)[rows] for name, values in self.covariates.items()},
            observations=observations,
            shared=None,
            common=None if self.common is None else self.common[chosen],
        )


def _rows(observations: SpatialObservations, keep: Array) -> SpatialObservations:
    """The observations of the given indices; poses keep their numbers."""
    count = len(observations.pose)
    arrays = {field.name: getattr(observations, field.name) for field in fields(observations)}
    return replace(observations, **{name: v[keep] for name, v in arrays.items() if np.shape(v)[:1] == (count,)})


@dataclass(frozen=True)
class Accepted:
    """A family with constants that is part of the model, and its amplitudes (SI)."""

    family: Family
    constants: Constants
    values: Array
    covariance: Array

    @property
    def names(self) -> tuple[str, ...]:
        """Short names of the amplitudes."""
        return self.family.names(self.constants)


@dataclass(frozen=True)
class Fit:
    """A model fitted to a recording, linearised where it ended.

    Attributes
    ----------
    model : robot with parameters and terms filled. kernel : of that model. theta : (P,) all its parameters.
    free : names of the fitted parameters, in the order of the first columns of `jacobian`.
    accepted : causes in the model, their amplitudes and covariances.
    residual : (m,) whitened, measured - model. jacobian : (m, p) whitened.
    row_pose : (m,) pose of each row. inputs, frames : poses and modelled frames of the tool.
    covariance : (p, p) of the free parameters and the amplitudes of observation causes, variance factor one.
    prior, prior_residual : (k, p) and (k,) rows of what is expected of amplitudes, in the units of the residuals.
    common : (k,) errors common to all poses as estimated, in their standard deviations (`Recording.common`).
    """

    model: RobotModel
    kernel: Kernel
    theta: Array
    free: tuple[str, ...]
    accepted: tuple[Accepted, ...]
    residual: Array
    jacobian: Array
    row_pose: Array
    inputs: PoseInputs
    frames: Array
    covariance: Array
    prior: Array
    prior_residual: Array
    common: Array | None = None

    @property
    def redundancy(self) -> int:
        """Observations less parameters."""
        return len(self.residual) - orthonormal_basis(self.jacobian).shape[1]

    @property
    def variance_factor(self) -> float:
        """Mean square of the whitened residuals per degree of freedom."""
        return float(self.residual @ self.residual) / max(self.redundancy, 1)


def observation_data(recording: Recording, frames: Array, variables: Mapping[str, Array]) -> ObservationData:
    """What observation families need, at the modelled frames (n, 4, 4)."""
    obs = recording.observations
    m = len(obs.pose)
    T = frames[obs.pose]
    if isinstance(obs, PointObservations):
        return ObservationData(
            "points", obs.pose, np.asarray(obs.target), T, obs.p_tool, transform(T, obs.p_tool), None, variables
        )
    if isinstance(obs, FrameObservations):
        none = np.full(m, -1)
        return ObservationData("frames", obs.pose, none, T, np.zeros((m, 3)), T[:, :3, 3], None, variables)
    if isinstance(obs, DistanceObservations):
        none = np.full(m, -1)
        return ObservationData("distances", obs.pose, none, T, np.zeros((m, 3)), T[:, :3, 3], None, variables)
    if isinstance(obs, SensorPointObservations):
        none = np.full(m, -1)
        return ObservationData(
            "sensor", obs.pose, none, T, obs.p_sensor, transform(T, obs.p_sensor), obs.p_sensor, variables
        )
    raise InvalidInput(f"observations of type {type(obs).__name__} cannot be diagnosed")


def terms_of(accepted: Accepted, number: int) -> tuple[Term, ...]:
    """Terms of the kernel for an accepted robot cause; amplitudes as its parameters."""
    family = accepted.family
    if family.bases is None:
        return ()
    name = f"{family.where}_{family.cause}_{number}"
    values = dict(zip(accepted.names, map(float, accepted.values), strict=True))
    groups: dict[tuple[str, str], list[tuple[str, str]]] = {}
    for basis in family.bases(accepted.constants):
        groups.setdefault((basis.frame, basis.kind), []).append((basis.parameter, basis.expression))
    sizes: dict[str, float] = {}
    if len(accepted.names) > MOST_FREE:
        sizes = dict(zip(accepted.names, map(float, family.sizes(accepted.constants)), strict=True))
    return tuple(
        Term(
            name,
            frame,
            kind,
            " + ".join(f"{p}*({expression})" for p, expression in parts[k : k + TERM_PARTS]),
            {p: values[p] for p, _ in parts[k : k + TERM_PARTS]},
            priors={p: sizes[p] for p, _ in parts[k : k + TERM_PARTS] if p in sizes},
            cause=family.cause,
        )
        for (frame, kind), parts in groups.items()
        for k in range(0, len(parts), TERM_PARTS)
    )


def fit(
    model: RobotModel,
    recording: Recording,
    free: Sequence[str],
    accepted: Sequence[Accepted] = (),
    *,
    iterations: int = 8,
    statics: str = "converged",
) -> Fit:
    """Least squares of the free parameters and all accepted causes together, from the model's present values.

    Robot causes become terms of the kernel; observation causes stay linear displacements of what was measured.
    """
    for number, item in enumerate(accepted):
        model = model.with_terms(terms_of(item, number))
    kernel = kernel_of(model, statics)
    inputs = recording.inputs(kernel)
    names = list(dict.fromkeys([*free, *(n for a in accepted for n in a.family.frees)]))
    names += [full for term in model.terms for full in term.parameter_names if full not in names]
    position = {name: i for i, name in enumerate(kernel.names)}
    columns = np.array([position[name] for name in names])
    theta = np.array(kernel.theta0, dtype=float)
    direct = [item for item in accepted if item.family.displace is not None]
    obs = recording.observations

    def linearised() -> tuple[Array, Array, Array]:
        frames, J = kernel.frames_and_jacobian(theta, inputs, columns=columns)
        residual, jacobian = recording.linearise(frames, J)
        if direct:
            data = observation_data(recording, frames, kernel.variables(theta, inputs))
            shifts = [item.family.displace(data, item.constants) for item in direct if item.family.displace is not None]
            jacobian = np.concatenate([jacobian, *(recording.whiten(shift, frames) for shift in shifts)], axis=1)
        return frames, residual, jacobian

    width = len(names) + sum(len(item.names) for item in direct)
    brake = np.diag(largest_steps(names, width))[: len(names)]
    sizes = {f"{term.name}.{short}": size for term in model.terms for short, size in term.priors.items()}
    held = np.array([k for k, name in enumerate(names) if name in sizes], dtype=np.intp)
    prior = np.zeros((len(held), width))
    previous, scale = np.inf, 0.0
    for _ in range(iterations):
        _, residual, jacobian = linearised()
        if len(held):
            # a prior weighs against observations of the variance that they show
            scale = scale or float(np.sqrt(residual @ residual / len(residual)))
            prior[np.arange(len(held)), held] = [scale / sizes[names[k]] for k in held]
        # steps are damped by the size that deviations can have: near-parallel axes leave directions that a full
        # step would follow beyond all linearity
        rows = np.concatenate([residual, np.zeros(len(brake)), -prior[:, held] @ theta[columns[held]]])
        step = solve(np.vstack([jacobian, brake, prior]), rows)[: len(columns)]
        if len(held):
            left = residual - jacobian[:, : len(columns)] @ step
            scale = float(np.sqrt(left @ left / max(len(left) - width, 1)))
        theta[columns] += step
        change = float(np.sum((jacobian[:, : len(columns)] @ step) ** 2))
        if change < 1e-6 or abs(previous - change) < 1e-14:
            break
        previous = change
    frames, residual, jacobian = linearised()
    # displacements of observations are linear: their amplitudes follow from the last linear problem
    linear = solve(jacobian, residual)[len(columns) :] if direct else np.zeros(0)
    residual = residual - jacobian[:, len(columns) :] @ linear
    covariance = pseudo_covariance(np.vstack([jacobian, prior]))
    filled = model.with_parameters({name: float(theta[position[name]]) for name in names})
    done = _amplitudes(accepted, direct, names, position, theta, linear, covariance, len(columns))
    return Fit(
        filled,
        kernel,
        theta,
        tuple(names),
        done,
        residual,
        jacobian,
        np.repeat(obs.pose, len(residual) // len(obs.pose)),
        inputs,
        frames,
        covariance,
        prior,
        -prior[:, : len(columns)] @ theta[columns],
        recording.common_errors(residual),
    )


def largest_steps(names: Sequence[str], columns: int) -> Array:
    """Reciprocals (columns,) of the largest steps that make sense for named parameters; zero for amplitudes."""
    return np.array([*map(_brake, names), *[0.0] * (columns - len(names))])


def _brake(name: str) -> float:
    """Reciprocal of the largest step that makes sense for a parameter; zero for amplitudes of causes."""
    kind = name.rsplit(".", 1)[-1]
    if kind.startswith("elastic_"):
        return 1.0 / 2e-5
    return 1.0 / 5e-3 if kind in ("x", "y", "z", "roll", "pitch", "yaw") and not name.startswith("payload.") else 0.0


def _amplitudes(
    accepted: Sequence[Accepted],
    direct: Sequence[Accepted],
    names: Sequence[str],
    position: Mapping[str, int],
    theta: Array,
    linear: Array,
    covariance: Array,
    first_direct: int,
) -> tuple[Accepted, ...]:
    done = []
    offset = 0
    for number, item in enumerate(accepted):
        width = len(item.names)
        if item.family.displace is not None:
            where = np.arange(first_direct + offset, first_direct + offset + width)
            values = linear[offset : offset + width]
            offset += width
        else:
            full = item.family.frees or tuple(
                f"{item.family.where}_{item.family.cause}_{number}.{short}" for short in item.names
            )
            where = np.array([names.index(name) for name in full])
            values = np.array([theta[position[name]] for name in full])
        done.append(replace(item, values=values, covariance=covariance[np.ix_(where, where)]))
    return tuple(done)


def solve(jacobian: Array, residual: Array) -> Array:
    """Minimum-norm least-squares step, columns scaled to unit length first."""
    size = np.linalg.norm(jacobian, axis=0)
    safe = np.where(size > 0, size, 1.0)
    scaled = jacobian / safe
    if jacobian.shape[1] > MANY:
        gram = scaled.T @ scaled + UNDETERMINED**2 * np.eye(jacobian.shape[1])
        return np.asarray(np.linalg.solve(gram, scaled.T @ residual) / safe)
    return np.asarray(np.linalg.lstsq(scaled, residual, rcond=UNDETERMINED)[0] / safe)


def pseudo_covariance(jacobian: Array) -> Array:
    """Pseudo-inverse of the normal matrix, columns scaled; directions without information get no variance.

    By singular values of the Jacobian, since those of the normal matrix drown in rounding at the square of its range.
    """
    size = np.linalg.norm(jacobian, axis=0)
    safe = np.where(size > 0, size, 1.0)
    scaled = jacobian / safe
    if jacobian.shape[1] > MANY:  # the triangular factor has the same singular values
        scaled = np.asarray(np.linalg.qr(scaled, mode="r"))
    _, singular, right = np.linalg.svd(scaled, full_matrices=False)
    seen = singular > UNDETERMINED * singular.max(initial=0.0)
    root = (right[seen].T / singular[seen]) / safe[:, None]
    return root @ root.T
