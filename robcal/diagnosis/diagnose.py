"""The diagnosis of a robot's recording, from fit to findings."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from dataclasses import replace

import numpy as np

from robcal.diagnosis.core.fitting import Accepted, Fit, fit, pseudo_covariance
from robcal.diagnosis.core.recording import Recording, observation_data
from robcal.diagnosis.core.result import Diagnosis, Finding, Rival
from robcal.diagnosis.gain.heldout import cross_validated, folds, noise_floor, position_errors, rms
from robcal.diagnosis.gain.region import region_errors
from robcal.diagnosis.next_poses import separating_poses
from robcal.diagnosis.noise.components import estimate_noise
from robcal.diagnosis.noise.swaps import find_swaps, relabelled
from robcal.diagnosis.scan.analysis import Analysis, analyse
from robcal.diagnosis.scan.posterior import rivals, signature
from robcal.diagnosis.scan.statistics import orthonormal_basis
from robcal.diagnosis.search.curves import LEAST_POSES, Curves, find_curves, nested_errors
from robcal.diagnosis.search.selection import Selection, SelectionSettings, poses_that_carry, select
from robcal.diagnosis.search.unloaded import unloaded_elasticities
from robcal.physics.cause import Array, ObservationData, numeric_sigma
from robcal.physics.measuring import describe, swapped
from robcal.physics.prior_scale import usual_size
from robcal.robot.model import RobotModel

DEFAULTS = SelectionSettings()
MOST_BESIDE_CURVES = 4
"""Causes that are looked for beside irregular curves of the joints: what these leave is small."""
MOST_POSES = 200
"""Poses on which a search is done; the final fit takes all."""


def diagnose(
    model: RobotModel,
    recording: Recording,
    free: Iterable[str],
    tied: Iterable[str] = (),
    verify: Recording | None = None,
    settings: SelectionSettings = DEFAULTS,
    tell: Callable[[str], None] = lambda text: None,
    optional: Iterable[str] = (),
) -> Diagnosis:
    """Find what a fitted robot model leaves out, name it, add it, and measure the gain on data kept out.

    Parameters
    ----------
    model : identified robot. free : names of its fitted parameters. tied : names eliminated as dependent.
    recording : the poses that were used to identify; no others touch any decision.
    verify : kept-out recording, used only to report the gain; without it whole blocks of poses are folded.
    optional : fitted parameters that the identification took for the evidence in the residuals (elasticities across
        axes). An effect that is left out makes such evidence as well, so the search is repeated without them; those it
        needs come back into the model and are no findings.
    """
    start = time.perf_counter()
    free, tied = tuple(free), frozenset(tied)
    swaps = find_swaps(recording)
    exchanged = _swap_findings(model, recording, verify, free, swaps)
    recording = relabelled(recording, swaps)
    verify = None if verify is None else relabelled(verify, swaps)
    assumed = unloaded_elasticities(model, recording, tied)
    model = model.with_parameters(assumed)
    thin = thinned(recording)
    noise = estimate_noise(model, thin, free)
    curves, of_curves = _curves(model, recording, free, verify, tell)
    silent = frozenset(optional) & set(free)
    bare_model = model.with_parameters(dict.fromkeys(silent, 0.0)) if silent else model
    bare = tuple(name for name in free if name not in silent)
    if curves.accepted:
        # While other causes are looked for, the curves stand as numbers: they follow from far more poses than a search
        # has. They are an effect that was left out, so the search without the optional parameters is the one to do.
        bare_model = bare_model.with_terms(curves.frozen)
        noise = estimate_noise(bare_model, thin, bare)
        settings = replace(settings, most=min(settings.most, MOST_BESIDE_CURVES))
        chosen = select(bare_model, noise.apply(thin), bare, tied, settings, tell)
    else:
        chosen = select(model, noise.apply(thin), free, tied, settings, tell)
        again = None
        if silent:  # they may have absorbed all of it
            again = select(bare_model, noise.apply(thin), bare, tied, settings, tell, chosen.first.family_wise)
        if again is not None and _information(again) < _information(chosen):
            chosen = again
        else:
            bare_model, bare = model, free
    if chosen.accepted or chosen.blunders:
        # the first estimate contained the effects
        noise = estimate_noise(bare_model, chosen.recording, bare, chosen.accepted)
    before = fit(model, chosen.recording, free)
    last = chosen.last
    final = last.fit
    whole = chosen.recording
    if thin is not recording or curves.accepted:
        # with all poses the scatter of the joints is known better than from those of the search
        noise = estimate_noise(bare_model, recording, bare, chosen.accepted)
        whole = noise.apply(recording)
        everything = (*curves.accepted, *chosen.accepted)
        final = fit(replace(bare_model, terms=model.terms), whole, chosen.free, everything)
    found = _findings(bare_model, chosen, silent | tied, verify, fit(bare_model, chosen.recording, bare))
    findings = (*exchanged, *of_curves, *found)
    heldout = (
        _error(chosen.recording, before, verify),
        _error(whole, final, verify),
        noise_floor(verify if verify is not None else recording, noise.factor),
    )
    if exchanged:
        heldout = (exchanged[0].heldout[0], *heldout[1:])
    poses: tuple[dict[str, float], ...] = ()
    for finding in findings:
        if finding.rivals and not poses:
            poses = separating_poses(last.fit, chosen.recording, finding)
    blunders = tuple(dict.fromkeys(chosen.recording.names[row] for _, row in chosen.blunders))
    pattern = None
    if last.p_value <= settings.level:
        family = last.families[last.top(np.ones(len(last.families), dtype=bool))]
        pattern = f"{family.where} {family.direction or ''} with {', '.join(family.covariates) or 'no covariate'}"
    return Diagnosis(
        p_value=findings[0].p_value if findings else last.p_value,
        findings=findings,
        blunders=blunders,
        noise_estimated=float(np.sqrt(noise.factor)),
        joint_sigma=noise.joint_sigma,
        unexplained_p=last.p_value,
        unexplained_pattern=pattern,
        heldout=heldout,
        heldout_kind="verify" if verify is not None else "cross-validation",
        model=final.model.with_parameters({name: 0.0 for name in assumed if name not in final.free}),
        free=final.free,
        covariance=final.covariance[: len(final.free), : len(final.free)] * final.variance_factor,
        next_poses=poses,
        seconds=time.perf_counter() - start,
        region=region_errors(whole, fit(model, whole, free), final)
        if curves.accepted
        else region_errors(chosen.recording, before, last.fit),
    )


def _curves(
    model: RobotModel,
    recording: Recording,
    free: tuple[str, ...],
    verify: Recording | None,
    tell: Callable[[str], None],
) -> tuple[Curves, tuple[Finding, ...]]:
    """Error curves of the joints over their own angle, from all poses, and what is told about them."""
    if len(recording.q) < LEAST_POSES:
        return Curves(), ()
    weighted = estimate_noise(model, recording, free).apply(recording)
    present = fit(model, weighted, free)
    curves = find_curves(present, weighted)
    if not curves.accepted:
        return curves, ()
    tell(f"error curves of {', '.join(item.family.where for item in curves.accepted)}")
    errors = nested_errors(present, weighted, curves.accepted, verify)
    findings = []
    for k, item in enumerate(curves.accepted):
        family = item.family
        told = family.report(item.values, item.constants)
        statement = describe(family.sentence, family.where, family.direction, told)
        for like in curves.likenesses:
            if like.joint == family.where:
                told["like"] = {
                    "axis": like.other,
                    "sense": like.sense,
                    "turned_deg": float(np.degrees(like.shift)),
                    "correlation": like.correlation,
                    "overlap_deg": float(np.degrees(like.overlap)),
                }
                statement += f"; it is the curve of {like.other}{' reversed and' if like.sense < 0 else ''} turned by "
                statement += f"{np.degrees(like.shift):.0f} deg (correlation {like.correlation:.2f})"
        none = np.zeros((len(item.values), len(item.values)))
        findings.append(
            Finding(
                family,
                item.constants,
                item.values,
                none,
                told,
                {},
                curves.p_value,
                0.0,
                (),
                curves.shares[k],
                (),
                (errors[k], errors[k + 1]),
                statement,
            )
        )
    return curves, tuple(findings)


def _information(chosen: Selection) -> float:
    """Schwarz' criterion of a search: square sum in units of the smaller variance factor, and its price in numbers."""
    final = chosen.last.fit
    rows = len(final.residual)
    numbers = len(final.free) + sum(len(item.values) for item in final.accepted if item.family.displace is not None)
    fit_and_weights = rows * float(np.log(final.residual @ final.residual / rows)) + chosen.recording.log_determinant
    return fit_and_weights + numbers * float(np.log(rows))


