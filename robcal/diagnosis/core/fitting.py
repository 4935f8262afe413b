"""A robot fitted to a recording together with the causes that were accepted, linearised where the fit ended."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from robcal.diagnosis.core.recording import Recording, observation_data
from robcal.diagnosis.scan.statistics import orthonormal_basis
from robcal.estimation.levenberg import Linearised, Schedule, levenberg
from robcal.estimation.minimum_norm import pseudo_covariance, solve
from robcal.estimation.summary import TerminationSettings
from robcal.physics.cause import Array, Constants, LinearCause, ObservationCause, prior_scales
from robcal.robot.kernel import Kernel, PoseInputs
from robcal.robot.kernel_cache import kernel_of
from robcal.robot.model import RobotModel, Term
from robcal.robot.terms import identifier

MOST_FREE = 12
"""A law with more amplitudes than these is a Gaussian process: its prior goes into the fit."""
TERM_PARTS = 24
"""Amplitudes in one expression of the kernel, which may not grow without end."""
TERM_LENGTH = 2400
"""Characters of the same."""
DAMPING = Schedule(start=1.0, grow=256.0, shrink=1.0 / 16.0, undamped=np.inf)
"""In units of the largest steps that make sense: near-parallel axes leave directions that a full step would follow
beyond all linearity. As long as steps lower the sum of squares it fades, and the last ones are undamped."""
NEGLIGIBLE = 5e-7
"""Half the sum of squares that a further step need not save."""
LARGEST_STEP = 5.0
"""Largest step of a parameter that makes sense, in its usual sizes."""


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
    direct = [item for item in accepted if isinstance(item.cause, ObservationCause)]
    sizes = {f"{term.name}.{short}": size for term in model.terms for short, size in term.priors.items()}
    width = len(names) + sum(len(item.names) for item in direct)
    start = np.array(kernel.theta0, dtype=float)
    bounds = np.diag(damping(names, width, kernel.variables(start, inputs)))[: len(names)]
    expected = np.array([sizes.get(name, np.inf) for name in names])
    problem = _Problem(kernel, recording, inputs, columns, direct, bounds, expected)
    at = problem.at(start)
    if iterations:
        at, _ = levenberg(problem.linearise, at, TerminationSettings(iterations, 6, 0.0, NEGLIGIBLE), DAMPING)
    # displacements of observations are linear: their amplitudes follow from the last linear problem
    linear = solve(at.jacobian, at.residual)[len(columns) :] if direct else np.zeros(0)
    residual = at.residual - at.jacobian[:, len(columns) :] @ linear
    prior = problem.prior(at.scale)
    covariance = pseudo_covariance(np.vstack([at.jacobian, prior]))
    filled = model.with_parameters({name: float(at.theta[position[name]]) for name in names})
    return Fit(
        filled,
        kernel,
        at.theta,
        tuple(names),
        _amplitudes(accepted, direct, names, position, at.theta, linear, covariance, len(columns)),
        residual,
        at.jacobian,
        np.repeat(recording.observations.pose, len(residual) // len(recording.observations.pose)),
        inputs,
        at.frames,
        covariance,
        prior,
        -prior[:, : len(columns)] @ at.theta[columns],
        recording.common_errors(residual),
    )


@dataclass(frozen=True)
class _At:
    """Parameters (P,), the frames, whitened residuals (m,) and Jacobian (m, p) there, and the rows' own scatter."""

    theta: Array
    frames: Array
    residual: Array
    jacobian: Array
    scale: float


@dataclass(frozen=True)
class _Problem:
    """Least squares of the parameters ``columns`` (k,) of a kernel and the amplitudes of observation causes.

    bounds : (k, p) rows that damp a step. expected : (k,) standard deviations about zero, infinite without: a prior
        weighs against observations of the variance that they show.
    """

    kernel: Kernel
    recording: Recording
    inputs: PoseInputs
    columns: Array
    direct: Sequence[Accepted]
    bounds: Array
    expected: Array

    def at(self, theta: Array, scale: float | None = None) -> _At:
        """Linearised, the Jacobian's columns by ``columns``, then by observation causes."""
        frames, J = self.kernel.frames_and_jacobian(theta, self.inputs, columns=self.columns)
        residual, jacobian = self.recording.linearise(frames, J)
        if self.direct:
            data = observation_data(self.recording, frames, self.kernel.variables(theta, self.inputs))
            shifts = [
                item.cause.observation_shift(data, item.constants)
                for item in self.direct
                if isinstance(item.cause, ObservationCause)
            ]
            rows = (self.recording.whiten(shift, frames) for shift in shifts)
            jacobian = np.concatenate([jacobian, *rows], axis=1)
        scatter = float(np.sqrt(residual @ residual / len(residual))) if scale is None else scale
        return _At(theta, frames, residual, jacobian, scatter)

    def prior(self, scale: float) -> Array:
        """(n, p) rows of what is expected of parameters, where rows of observations scatter by ``scale``."""
        rows = scale * np.eye(len(self.columns), self.bounds.shape[1]) / self.expected[:, None]
        return rows[np.isfinite(self.expected)]

    def linearise(self, here: _At) -> Linearised[_At]:
        """For the iteration; the scatter of the rows is held while one step is sought."""
        k, prior = len(self.columns), self.prior(here.scale)

        def cost(theta: Array, left: Array) -> float:
            expected = prior[:, :k] @ theta[self.columns]
            return 0.5 * float(left @ left + expected @ expected)

        def evaluate(at: _At) -> float:
            linear = at.jacobian[:, k:]
            return cost(at.theta, at.residual - linear @ solve(linear, at.residual) if self.direct else at.residual)

        now = evaluate(here)

        def propose(damping: float) -> tuple[_At, float]:
            rows = [here.jacobian, np.sqrt(damping) * self.bounds, prior]
            expected = -prior[:, :k] @ here.theta[self.columns]
            step = solve(np.vstack(rows), np.concatenate([here.residual, np.zeros(k), expected]))
            theta = here.theta.copy()
            theta[self.columns] += step[:k]
            left = here.residual - here.jacobian @ step
            scale = float(np.sqrt(left @ left / max(len(left) - len(step), 1)))
            return self.at(theta, scale), now - cost(theta, left)

        return Linearised(now, propose, evaluate)


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
