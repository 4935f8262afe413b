"""From accepted causes to findings: amplitudes, uncertainties, rivals, gain, sentence."""

from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np

from robcal.diagnosis.core.fitting import Accepted, Fit, fit
from robcal.diagnosis.core.recording import Recording, observation_data
from robcal.diagnosis.core.result import Finding, Rival
from robcal.diagnosis.gain.heldout import cross_validated, folds, position_errors, rms
from robcal.diagnosis.noise.swaps import relabelled
from robcal.diagnosis.scan.analysis import Analysis, analyse
from robcal.diagnosis.scan.posterior import rivals, signature
from robcal.diagnosis.scan.statistics import orthonormal_basis
from robcal.diagnosis.search.curves import Curves
from robcal.diagnosis.search.selection import Selection, poses_that_carry
from robcal.estimation.minimum_norm import pseudo_covariance
from robcal.physics.cause import Array, ObservationCause, ObservationData, numeric_sigma, prior_scale
from robcal.physics.measuring import swapped
from robcal.robot.model import RobotModel

MOST_OF_IT = 0.5
"""Share of a signature that a cause over time has to reproduce to be its alternative."""


def recording_data(present: Fit, recording: Recording) -> ObservationData:
    """Observation data of a recording at a fit."""
    variables = present.kernel.variables(present.theta, present.inputs)
    return observation_data(recording, present.frames, variables)


def swap_findings(
    model: RobotModel,
    recording: Recording,
    verify: Recording | None,
    free: tuple[str, ...],
    swaps: tuple[tuple[int, int], ...],
) -> tuple[Finding, ...]:
    """Exchanged numbers are reported before everything else; the gain is that of reading them right."""
    findings = []
    for count, (i, j) in enumerate(swaps, 1):
        present = fit(model, relabelled(recording, swaps[:count]), free, iterations=0)
        inspected = verify if verify is not None else recording
        before = rms(position_errors(relabelled(inspected, swaps[: count - 1]), present))
        after = rms(position_errors(relabelled(inspected, swaps[:count]), present))
        cause = swapped(recording_data(present, recording), i, j)
        reported = cause.report(np.ones(1), {})
        findings.append(
            Finding(
                cause,
                {},
                np.ones(1),
                np.zeros((1, 1)),
                reported,
                p_value=0.0,
                log_evidence=float("inf"),
                heldout=(before, after),
                statement=cause.describe(reported),
            )
        )
    return tuple(findings)


def kept_out_error(recording: Recording, fitted: Fit, verify: Recording | None) -> float:
    if verify is not None:
        return rms(position_errors(verify, fitted))
    return rms(cross_validated(recording, fitted, folds(recording)))


def curve_findings(curves: Curves, errors: Sequence[float]) -> tuple[Finding, ...]:
    """Error curves of joints; `errors` (m) at kept-out poses without curves, with the first, the first two ..."""
    findings = []
    for k, item in enumerate(curves.accepted):
        cause = item.cause
        reported = cause.report(item.values, item.constants)
        statement = cause.describe(reported)
        for like in (like for like in curves.likenesses if like.joint == cause.where):
            reported["like"] = {
                "axis": like.other,
                "sense": like.sense,
                "turned_deg": float(np.degrees(like.shift)),
                "correlation": like.correlation,
                "overlap_deg": float(np.degrees(like.overlap)),
            }
            statement += f"; it is the curve of {like.other}{' reversed and' if like.sense < 0 else ''} turned by "
            statement += f"{np.degrees(like.shift):.0f} deg (correlation {like.correlation:.2f})"
        findings.append(
            Finding(
                cause,
                item.constants,
                item.values,
                np.zeros((len(item.values), len(item.values))),
                reported,
                p_value=curves.p_value,
                log_evidence=0.0,
                explained=curves.shares[k],
                heldout=(errors[k], errors[k + 1]),
                statement=statement,
            )
        )
    return tuple(findings)


