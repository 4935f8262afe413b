"""Detection, identification, adaptation, step by step: forward with re-projection and refit, then a backward check.

A name is taken only if what it leaves behind is clean or is another named cause; where a smooth empirical term
explains the same recording better than the best name and the best pair of names, the cause is `unknown`.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from robcal.diagnosis.core.fitting import Accepted, Fit, fit
from robcal.diagnosis.core.recording import Recording
from robcal.diagnosis.noise.components import estimate_noise
from robcal.diagnosis.scan.analysis import Analysis, accepted_from, analyse, extend
from robcal.diagnosis.scan.family_wise import FamilyWise
from robcal.diagnosis.scan.posterior import refine
from robcal.diagnosis.scan.statistics import orthonormal_basis
from robcal.diagnosis.scan.tangents import Laws
from robcal.diagnosis.search.admissible import possible, refusal
from robcal.physics.cause import Array, Constants, Key, LinearCause, prior_scale
from robcal.robot.model import RobotModel

SAME_SCATTER = 0.2
"""Relative change of the joints' variance that changes no decision."""
LEFT_AT_PLACE_PENALTY = 6.0
"""Evidence that a law loses by leaving something significant at its own place: two causes there are rare."""
SECOND_CAUSE_PENALTY = 3.0
"""Evidence that the name for what is left must have before it counts: most recordings have one cause at most."""
VISIBLE_SIGMA = 5.0
"""Signal in sigma from which a parameter of usual size is worth fitting."""


@dataclass(frozen=True)
class SelectionSettings:
    """How the search runs.

    Attributes
    ----------
    level : family-wise level of a mismatch.
    further : share of that level which causes beside a first one must reach: each is another chance to be wrong.
    most : causes at most beside those that every robot has.
    blunder_log_p : logarithm of the probability (all observations weighed in) below which one is a gross error.
    blunder_share : share of the observations that may be left out as gross errors.
    runs : simulations for the family-wise level.
    least_kept : share of the linear promise that a refit must keep.
    most_futile : causes that may break their promise before a step gives up.
    """

    level: float = 0.01
    further: float = 0.3
    most: int = 8
    blunder_log_p: float = float(np.log(1e-3))
    blunder_share: float = 0.1
    runs: int = 400
    least_kept: float = 0.5
    most_futile: int = 6


@dataclass(frozen=True)
class Selection:
    """Outcome of the search.

    Attributes
    ----------
    recording : without the observations that were left out.
    accepted : causes in the order in which they were found.
    p_values : family-wise, of the scan in which each was found.
    first, last : analyses at the first fit and at the last one.
    free, tied : fitted and eliminated parameters at the end.
    blunders : observations left out: (index in the recording given, its pose's row).
    without : with several causes, analyses at the fits without one of them each, in their order.
    refused : why causes that fit were not accepted.
    confounded : those of them that cannot be told from what else changed at their time, as they were fitted.
    """

    recording: Recording
    accepted: tuple[Accepted, ...]
    p_values: tuple[float, ...]
    first: Analysis
    last: Analysis
    free: tuple[str, ...]
    tied: frozenset[str]
    blunders: tuple[tuple[int, int], ...]
    without: tuple[Analysis, ...] = ()
    refused: tuple[str, ...] = ()
    confounded: tuple[Accepted, ...] = ()


DEFAULTS = SelectionSettings()


def select(  # noqa: PLR0915 - one search, step by step
    model: RobotModel,
    recording: Recording,
    free: tuple[str, ...],
    tied: frozenset[str],
    settings: SelectionSettings = DEFAULTS,
    tell: Callable[[str], None] = lambda text: None,
    level: FamilyWise | None = None,
) -> Selection:
    """Search for what is missing in a fitted model; ``level`` is that of a search with nearly the same parameters."""
    accepted: tuple[Accepted, ...] = ()
    p_values: list[float] = []
    left_out: list[tuple[int, int]] = []
    number = np.arange(len(recording.observations.pose))
    most_blunders = int(settings.blunder_share * len(number))
    first: Analysis | None = None
    barred: dict[Key, str] = {}
    confounded: list[Accepted] = []
    without: tuple[Analysis, ...] = ()
    settled, weighed = False, True
    present = fit(model, recording, free)
    laws = Laws(recording)
    while True:
        known = level if first is None else first.family_wise
        analysis = analyse(present, recording, tied, runs=settings.runs, level=known, laws=laws)
        seen = newly_visible(analysis, tied) if accepted else ()
        if seen:
            free, tied = (*free, *seen), tied - set(seen)
            present = fit(model, recording, free, accepted)
            continue
        first = first or analysis
        if _is_blunder(analysis, settings) and len(left_out) < most_blunders:
            rows = list(analysis.suspect.observations)
            left_out.extend((int(number[row]), int(recording.observations.pose[row])) for row in rows)
            number = np.delete(number, rows)
            recording = recording.without_observations(np.array(rows))
            first = None if not accepted else first
            present, weighed = fit(model, recording, free, accepted), False
            continue
        if not weighed:
            # gross errors looked like scatter of the joints
            recording = estimate_noise(model, recording, free, accepted).apply(recording)
            first = None if not accepted else first
            present, weighed = fit(model, recording, free, accepted), True
            continue
        trial = None
        if analysis.p_value <= _level(analysis, accepted, settings) and _unexpected(accepted) < settings.most:
            trial = _extended(model, recording, free, analysis, (barred, confounded), settings, tell)
        if trial is not None:
            accepted = trial.accepted
            recording, present = _weighed(model, recording, free, trial)
            p_values.append(analysis.p_value)
            continue
        impossible = [k for k, item in enumerate(present.accepted) if not possible(item, present)]
        if impossible:  # beside the others a cause may have become what cannot be
            barred[accepted[impossible[0]].cause.key] = ""
            accepted = tuple(item for k, item in enumerate(accepted) if k != impossible[0])
            del p_values[impossible[0]]
            present = fit(model, recording, free, accepted)
            continue
        if settled or len(accepted) < 2:
            break
        settled = True
        accepted, p_values, without = _backward(
            model, recording, free, tied, present, p_values, settings, first.family_wise
        )
        if without:
            break
        present = fit(model, recording, free, accepted)
    refused = tuple(reason for reason in barred.values() if reason)
    return Selection(
        recording,
        present.accepted,
        tuple(p_values),
        first,
        analysis,
        free,
        tied,
        tuple(left_out),
        without,
        refused,
        tuple(confounded),
    )