def thinned(recording: Recording) -> Recording:
    """The recording itself, or of a very long one poses spread evenly over it: enough to find and name what matters."""
    count = len(recording.q)
    if count <= MOST_POSES:
        return recording
    keep = np.zeros(count, dtype=bool)
    keep[np.unique(np.linspace(0, count - 1, MOST_POSES).round().astype(int))] = True
    return recording.subset(keep)


def _swap_findings(
    model: RobotModel,
    recording: Recording,
    verify: Recording | None,
    free: tuple[str, ...],
    swaps: tuple[tuple[int, int], ...],
) -> tuple[Finding, ...]:
    """Exchanged numbers are told before everything else; the gain is that of reading them right."""
    findings = []
    for count, (i, j) in enumerate(swaps, 1):
        present = fit(model, relabelled(recording, swaps[:count]), free, iterations=0)
        inspected = verify if verify is not None else recording
        before = rms(position_errors(relabelled(inspected, swaps[: count - 1]), present))
        after = rms(position_errors(relabelled(inspected, swaps[:count]), present))
        family = swapped(recording_data(present, recording), i, j)
        told = family.report(np.ones(1), {})
        findings.append(
            Finding(
                family,
                {},
                np.ones(1),
                np.zeros((1, 1)),
                told,
                {},
                0.0,
                float("inf"),
                (),
                1.0,
                (),
                (before, after),
                describe(family.sentence, family.where, None, told),
            )
        )
    return tuple(findings)


