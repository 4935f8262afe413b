"""Whitened tangent columns of causes at a fit: what each cause would do to the residuals."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from robcal.diagnosis.core.fitting import Fit
from robcal.diagnosis.core.recording import Recording, observation_data
from robcal.diagnosis.scan.statistics import Entry
from robcal.physics.cause import Array, Basis, Constants, LinearCause, ObservationCause, ObservationData
from robcal.robot.terms import names_in


class Laws:
    """Values of expressions at the poses of one recording.

    Those that depend on the recording alone, not on the model, are evaluated once for all fits that share the object.
    """

    def __init__(self, recording: Recording) -> None:
        joints = (f"q{k + 1}" for k in range(recording.q.shape[1]))
        self._recorded = frozenset([*recording.covariates, *joints])
        self._known: dict[tuple[str | float, ...], Array] = {}

    def value(self, basis: Basis, variables: Mapping[str, Array]) -> Array:
        """Value (n,) of a law; `variables` are those of the present fit."""
        key: tuple[str | float, ...] = (basis.template, *basis.constants.values())
        if key in self._known:
            return self._known[key]
        value = np.broadcast_to(basis.value(variables), variables["index"].shape)
        if names_in(basis.template).difference(basis.constants) <= self._recorded:
            self._known[key] = value
        return value


@dataclass(frozen=True)
class Tangents:
    """Everything needed to write a cause's columns at one fit.

    Attributes
    ----------
    motion : (frame, kind) to columns (m,) of a unit of that number, whitened pose by pose: a law multiplies them before
        errors common to all poses mix the rows.
    parameters : name of a kernel parameter to its whitened column (m,).
    variables : per pose. row_pose : (m,).
    """

    recording: Recording
    motion: Mapping[tuple[str, str], Array]
    parameters: Mapping[str, Array]
    variables: Mapping[str, Array]
    row_pose: Array
    frames: Array
    data: ObservationData
    laws: Laws

    def columns(self, cause: LinearCause, constants: Constants) -> Array:
        """Whitened columns (m, c) of a cause per unit amplitude."""
        if cause.free_parameters:
            return np.stack([self.parameters[name] for name in cause.free_parameters], axis=1)
        if isinstance(cause, ObservationCause):
            return self.recording.whiten(cause.observation_shift(self.data, constants), self.frames)
        names = cause.names(constants)
        out = np.zeros((len(self.row_pose), len(names)))
        for basis in cause.laws(constants):
            law = self.laws.value(basis, self.variables)
            out[:, names.index(basis.parameter)] += self.motion[basis.frame, basis.kind] * law[self.row_pose]
        return self.recording.given_common(out)


def tangents(fit: Fit, recording: Recording, laws: Laws | None = None) -> Tangents:
    """Tangents at a fit; `laws` are shared by several fits of the same poses."""
    kernel = fit.kernel
    basis = kernel.scan_basis(fit.theta, fit.inputs)
    _, motion = replace(recording, common=None).linearise(fit.frames, basis.J)
    keys = [tuple(name.rsplit(".", 1)) for name in basis.names]
    _, all_parameters = kernel.frames_and_jacobian(fit.theta, fit.inputs)
    _, whitened = recording.linearise(fit.frames, all_parameters)
    variables = kernel.variables(fit.theta, fit.inputs)
    return Tangents(
        recording,
        {(key[0], key[1]): motion[:, i] for i, key in enumerate(keys)},
        {name: whitened[:, i] for i, name in enumerate(kernel.names)},
        variables,
        fit.row_pose,
        fit.frames,
        observation_data(recording, fit.frames, variables),
        Laws(recording) if laws is None else laws,
    )


def entries(causes: Sequence[LinearCause], at: Tangents) -> list[Entry]:
    """Columns of all causes at all their grid points, scaled by the typical amplitudes."""
    out = []
    for i, cause in enumerate(causes):
        for g, constants in enumerate(cause.grid):
            columns = at.columns(cause, constants) * cause.sizes(constants)
            if np.all(np.isfinite(columns)):
                out.append(Entry(i, g, columns, cause.positive))
    return out
