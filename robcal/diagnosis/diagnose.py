"""The diagnosis of a robot's recording, from fit to findings."""

import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from robcal.diagnosis.core.fitting import Fit, fit
from robcal.diagnosis.core.recording import Recording
from robcal.diagnosis.core.result import Diagnosis, Finding
from robcal.diagnosis.findings import at_fit, curve_findings, kept_out_error, named_findings, swap_findings
from robcal.diagnosis.gain.heldout import noise_floor, region_errors
from robcal.diagnosis.next_poses import separating_poses
from robcal.diagnosis.noise.components import Noise, estimate_noise
from robcal.diagnosis.noise.swaps import find_swaps, relabelled
from robcal.diagnosis.scan.analysis import Analysis
from robcal.diagnosis.search.curves import LEAST_POSES, Curves, find_curves, nested_errors
from robcal.diagnosis.search.selection import Selection, SelectionSettings, select
from robcal.diagnosis.search.unloaded import unloaded_elasticities
from robcal.physics.cause import ObservationCause
from robcal.robot.model import RobotModel

DEFAULTS = SelectionSettings()
MOST_WITH_CURVES = 4
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
    notify: Callable[[str], None] = lambda text: None,
    optional: Iterable[str] = (),
) -> Diagnosis:
    """Find what a fitted robot model leaves out, name it, add it, and measure the gain on data kept out.

    Parameters
    ----------
    model : identified robot. free : names of its fitted parameters. tied : names eliminated as dependent.
    recording : the poses that were used to identify; no others touch any decision.
    verify : kept-out recording, used only to report the gain; without it whole blocks of poses are folded.
    notify : takes lines about the progress.
    optional : fitted parameters that the identification took for the evidence in the residuals (elasticities across
        axes). An effect that is left out makes such evidence as well, so the search is repeated without them; those it
        needs come back into the model and are no findings.
    """
    start = time.perf_counter()
    swaps = find_swaps(recording)
    exchanged = swap_findings(model, recording, verify, tuple(free), swaps)
    recording = relabelled(recording, swaps)
    assumed = unloaded_elasticities(model, recording, frozenset(tied))
    case = _Case(
        model.with_parameters(assumed),
        recording,
        thinned(recording),
        None if verify is None else relabelled(verify, swaps),
        tuple(free),
        frozenset(tied),
        frozenset(optional) & set(free),
        settings,
        notify,
    )
    curves, of_curves = _curves(case)
    found = _searched(case, curves)
    final, whole, noise = _last_fit(case, curves, found)
    findings = (*of_curves, *_named(case, found))
    if whole is not found.chosen.recording:
        findings = tuple(at_fit(finding, final) for finding in findings)
    findings = tuple(replace(finding, names=_names_in(final, finding)) for finding in findings)
    findings = (*exchanged, *findings)
    before = fit(case.model, found.chosen.recording, case.free)
    heldout = (
        exchanged[0].heldout[0] if exchanged else kept_out_error(found.chosen.recording, before, case.verify),
        kept_out_error(whole, final, case.verify),
        noise_floor(case.verify if case.verify is not None else recording, noise.factor),
    )
    last = found.chosen.last
    return Diagnosis(
        p_value=findings[0].p_value if findings else last.p_value,
        findings=findings,
        blunders=tuple(dict.fromkeys(found.chosen.recording.names[row] for _, row in found.chosen.blunders)),
        noise_estimated=float(np.sqrt(noise.factor)),
        joint_sigma=noise.joint_sigma,
        unexplained_p=last.p_value,
        unexplained_pattern=_pattern(last) if last.p_value <= settings.level else None,
        heldout=heldout,
        heldout_kind="verify" if verify is not None else "cross-validation",
        model=final.model.with_parameters({name: 0.0 for name in assumed if name not in final.free}),
        free=final.free,
        covariance=final.covariance[: len(final.free), : len(final.free)] * final.variance_factor,
        notes=found.chosen.refused,
        next_poses=_next_poses(findings, found.chosen),
        seconds=time.perf_counter() - start,
        region=region_errors(whole, fit(case.model, whole, case.free), final)
        if curves.accepted
        else region_errors(found.chosen.recording, before, last.fit),
    )


@dataclass(frozen=True)
class _Case:
    """What one diagnosis works on; `thin` are the poses on which the search is done."""

    model: RobotModel
    recording: Recording
    thin: Recording
    verify: Recording | None
    free: tuple[str, ...]
    tied: frozenset[str]
    optional: frozenset[str]
    settings: SelectionSettings
    notify: Callable[[str], None]