def recording_data(present: Fit, recording: Recording) -> ObservationData:
    """Observation data of a recording at a fit."""
    variables = present.kernel.variables(present.theta, present.inputs)
    return observation_data(recording, present.frames, variables)


def _error(recording: Recording, fitted: Fit, verify: Recording | None) -> float:
    if verify is not None:
        return rms(position_errors(verify, fitted))
    return rms(cross_validated(recording, fitted, folds(recording)))


def _findings(
    model: RobotModel, chosen: Selection, silent: frozenset[str], verify: Recording | None, before: Fit
) -> tuple[Finding, ...]:
    """What was accepted, without parameters that the identification had in its choice and that came back (`silent`)."""
    final = chosen.last.fit
    findings = []
    error = _error(chosen.recording, before, verify)
    left = at_first = _square(before)
    for k, item in enumerate(final.accepted):
        if item.family.frees and silent.issuperset(item.family.frees):
            continue
        others = tuple(other for j, other in enumerate(final.accepted) if j != k)
        look = chosen.without[k] if chosen.without else chosen.first
        if others and not chosen.without:
            rest = fit(model, chosen.recording, chosen.free, others)
            look = analyse(rest, chosen.recording, chosen.tied, level=chosen.first.family_wise)
        partial = fit(model, chosen.recording, chosen.free, final.accepted[: k + 1])
        after = _error(chosen.recording, partial, verify)
        drop = (left - _square(partial)) / max(at_first - _square(final), 1e-300)
        finding = _finding(look, item, chosen.p_values[k], (error, after), chosen)
        findings.append(replace(finding, explained=float(np.clip(drop, 0.0, 1.0))))
        error, left = after, _square(partial)
    return tuple(findings)


def _square(fitted: Fit) -> float:
    return float(fitted.residual @ fitted.residual)


