"""Whitened tangent columns of causes at a fit: what each cause would do to the residuals."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from robcal.diagnosis.core.fitting import Fit
from robcal.diagnosis.core.recording import Recording, observation_data
from robcal.diagnosis.scan.statistics import Entry
from robcal.physics.cause import Array, Basis, Constants, LinearCause, ObservationCause, ObservationData
from robcal.robot.terms import names_in


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

    def columns(self, cause: LinearCause, constants: Constants) -> Array:
        """Whitened columns (m, c) of a cause per unit amplitude."""
        if cause.free_parameters:
            return np.stack([self.parameters[name] for name in cause.free_parameters], axis=1)
        if isinstance(cause, ObservationCause):
            return self.recording.whiten(cause.observation_shift(self.data, constants), self.frames)
        names = cause.names(constants)
        out = np.zeros((len(self.row_pose), len(names)))
        for basis in cause.laws(constants):
            law = self._law(basis)
            out[:, names.index(basis.parameter)] += self.motion[basis.frame, basis.kind] * law[self.row_pose]
        return self.recording.beside_common(out)

    def _law(self, basis: Basis) -> Array:
        """Value (n,) of an expression; what does not depend on moments is kept for later fits of the recording."""
        key: tuple[str | float, ...] = (basis.template, *basis.constants.values())
        known = self.recording.laws.get(key)
        if known is None:
            known = np.broadcast_to(basis.value(self.variables), self.variables["index"].shape)
            names = names_in(basis.template).difference(basis.constants)
            if all(name in self.recording.covariates or name in self._joints for name in names):
                self.recording.laws[key] = known
        return known

    @cached_property
    def _joints(self) -> frozenset[str]:
        return frozenset(f"q{k + 1}" for k in range(self.recording.q.shape[1]))


def tangents(fit: Fit, recording: Recording) -> Tangents:
    """Tangents at a fit."""
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
