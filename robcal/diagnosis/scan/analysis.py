"""One analysis at one fit: all candidates tested, ranked, and the family-wise probability of the largest."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from robcal.diagnosis.core.fitting import Accepted, Fit
from robcal.diagnosis.core.recording import Recording
from robcal.diagnosis.noise.blunders import Suspect, worst_group
from robcal.diagnosis.scan.family_wise import FamilyWise, simulate, tails
from robcal.diagnosis.scan.posterior import Posterior, posterior
from robcal.diagnosis.scan.statistics import ScanResult, Stack, orthonormal_basis, restack, scan, stack_entries
from robcal.diagnosis.scan.tangents import Laws, Tangents, entries, tangents
from robcal.physics.cause import Array, Constants, LinearCause, ObservationData
from robcal.physics.empirical import empirical_causes
from robcal.physics.library import all_causes
from robcal.physics.site import RobotSite

OWN_LEVEL = 0.05
"""Family-wise level that a cause has to reach by itself before it may be named."""


@dataclass(frozen=True)
class Analysis:
    """Everything known at one fit.

    Attributes
    ----------
    causes : named ones and empirical ones; `named` (f,) tells which.
    basis : (m, p) orthonormal basis of the fitted Jacobian. residual : (m,) projected.
    stacks, result, ranked : the scan. family_wise : its level. p_value : of the largest mismatch.
    """

    fit: Fit
    at: Tangents
    causes: tuple[LinearCause, ...]
    named: Array
    basis: Array
    residual: Array
    stacks: tuple[Stack, ...]
    result: ScanResult
    ranked: Posterior
    family_wise: FamilyWise
    p_value: float
    suspect: Suspect

    def most_probable(self, chosen: Array) -> int:
        """Most probable cause among the chosen ones."""
        return int(np.argmax(np.where(chosen, self.ranked.log_weight, -np.inf)))

    def significant(self) -> Array:
        """Causes (f,) whose best entry is significant family-wise, or, if none is, the one with the best entry."""
        log_p = np.zeros(len(self.causes))
        np.minimum.at(log_p, self.result.cause, self.result.log_p)
        found = np.array([self.family_wise.probability(float(value)) <= OWN_LEVEL for value in log_p])
        return found if np.any(found) else log_p == log_p.min()

    def constants(self, cause: int) -> Constants:
        """Best grid point of a cause."""
        return self.causes[cause].grid[int(self.ranked.best_grid[cause])]


def library_at(fit: Fit, recording: Recording, at: Tangents, tied: frozenset[str]) -> tuple[LinearCause, ...]:
    """Causes that may act here and are not in the model already."""
    site = RobotSite(fit.model, at.variables, frozenset(fit.free), tied)
    present = {(a.cause.key, tuple(sorted(a.constants.items()))) for a in fit.accepted}
    single = {a.cause.key for a in fit.accepted if a.cause.acts_once}
    known = all_causes(site, at.data, recording.ids, recording.body)
    named = [
        f
        for f in known
        if f.key not in single
        and f.name not in recording.hidden
        and not (recording.own_station and f.kind.moves == "camera")
    ]
    empirical = list(empirical_causes(site)) if recording.observations_are_spatial else []
    return tuple(f for f in (*named, *empirical) if (f.key, tuple(sorted(f.grid[0].items()))) not in present)


def analyse(
    fit: Fit,
    recording: Recording,
    tied: frozenset[str],
    *,
    runs: int = 400,
    level: FamilyWise | None = None,
    laws: Laws | None = None,
) -> Analysis:
    """Scan all candidates at a fit; `level` reuses a simulated family-wise level of the same design."""
    at = tangents(fit, recording, laws)
    causes = library_at(fit, recording, at, tied)
    basis = orthonormal_basis(fit.jacobian)
    return _ranked(fit, at, causes, stack_entries(entries(causes, at), basis), basis, runs, level)


def extend(analysis: Analysis, columns: Array) -> Analysis:
    """The same analysis with further columns (m, c) fitted, to first order: what would be left after adding a cause."""
    further = orthonormal_basis(columns - analysis.basis @ (analysis.basis.T @ columns))
    basis = np.concatenate([analysis.basis, further], axis=1)
    stacks = restack(analysis.stacks, further)
    return _ranked(analysis.fit, analysis.at, analysis.causes, stacks, basis, 0, analysis.family_wise)


def _ranked(
    fit: Fit,
    at: Tangents,
    causes: Sequence[LinearCause],
    stacks: tuple[Stack, ...],
    basis: Array,
    runs: int,
    level: FamilyWise | None,
) -> Analysis:
    residual = fit.residual - basis @ (basis.T @ fit.residual)
    redundancy = len(residual) - basis.shape[1]
    result = scan(stacks, residual, redundancy)
    ranked = posterior(causes, result)
    groups = at.recording.row_groups(len(residual))
    family_wise = level
    if family_wise is None:
        freedom = tails(residual, redundancy)
        family_wise = simulate(stacks, basis, redundancy, len(residual), runs=runs, freedom=freedom, block=groups)
    p_value = family_wise.probability(float(result.log_p[result.best]))
    named = np.array([cause.kind.named for cause in causes])
    return Analysis(
        fit,
        at,
        tuple(causes),
        named,
        basis,
        residual,
        stacks,
        result,
        ranked,
        family_wise,
        p_value,
        _suspect(at, residual, basis, groups),
    )


def _suspect(at: Tangents, residual: Array, basis: Array, groups: Array) -> Suspect:
    """The observation that fits worst, or the pose whose observations do as one body (a robot that had not settled)."""
    single = worst_group(residual, basis, groups)
    single = replace(single, observations=(single.label,))
    twists = rigid_motions(at.data)
    if twists is None:
        return single
    whole = worst_group(residual, basis, at.row_pose, at.recording.whiten(twists, at.frames))
    if whole.log_evidence <= single.log_evidence:
        return single
    members = np.flatnonzero(at.recording.observations.pose == whole.label)
    return replace(whole, observations=tuple(int(row) for row in members))


def rigid_motions(data: ObservationData) -> Array | None:
    """Displacements (m, 3, 6) of points by a unit shift and turn of their body; None unless poses have several."""
    if data.kind != "points" or np.max(np.bincount(data.pose)) < 3:
        return None
    arm = data.p_world - data.world_T_tool[:, :3, 3]
    turns = np.cross(np.eye(3)[None, :, :], arm[:, None, :]).swapaxes(1, 2)
    return np.concatenate([np.broadcast_to(np.eye(3), turns.shape), turns], axis=2)


def accepted_from(analysis: Analysis, cause: int, constants: Constants) -> Accepted:
    """A cause to be added, with start values from the linear problem."""
    chosen = analysis.causes[cause]
    sizes = chosen.sizes(constants)
    columns = analysis.at.columns(chosen, constants) * sizes
    projected = columns - analysis.basis @ (analysis.basis.T @ columns)
    gram = projected.T @ projected + np.eye(len(sizes)) * 1e-2
    values = np.linalg.solve(gram, projected.T @ analysis.residual) * sizes
    start = 0.0 * values if chosen.free_parameters else values
    return Accepted(chosen, constants, start, np.zeros((len(values), len(values))))