def _unexpected(accepted: tuple[Accepted, ...]) -> int:
    """Number of causes that not every robot has."""
    return sum(not item.cause.kind.expected for item in accepted)


def _weighed(model: RobotModel, recording: Recording, free: tuple[str, ...], present: Fit) -> tuple[Recording, Fit]:
    """The recording weighed by the scatter of the joints beside the causes found so far, which had looked like some."""
    again = estimate_noise(model, recording, free, present.accepted).apply(recording)
    before, after = recording.scatter, again.scatter
    if abs(after - before) <= SAME_SCATTER * max(after, before):
        return recording, present
    return again, fit(model, again, free, present.accepted)


def _level(analysis: Analysis, accepted: tuple[Accepted, ...], settings: SelectionSettings) -> float:
    """Level that the next cause must reach; what is left where a cause was named already puts the name in doubt."""
    place = analysis.causes[analysis.most_probable(np.ones(len(analysis.causes), dtype=bool))].where
    elsewhere = bool(accepted) and all(item.cause.where != place for item in accepted)
    return settings.level * (settings.further if elsewhere else 1.0)


def _extended(
    model: RobotModel,
    recording: Recording,
    free: tuple[str, ...],
    analysis: Analysis,
    refused: tuple[dict[Key, str], list[Accepted]],
    settings: SelectionSettings,
    tell: Callable[[str], None],
) -> Fit | None:
    """The fit with the best cause added; causes whose refit does not keep the linear promise, or that are refused, are
    barred, with the reason (first of ``refused``; second those that are confounded)."""
    barred, confounded = refused
    for _ in range(settings.most_futile):
        open_to = np.array([cause.key not in barred for cause in analysis.causes])
        choice = choose(analysis, open_to, settings.level)
        if choice is None:
            return None
        cause, constants = choice
        added = accepted_from(analysis, cause, constants)
        trial = fit(model, recording, free, (*analysis.fit.accepted, added))
        gain = float(analysis.fit.residual @ analysis.fit.residual - trial.residual @ trial.residual)
        if gain > settings.least_kept * promised(analysis, added):
            reason = refusal(trial.accepted[-1], analysis.fit, trial, analysis.at)
            if reason is None:
                tell(f"{added.cause.name} at {added.cause.where}: p {analysis.p_value:.2g}")
                return trial
            barred[added.cause.key] = reason.reason
            confounded += [trial.accepted[-1]] if reason.confounded else []
            if reason.small:  # the most probable one comes first: the others gain less
                return None
        else:
            barred[added.cause.key] = ""
    return None


def promised(analysis: Analysis, added: Accepted) -> float:
    """Drop of the whitened sum of squares that the linear problem promises for an added cause."""
    columns = analysis.at.columns(added.cause, added.constants)
    basis = orthonormal_basis(columns - analysis.basis @ (analysis.basis.T @ columns))
    return float(np.sum((basis.T @ analysis.residual) ** 2))


def newly_visible(analysis: Analysis, tied: frozenset[str]) -> tuple[str, ...]:
    """Parameters that were eliminated as dependent but show now that a cause is in the model.

    A tilted base, for one, gives the vertical axis a load torque and makes its elasticity identifiable.
    """
    seen: list[str] = []
    basis = analysis.basis
    sigma = float(np.sqrt(analysis.fit.variance_factor))  # of the whitened observations, whatever they state
    for name in sorted(tied):
        column = analysis.at.parameters.get(name)
        if column is None:
            continue
        column = column * prior_scale(name, analysis.at.variables)
        rest = column - basis @ (basis.T @ column)
        if np.linalg.norm(rest) > VISIBLE_SIGMA * sigma:
            seen.append(name)
            basis = np.column_stack([basis, rest / np.linalg.norm(rest)])
    return tuple(seen)