def named_findings(
    model: RobotModel, chosen: Selection, held_open: frozenset[str], verify: Recording | None, before: Fit
) -> tuple[Finding, ...]:
    """What was accepted, without parameters that the identification had in its choice (`held_open`)."""
    final = chosen.last.fit
    findings = []
    error = kept_out_error(chosen.recording, before, verify)
    left = at_first = _sum_of_squares(before)
    for k, item in enumerate(final.accepted):
        if item.cause.free_parameters and held_open.issuperset(item.cause.free_parameters):
            continue
        others = tuple(other for j, other in enumerate(final.accepted) if j != k)
        analysis = chosen.without[k] if chosen.without else chosen.first
        if others and not chosen.without:
            rest = fit(model, chosen.recording, chosen.free, others)
            analysis = analyse(rest, chosen.recording, chosen.tied, level=chosen.first.family_wise)
        partial = fit(model, chosen.recording, chosen.free, final.accepted[: k + 1])
        after = kept_out_error(chosen.recording, partial, verify)
        drop = (left - _sum_of_squares(partial)) / max(at_first - _sum_of_squares(final), 1e-300)
        finding = _finding(analysis, item, chosen.p_values[k], (error, after), chosen)
        findings.append(replace(finding, explained=float(np.clip(drop, 0.0, 1.0))))
        error, left = after, _sum_of_squares(partial)
    return tuple(findings)


def at_fit(finding: Finding, final: Fit) -> Finding:
    """A finding with the amplitudes, sigmas and sentence of another fit that has it in its model.

    Weakness: the uncertainty of constants that were refined in the search is left out.
    """
    number = next((k for k, a in enumerate(final.accepted) if a.cause is finding.cause), None)
    names = finding.names if number is None else final.accepted[number].full_names(number)
    if number is not None and isinstance(finding.cause, ObservationCause):
        item, names = final.accepted[number], ()
    elif names and set(names) <= set(final.free):
        at = [final.free.index(name) for name in names]
        values = final.theta[[final.kernel.index[name] for name in names]]
        item = Accepted(finding.cause, finding.constants, values, final.covariance[np.ix_(at, at)])
    else:
        return finding
    factor = final.variance_factor
    values, spread = rescaled(final, item, names, item.covariance * factor, factor)
    reported, sigma = numeric_sigma(finding.cause.report, values, item.constants, spread)
    kept = {name: value for name, value in finding.parameters.items() if name not in reported}
    for name, (parameter, unit) in finding.cause.jointly_fitted.items():
        if parameter in final.free:
            kept[name] = final.model.parameters[parameter] * unit
    if "pose" in reported:
        reported["pose"] = finding.parameters["pose"]
    statement = finding.statement.replace(
        finding.cause.describe(finding.parameters), finding.cause.describe(kept | reported)
    )
    return replace(
        finding,
        values=item.values,
        covariance=item.covariance * factor,
        parameters=kept | reported,
        sigma={name: sigma.get(name, value) for name, value in finding.sigma.items()},
        statement=statement,
        names=names,
    )


def _with_confounded(
    others: tuple[Rival, ...], chosen: Selection, analysis: Analysis, projected: Array
) -> tuple[Rival, ...]:
    """Rivals, and causes over time that the search could not tell from what else changed at their time and that
    reproduce most of a projected signature (m,)."""
    known = {(rival.cause.name, rival.cause.where) for rival in others}
    size = max(float(projected @ projected), 1e-300)
    found = list(others)
    for item in chosen.confounded:
        columns = analysis.at.columns(item.cause, item.constants)
        basis = orthonormal_basis(columns - analysis.basis @ (analysis.basis.T @ columns))
        share = float(np.sum((basis.T @ projected) ** 2)) / size
        if share > MOST_OF_IT and (item.cause.name, item.cause.where) not in known:
            # a time or a place: nothing in the recording decides between them
            found.append(Rival(item.cause, item.constants, float("nan"), share))
    return tuple(found)


def _sum_of_squares(fitted: Fit) -> float:
    return float(fitted.residual @ fitted.residual)