def _covariance(last: Analysis, item: Accepted, held: Iterable[str]) -> Array:
    """Covariance of the amplitudes in units of the variance factor, where the last fit ended.

    The uncertainty of constants that were refined along with them is included, and what the parameters add that the
    identification holds at nominal values because the data hardly tell them: they are as random as robots are.
    """
    family, at, fitted = item.family, last.at, last.fit
    own = fitted.columns_of(item)
    columns = [fitted.jacobian[:, own]]
    for name in [name for name in family.continuous if np.isfinite(item.constants.get(name, np.inf))]:
        low, high = family.continuous[name]
        step = 1e-3 * (abs(item.constants[name]) if low > 0 else high - low)
        ends = [dict(item.constants) | {name: item.constants[name] + side * step} for side in (1.0, -1.0)]
        ahead, behind = (at.columns(family, end) @ item.values for end in ends)
        columns.append(((ahead - behind) / (2.0 * step))[:, None])
    together = np.column_stack(columns)
    basis = orthonormal_basis(np.delete(fitted.jacobian, own, axis=1))
    seen = together - basis @ (basis.T @ together)
    cofactor = pseudo_covariance(seen)
    sizes = {name: usual_size(name, at.variables) for name in held if name in at.parameters}
    moved = [at.parameters[name] * size for name, size in sizes.items() if size > 0]
    if moved:
        pulled = cofactor @ (seen.T @ np.stack(moved, axis=1))
        cofactor = cofactor + pulled @ pulled.T / max(fitted.variance_factor, 1e-300)
    count = len(item.values)
    return cofactor[:count, :count]


def told_through(final: Fit, item: Accepted, covariance: Array, factor: float) -> tuple[Array, Array]:
    """Amplitudes (k,) and their covariance (k, k) for the final value of the parameter through which they act.

    Only the product of both is in the law, so a parameter that the fit changed after the law was written changes the
    amplitude; its uncertainty, and how it goes with the amplitudes', counts.
    """
    if item.family.through is None or item.family.through[0] not in final.free:
        return item.values, covariance
    name, written = item.family.through
    value = final.model.parameters[name]
    ratio = written / value
    own = final.free.index(name)
    number = next(k for k, other in enumerate(final.accepted) if other is item)
    mixed = final.covariance[[final.free.index(full) for full in item.full_names(number)], own] * factor
    slope = -item.values * ratio / value
    cross = np.outer(ratio * mixed, slope)
    spread = ratio**2 * covariance + cross + cross.T + final.covariance[own, own] * factor * np.outer(slope, slope)
    return item.values * ratio, spread


def _finding(
    look: Analysis, item: Accepted, p_value: float, heldout: tuple[float, float], chosen: Selection
) -> Finding:
    family = item.family
    columns = look.at.columns(family, item.constants)
    projected = signature(columns, item.values, look.basis)
    alike = (f for f, o in enumerate(look.families) if o.key == family.key and o.covariates == family.covariates)
    named = next(alike, -1)
    others: tuple[Rival, ...] = ()
    evidence = 0.0
    if named >= 0:
        evidence = float(look.ranked.log_weight[named] - np.log(family.weight))
        if family.cause != "unknown":
            others = rivals(look.families, named, look.ranked, look.stacks, projected, look.named & look.significant())
    final = chosen.last.fit
    factor = final.variance_factor
    covariance = _covariance(chosen.last, item, chosen.tied) * factor
    values, spread = told_through(final, item, covariance, factor)
    told, sigma = numeric_sigma(family.report, values, item.constants, spread)
    for name, (parameter, unit) in family.beside.items():
        if parameter in final.free:
            k = final.free.index(parameter)
            told = {name: final.model.parameters[parameter] * unit} | told
            sigma = {name: float(np.sqrt(final.covariance[k, k] * factor)) * unit} | sigma
    carry = poses_that_carry(projected, look.fit.row_pose, chosen.recording.names)
    told = {
        name: chosen.recording.pose_name(float(str(value))) if name == "pose" else value for name, value in told.items()
    }
    if "pose" in sigma:
        del sigma["pose"]
    return Finding(
        family,
        item.constants,
        item.values,
        covariance,
        told,
        sigma,
        p_value,
        evidence,
        others,
        1.0,
        carry,
        heldout,
        describe(family.sentence, family.where, family.direction, told),
    )
