"""A robot fitted to a recording together with the causes that were accepted, linearised where the fit ended."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from robcal.diagnosis.core.recording import Recording, observation_data
from robcal.diagnosis.scan.statistics import orthonormal_basis
from robcal.physics.cause import Array, Constants, LinearCause, ObservationCause, prior_scales
from robcal.robot.kernel import Kernel, PoseInputs
from robcal.robot.kernel_cache import kernel_of
from robcal.robot.model import RobotModel, Term
from robcal.robot.terms import identifier

UNDETERMINED = 1e-6
"""Directions of the scaled Jacobian below this share of the largest stay as they are: their sigma would be a radian."""
MOST_FREE = 12
"""A law with more amplitudes than these is a Gaussian process: its prior goes into the fit."""
TERM_PARTS = 24
"""Amplitudes in one expression of the kernel, which may not grow without end."""
TERM_LENGTH = 2400
"""Characters of the same."""
RELEASE = 4.0
"""Factor by which steps may grow after one that lowered the sum of squares."""
LARGEST_STEP = 5.0
"""Largest step of a parameter that makes sense, in its usual sizes."""
MANY = 120
"""Parameters from which normal equations replace the singular values of the Jacobian."""


@dataclass(frozen=True)
class Accepted:
    """A cause with constants that is part of the model, and its amplitudes (SI)."""

    cause: LinearCause
    constants: Constants
    values: Array
    covariance: Array

    @property
    def names(self) -> tuple[str, ...]:
        """Short names of the amplitudes."""
        return self.cause.names(self.constants)

    def term(self, number: int) -> str:
        """Name of its term in the kernel, as the cause of that number."""
        return f"{identifier(self.cause.where)}_{self.cause.name}_{number}"

    def full_names(self, number: int) -> tuple[str, ...]:
        """Names of the kernel's parameters that are the amplitudes of a robot cause."""
        return self.cause.free_parameters or tuple(f"{self.term(number)}.{short}" for short in self.names)


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

    def columns_of(self, item: Accepted) -> Array:
        """Columns of `jacobian` that belong to the amplitudes of one of the accepted causes."""
        number = next(k for k, other in enumerate(self.accepted) if other is item)
        if not isinstance(item.cause, ObservationCause):
            return np.array([self.free.index(name) for name in item.full_names(number)], dtype=np.intp)
        before = [len(other.names) for other in self.accepted[:number] if isinstance(other.cause, ObservationCause)]
        return np.arange(len(item.names), dtype=np.intp) + len(self.free) + sum(before)

    @property
    def redundancy(self) -> int:
        """Observations less parameters."""
        return len(self.residual) - orthonormal_basis(self.jacobian).shape[1]

    @property
    def variance_factor(self) -> float:
        """Mean square of the whitened residuals per degree of freedom."""
        return float(self.residual @ self.residual) / max(self.redundancy, 1)


def terms_of(accepted: Accepted, number: int) -> tuple[Term, ...]:
    """Terms of the kernel for an accepted robot cause; amplitudes as its parameters."""
    cause = accepted.cause
    name = accepted.term(number)
    values = dict(zip(accepted.names, map(float, accepted.values), strict=True))
    groups: dict[tuple[str, str], list[tuple[str, str]]] = {}
    for basis in cause.laws(accepted.constants):
        groups.setdefault((basis.frame, basis.kind), []).append((basis.parameter, basis.expression))
    sizes: dict[str, float] = {}
    if len(accepted.names) > MOST_FREE:
        sizes = dict(zip(accepted.names, map(float, cause.sizes(accepted.constants)), strict=True))
    return tuple(
        Term(
            name,
            frame,
            kind,
            " + ".join(f"{p}*({expression})" for p, expression in chunk),
            {p: values[p] for p, _ in chunk},
            priors={p: sizes[p] for p, _ in chunk if p in sizes},
            cause=cause.name,
        )
        for (frame, kind), parts in groups.items()
        for chunk in _chunks(parts)
    )


def _chunks(parts: Sequence[tuple[str, str]]) -> Iterator[list[tuple[str, str]]]:
    """Parameters with their expressions, as many together as one expression may hold."""
    chunk: list[tuple[str, str]] = []
    for part in parts:
        if chunk and (len(chunk) == TERM_PARTS or sum(len(text) for _, text in [*chunk, part]) > TERM_LENGTH):
            yield chunk
            chunk = []
        chunk.append(part)
    yield chunk