def _covariance(last: Analysis, item: Accepted, held: Iterable[str]) -> Array:
    """Covariance of the amplitudes in units of the variance factor, where the last fit ended.

    The uncertainty of constants that were refined along with them is included, and what the parameters add that the
    identification holds at nominal values because the data hardly tell them: they are as random as robots are.
    """
    cause, at, fitted = item.cause, last.at, last.fit
    own = fitted.columns_of(item)
    columns = [fitted.jacobian[:, own]]
    for name in [name for name in cause.continuous if np.isfinite(item.constants.get(name, np.inf))]:
        low, high = cause.continuous[name]
        step = 1e-3 * (abs(item.constants[name]) if low > 0 else high - low)
        ends = [dict(item.constants) | {name: item.constants[name] + side * step} for side in (1.0, -1.0)]
        ahead, behind = (at.columns(cause, end) @ item.values for end in ends)
        columns.append(((ahead - behind) / (2.0 * step))[:, None])
    together = np.column_stack(columns)
    basis = orthonormal_basis(np.delete(fitted.jacobian, own, axis=1))
    seen = together - basis @ (basis.T @ together)
    cofactor = pseudo_covariance(seen)
    sizes = {name: prior_scale(name, at.variables) for name in held if name in at.parameters}
    moved = [at.parameters[name] * size for name, size in sizes.items() if size > 0]
    if moved:
        pulled = cofactor @ (seen.T @ np.stack(moved, axis=1))
        cofactor = cofactor + pulled @ pulled.T / max(fitted.variance_factor, 1e-300)
    count = len(item.values)
    return cofactor[:count, :count]


def rescaled(final: Fit, item: Accepted, names: Sequence[str], covariance: Array, factor: float) -> tuple[Array, Array]:
    """Amplitudes (k,) and their covariance (k, k) for the final value of the parameter through which they act.

    Only the product of both is in the law, so a parameter that the fit changed after the law was written changes the
    amplitude; its uncertainty, and how it goes with the amplitudes', counts. ``names`` of the amplitudes in the fit.
    """
    if item.cause.scaled_by is None or item.cause.scaled_by[0] not in final.free:
        return item.values, covariance
    name, written = item.cause.scaled_by
    value = final.model.parameters[name]
    ratio = written / value
    own = final.free.index(name)
    mixed = final.covariance[[final.free.index(full) for full in names], own] * factor
    slope = -item.values * ratio / value
    cross = np.outer(ratio * mixed, slope)
    spread = ratio**2 * covariance + cross + cross.T + final.covariance[own, own] * factor * np.outer(slope, slope)
    return item.values * ratio, spread


def _finding(
    analysis: Analysis, item: Accepted, p_value: float, heldout: tuple[float, float], chosen: Selection
) -> Finding:
    cause = item.cause
    columns = analysis.at.columns(cause, item.constants)
    projected = signature(columns, item.values, analysis.basis)
    alike = (f for f, o in enumerate(analysis.causes) if o.key == cause.key and o.covariates == cause.covariates)
    named = next(alike, -1)
    others: tuple[Rival, ...] = ()
    evidence = 0.0
    if named >= 0:
        evidence = float(analysis.ranked.log_weight[named] - np.log(cause.weight))
        if cause.kind.named:
            eligible = analysis.named & analysis.significant()
            others = rivals(analysis.causes, named, analysis.ranked, analysis.stacks, projected, eligible)
    others = _with_confounded(others, chosen, analysis, projected)
    final = chosen.last.fit
    factor = final.variance_factor
    covariance = _covariance(chosen.last, item, chosen.tied) * factor
    number = next(k for k, other in enumerate(final.accepted) if other is item)
    names = () if isinstance(cause, ObservationCause) else item.full_names(number)
    values, spread = rescaled(final, item, names, covariance, factor)
    reported, sigma = numeric_sigma(cause.report, values, item.constants, spread)
    for name, (parameter, unit) in cause.jointly_fitted.items():
        if parameter in final.free:
            k = final.free.index(parameter)
            reported = {name: final.model.parameters[parameter] * unit} | reported
            sigma = {name: float(np.sqrt(final.covariance[k, k] * factor)) * unit} | sigma
    reported = {
        name: chosen.recording.pose_name(float(str(value))) if name == "pose" else value
        for name, value in reported.items()
    }
    sigma.pop("pose", None)
    return Finding(
        cause,
        item.constants,
        item.values,
        covariance,
        reported,
        sigma=sigma,
        p_value=p_value,
        log_evidence=evidence,
        rivals=others,
        poses=poses_that_carry(projected, analysis.fit.row_pose, chosen.recording.names),
        heldout=heldout,
        statement=cause.describe(reported),
    )