def _is_blunder(analysis: Analysis, settings: SelectionSettings) -> bool:
    groups = len(analysis.at.recording.observations.pose)
    significant = analysis.suspect.log_p + np.log(groups) < settings.blunder_log_p
    return bool(significant and analysis.suspect.log_evidence > np.max(analysis.ranked.log_weight))


def _beside(cause: LinearCause, after: Analysis, level: float) -> float:
    """What speaks for a cause beyond its own evidence: the best name for what it leaves; what it leaves where it acts
    itself speaks against it."""
    left = after.causes[after.most_probable(np.ones(len(after.causes), dtype=bool))]
    if after.p_value <= level and (left.where, left.direction) == (cause.where, cause.direction):
        return -LEFT_AT_PLACE_PENALTY
    others = float(np.max(np.where(after.named, after.ranked.log_weight, -np.inf), initial=-np.inf))
    return max(others - SECOND_CAUSE_PENALTY, 0.0)


def choose(
    analysis: Analysis, open_to: Array | None = None, level: float = DEFAULTS.level
) -> tuple[int, Constants] | None:
    """The cause to be added: best name or, where that explains less, the best empirical term.

    Only causes that a test finds by themselves: evidence alone would take whatever costs little and explains nothing
    where the effect has many parameters, each against a wide prior.
    """
    options: list[tuple[float, int, Constants]] = []
    allowed = analysis.significant() if open_to is None else analysis.significant() & open_to
    kinds = [analysis.named & allowed, ~analysis.named & allowed]
    tops = [
        analysis.most_probable(chosen) for chosen in kinds if np.any(chosen & np.isfinite(analysis.ranked.log_weight))
    ]
    for cause in tops:
        constants = refine(
            analysis.causes[cause], analysis.constants(cause), analysis.at, analysis.basis, analysis.residual
        )
        if len(tops) == 1:
            return cause, constants
        after = extend(analysis, analysis.at.columns(analysis.causes[cause], constants))
        value = float(analysis.ranked.log_weight[cause]) + _beside(analysis.causes[cause], after, level)
        options.append((value, cause, constants))
    if not options:
        return None
    _, cause, constants = max(options, key=lambda option: option[0])
    return cause, constants


def _backward(
    model: RobotModel,
    recording: Recording,
    free: tuple[str, ...],
    tied: frozenset[str],
    present: Fit,
    p_values: list[float],
    settings: SelectionSettings,
    level: FamilyWise,
) -> tuple[tuple[Accepted, ...], list[float], tuple[Analysis, ...]]:
    """With all others in the model: is each cause still needed, and is its name still the best?

    Also returns the analyses without one of them each, if all of them stay.
    """
    accepted = list(present.accepted)
    probabilities = list(p_values)
    analyses: list[Analysis] = []
    changed = False
    k = 0
    while k < len(accepted) and len(accepted) > 1:
        others = tuple(accepted[:k] + accepted[k + 1 :])
        analysis = analyse(fit(model, recording, free, others), recording, tied, level=level)
        analyses.append(analysis)
        if analysis.p_value > settings.level:
            accepted = list(analysis.fit.accepted)
            del probabilities[k]
            changed = True
            continue
        choice = choose(analysis, level=settings.level)
        if choice is None:
            k += 1
            continue
        cause, constants = choice
        if analysis.causes[cause].key != accepted[k].cause.key and _gain(analysis, cause, accepted[k]) > 3.0:
            accepted = list(analysis.fit.accepted)
            accepted.insert(k, accepted_from(analysis, cause, constants))
            changed = True
        k += 1
    return tuple(accepted), probabilities, () if changed else tuple(analyses)


def _gain(analysis: Analysis, cause: int, present: Accepted) -> float:
    """Logarithm of the posterior odds of a cause against the one that stands."""
    standing = [f for f, other in enumerate(analysis.causes) if other.key == present.cause.key]
    weight = max((float(analysis.ranked.log_weight[f]) for f in standing), default=-np.inf)
    return float(analysis.ranked.log_weight[cause]) - weight


def poses_that_carry(signature: Array, row_pose: Array, names: tuple[str, ...], most: int = 20) -> tuple[str, ...]:
    """Poses that carry half of a projected signature's sum of squares, strongest first."""
    power = np.bincount(row_pose, weights=signature**2, minlength=len(names))
    order = np.argsort(-power)
    share = np.cumsum(power[order]) / max(power.sum(), 1e-300)
    count = min(int(np.searchsorted(share, 0.5)) + 1, most)
    return tuple(names[i] for i in order[:count])