def fit(
    model: RobotModel,
    recording: Recording,
    free: Sequence[str],
    accepted: Sequence[Accepted] = (),
    *,
    iterations: int = 20,
    statics: str = "converged",
) -> Fit:
    """Least squares of the free parameters and all accepted causes together, from the model's present values.

    Robot causes become terms of the kernel; observation causes stay linear displacements of what was measured.
    """
    for number, item in enumerate(accepted):
        model = model.with_terms(terms_of(item, number))
    kernel = kernel_of(model, statics)
    inputs = recording.inputs(kernel)
    names = list(dict.fromkeys([*free, *(n for a in accepted for n in a.cause.free_parameters)]))
    names += [full for term in model.terms for full in term.parameter_names if full not in names]
    position = {name: i for i, name in enumerate(kernel.names)}
    columns = np.array([position[name] for name in names])
    theta = np.array(kernel.theta0, dtype=float)
    direct = [item for item in accepted if isinstance(item.cause, ObservationCause)]
    obs = recording.observations
    linearised = partial(_linearised, kernel, recording, inputs, columns, direct)

    width = len(names) + sum(len(item.names) for item in direct)
    bounds = np.diag(damping(names, width, kernel.variables(theta, inputs)))[: len(names)]
    sizes = {f"{term.name}.{short}": size for term in model.terms for short, size in term.priors.items()}
    held = np.array([k for k, name in enumerate(names) if name in sizes], dtype=np.intp)
    prior = np.zeros((len(held), width))
    scale, trust = 0.0, 1.0
    best: tuple[float, Array, Array, Array] | None = None
    for _ in range(iterations):
        _, residual, jacobian = linearised(theta)
        cost = _least(residual, jacobian[:, len(columns) :])
        if best is None or cost <= best[0]:
            # as long as steps keep their promise the damping fades, and the last ones are undamped
            trust = trust if best is None else trust * RELEASE
            best = (cost, theta.copy(), residual, jacobian)
        else:
            trust /= RELEASE**2
            theta, residual, jacobian = best[1].copy(), best[2], best[3]
        if len(held):
            # a prior weighs against observations of the variance that they show
            scale = scale or float(np.sqrt(residual @ residual / len(residual)))
            prior[np.arange(len(held)), held] = [scale / sizes[names[k]] for k in held]
        # steps are damped by the size that deviations can have: near-parallel axes leave directions that a full
        # step would follow beyond all linearity
        rows = np.concatenate([residual, np.zeros(len(bounds)), -prior[:, held] @ theta[columns[held]]])
        step = solve(np.vstack([jacobian, bounds / trust, prior]), rows)[: len(columns)]
        if len(held):
            left = residual - jacobian[:, : len(columns)] @ step
            scale = float(np.sqrt(left @ left / max(len(left) - width, 1)))
        theta[columns] += step
        if float(np.sum((jacobian[:, : len(columns)] @ step) ** 2)) < 1e-6:
            break
    frames, residual, jacobian = linearised(theta)
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


def _linearised(
    kernel: Kernel, recording: Recording, inputs: PoseInputs, columns: Array, direct: Sequence[Accepted], theta: Array
) -> tuple[Array, Array, Array]:
    """Frames, whitened residuals (m,) and Jacobian (m, p) by the parameters ``columns``, then by observation causes."""
    frames, J = kernel.frames_and_jacobian(theta, inputs, columns=columns)
    residual, jacobian = recording.linearise(frames, J)
    if direct:
        data = observation_data(recording, frames, kernel.variables(theta, inputs))
        shifts = [
            item.cause.observation_shift(data, item.constants)
            for item in direct
            if isinstance(item.cause, ObservationCause)
        ]
        jacobian = np.concatenate([jacobian, *(recording.whiten(shift, frames) for shift in shifts)], axis=1)
    return frames, residual, jacobian


def _least(residual: Array, columns: Array) -> float:
    """Sum of squares (of whitened rows) that is left beside displacements of observations."""
    left = residual - columns @ solve(columns, residual) if columns.shape[1] else residual
    return float(left @ left)


def damping(names: Sequence[str], columns: int, variables: Mapping[str, Array]) -> Array:
    """Reciprocals (columns,) of the largest steps that make sense for named parameters; zero for amplitudes."""
    largest = LARGEST_STEP * prior_scales(names, variables)
    bounds = np.where(largest > 0, 1.0 / np.where(largest > 0, largest, 1.0), 0.0)
    return np.concatenate([bounds, np.zeros(columns - len(names))])


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
        if isinstance(item.cause, ObservationCause):
            where = np.arange(first_direct + offset, first_direct + offset + width)
            values = linear[offset : offset + width]
            offset += width
        else:
            full = item.full_names(number)
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