@dataclass(frozen=True)
class _Found:
    """A finished search, and the model with its fitted parameters that it began with."""

    chosen: Selection
    model: RobotModel
    free: tuple[str, ...]


def _curves(case: _Case) -> tuple[Curves, tuple[Finding, ...]]:
    """Error curves of the joints over their own angle, from all poses, and what is reported about them."""
    if len(case.recording.q) < LEAST_POSES:
        return Curves(), ()
    weighted = estimate_noise(case.model, case.recording, case.free).apply(case.recording)
    present = fit(case.model, weighted, case.free)
    curves = find_curves(present, weighted)
    if not curves.accepted:
        return curves, ()
    case.notify(f"error curves of {', '.join(item.cause.where for item in curves.accepted)}")
    return curves, curve_findings(curves, nested_errors(present, weighted, curves.accepted, case.verify))


def _searched(case: _Case, curves: Curves) -> _Found:
    """The search with all fitted parameters or without the optional ones, whichever explains more for its price."""
    model = case.model.with_parameters(dict.fromkeys(case.optional, 0.0)) if case.optional else case.model
    free = tuple(name for name in case.free if name not in case.optional)
    if curves.accepted:
        # While other causes are looked for, the curves stand as numbers: they follow from far more poses than a search
        # has. They are an effect that was left out, so the search without the optional parameters is the one to do.
        model = model.with_terms(curves.frozen)
        weighted = estimate_noise(model, case.thin, free).apply(case.thin)
        few = replace(case.settings, most=min(case.settings.most, MOST_WITH_CURVES))
        return _Found(select(model, weighted, free, case.tied, few, case.notify), model, free)
    weighted = estimate_noise(case.model, case.thin, case.free).apply(case.thin)
    chosen = select(case.model, weighted, case.free, case.tied, case.settings, case.notify)
    if case.optional:  # they may have absorbed all of it
        level = chosen.first.family_wise
        again = select(model, weighted, free, case.tied, case.settings, case.notify, level)
        if _information(again) < _information(chosen):
            return _Found(again, model, free)
    return _Found(chosen, case.model, case.free)


def _last_fit(case: _Case, curves: Curves, found: _Found) -> tuple[Fit, Recording, Noise]:
    """The model with everything accepted, the weighted recording that it was fitted to, and the noise beside it."""
    chosen = found.chosen
    if case.thin is not case.recording or curves.accepted:
        # with all poses the scatter of the joints is known better than from those of the search
        blunders = [chosen.recording.names[row] for _, row in chosen.blunders]
        kept = case.recording.subset(~np.isin(np.array(case.recording.names), blunders))
        noise = estimate_noise(found.model, kept, found.free, chosen.accepted)
        whole = noise.apply(kept)
        everything = (*curves.accepted, *chosen.accepted)
        return fit(replace(found.model, terms=case.model.terms), whole, chosen.free, everything), whole, noise
    if chosen.accepted or chosen.blunders:
        # the first estimate contained the effects
        noise = estimate_noise(found.model, chosen.recording, found.free, chosen.accepted)
    else:
        noise = estimate_noise(case.model, case.thin, case.free)
    return chosen.last.fit, chosen.recording, noise


def _names_in(final: Fit, finding: Finding) -> tuple[str, ...]:
    """Parameters of a fit's model that are the amplitudes of a finding; empty for displacements of the measurement."""
    number = next(k for k, item in enumerate(final.accepted) if item.cause is finding.cause)
    return () if isinstance(finding.cause, ObservationCause) else final.accepted[number].full_names(number)


def _named(case: _Case, found: _Found) -> tuple[Finding, ...]:
    before = fit(found.model, found.chosen.recording, found.free)
    return named_findings(found.model, found.chosen, case.optional | case.tied, case.verify, before)


def _next_poses(findings: Sequence[Finding], chosen: Selection) -> tuple[dict[str, float], ...]:
    """Poses that tell the first cause with rivals from them."""
    for finding in findings:
        if finding.rivals:
            poses = separating_poses(chosen.last.fit, chosen.recording, finding)
            if poses:
                return poses
    return ()


def _pattern(last: Analysis) -> str:
    """Where the largest of what is left acts, and what it follows."""
    cause = last.causes[last.most_probable(np.ones(len(last.causes), dtype=bool))]
    return f"{cause.where} {cause.direction or ''} with {', '.join(cause.covariates) or 'no covariate'}"


def _information(chosen: Selection) -> float:
    """Schwarz' criterion of a search: sum of squares in units of the variance factor, and its price in numbers."""
    final = chosen.last.fit
    rows = len(final.residual)
    numbers = len(final.free) + sum(
        len(item.values) for item in final.accepted if isinstance(item.cause, ObservationCause)
    )
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
