"""Detection, identification, adaptation, step by step: forward with re-projection and refit, then a backward check.

A name is taken only if what it leaves behind is clean or is another named cause; where a smooth empirical term
explains the same recording better than the best name and the best pair of names, the cause is `unknown`.
"""

from __future__ import annotations

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
from robcal.physics.cause import Array, Constants, Family, Key
from robcal.physics.prior_scale import usual_size
from robcal.robot.model import RobotModel

SAME_SCATTER = 0.2
"""Relative change of the joints' variance that changes no decision."""
DOUBT = 6.0
"""Evidence that a law loses by leaving something significant at its own place: two causes there are rare."""
SECOND = 3.0
"""Evidence that the name for what is left must have before it counts: most recordings have one cause at most."""
VISIBLE_SIGMA = 5.0
"""Signal in sigma from which a parameter of usual size is worth fitting."""


@dataclass(frozen=True)
class SelectionSettings:
    """How the search runs.

    Attributes
    ----------
    level : family-wise level of a mismatch.
    further : share of that level which causes beside a first one must reach: each look is another chance to be wrong.
    most : causes at most.
    blunder_log_p : logarithm of the probability (all observations weighed in) below which one is a gross error.
    blunder_share : share of the observations that may be left out as gross errors.
    runs : simulations for the family-wise level.
    least_kept : share of the linear promise that a refit must keep.
    most_futile : families that may break their promise before a step gives up.
    """

    level: float = 0.01
    further: float = 0.3
    most: int = 8
    blunder_log_p: float = float(np.log(1e-3))
    blunder_share: float = 0.1
    runs: int = 400
    least_kept: float = 0.5
    most_futile: int = 4


@dataclass(frozen=True)
class Selection:
    """Outcome of the search.

    Attributes
    ----------
    recording : without the observations that were left out.
    accepted : causes in the order in which they were found.
    p_values : family-wise, of the scan in which each was found.
    first, last : looks at the first fit and at the last one.
    free, tied : fitted and eliminated parameters at the end.
    blunders : observations left out: (index in the recording given, its pose's row).
    without : with several causes, looks at the fits without one of them each, in their order.
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


DEFAULTS = SelectionSettings()


def select(
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
    barred: set[Key] = set()
    without: tuple[Analysis, ...] = ()
    settled, weighed = False, True
    present = fit(model, recording, free)
    while True:
        known = level if first is None else first.family_wise
        look = analyse(present, recording, tied, runs=settings.runs, level=known)
        seen = newly_visible(look, tied) if accepted else ()
        if seen:
            free, tied = (*free, *seen), tied - set(seen)
            present = fit(model, recording, free, accepted)
            continue
        first = first or look
        if _is_blunder(look, settings) and len(left_out) < most_blunders:
            rows = list(look.suspect.observations)
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
        if look.p_value <= _level(look, accepted, settings) and len(accepted) < settings.most:
            trial = _extended(model, recording, free, look, barred, settings, tell)
        if trial is not None:
            accepted = trial.accepted
            recording, present = _weighed(model, recording, free, trial)
            p_values.append(look.p_value)
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
    return Selection(recording, present.accepted, tuple(p_values), first, look, free, tied, tuple(left_out), without)


def _weighed(model: RobotModel, recording: Recording, free: tuple[str, ...], present: Fit) -> tuple[Recording, Fit]:
    """The recording weighed by the scatter of the joints beside the causes found so far, which had looked like some."""
    again = estimate_noise(model, recording, free, present.accepted).apply(recording)
    before, after = recording.scatter, again.scatter
    if abs(after - before) <= SAME_SCATTER * max(after, before):
        return recording, present
    return again, fit(model, again, free, present.accepted)


def _level(look: Analysis, accepted: tuple[Accepted, ...], settings: SelectionSettings) -> float:
    """Level that the next cause must reach; what is left where a cause was named already puts the name in doubt."""
    place = look.families[look.top(np.ones(len(look.families), dtype=bool))].where
    elsewhere = bool(accepted) and all(item.family.where != place for item in accepted)
    return settings.level * (settings.further if elsewhere else 1.0)


def _extended(
    model: RobotModel,
    recording: Recording,
    free: tuple[str, ...],
    look: Analysis,
    barred: set[Key],
    settings: SelectionSettings,
    tell: Callable[[str], None],
) -> Fit | None:
    """The fit with the best family added; families whose refit does not keep the linear promise are barred."""
    for _ in range(settings.most_futile):
        open_to = np.array([family.key not in barred for family in look.families])
        choice = choose(look, open_to, settings.level)
        if choice is None:
            return None
        family, constants = choice
        added = accepted_from(look, family, constants)
        trial = fit(model, recording, free, (*look.fit.accepted, added))
        gain = float(look.fit.residual @ look.fit.residual - trial.residual @ trial.residual)
        if gain > settings.least_kept * promised(look, added):
            tell(f"{added.family.cause} at {added.family.where}: p {look.p_value:.2g}")
            return trial
        barred.add(added.family.key)
    return None


def promised(look: Analysis, added: Accepted) -> float:
    """Drop of the whitened square sum that the linear problem promises for an added cause."""
    columns = look.at.columns(added.family, added.constants)
    basis = orthonormal_basis(columns - look.basis @ (look.basis.T @ columns))
    return float(np.sum((basis.T @ look.residual) ** 2))


def newly_visible(look: Analysis, tied: frozenset[str]) -> tuple[str, ...]:
    """Parameters that were eliminated as dependent but show now that a cause is in the model.

    A tilted base, for one, gives the vertical axis a load torque and makes its elasticity identifiable.
    """
    seen: list[str] = []
    basis = look.basis
    for name in sorted(tied):
        column = look.at.parameters.get(name)
        if column is None:
            continue
        column = column * usual_size(name, look.at.variables)
        rest = column - basis @ (basis.T @ column)
        if np.linalg.norm(rest) > VISIBLE_SIGMA:
            seen.append(name)
            basis = np.column_stack([basis, rest / np.linalg.norm(rest)])
    return tuple(seen)


def _is_blunder(look: Analysis, settings: SelectionSettings) -> bool:
    groups = len(look.at.recording.observations.pose)
    significant = look.suspect.log_p + np.log(groups) < settings.blunder_log_p
    return bool(significant and look.suspect.log_evidence > np.max(look.ranked.log_weight))


def _beside(family: Family, after: Analysis, level: float) -> float:
    """What speaks for a family beyond its own evidence: the best name for what it leaves; what it leaves where it acts
    itself speaks against it."""
    left = after.families[after.top(np.ones(len(after.families), dtype=bool))]
    if after.p_value <= level and (left.where, left.direction) == (family.where, family.direction):
        return -DOUBT
    others = float(np.max(np.where(after.named, after.ranked.log_weight, -np.inf), initial=-np.inf))
    return max(others - SECOND, 0.0)


def choose(look: Analysis, open_to: Array | None = None, level: float = DEFAULTS.level) -> tuple[int, Constants] | None:
    """The family to be added: best name or, where that explains less, the best empirical term.

    Only families that a test finds by themselves: evidence alone would take whatever costs little and explains nothing
    where the effect has many parameters, each against a wide prior.
    """
    options: list[tuple[float, int, Constants]] = []
    allowed = look.significant() if open_to is None else look.significant() & open_to
    kinds = [look.named & allowed, ~look.named & allowed]
    tops = [look.top(chosen) for chosen in kinds if np.any(chosen & np.isfinite(look.ranked.log_weight))]
    for family in tops:
        constants = refine(look.families[family], look.constants(family), look.at, look.basis, look.residual)
        if len(tops) == 1:
            return family, constants
        after = extend(look, look.at.columns(look.families[family], constants))
        value = float(look.ranked.log_weight[family]) + _beside(look.families[family], after, level)
        options.append((value, family, constants))
    if not options:
        return None
    _, family, constants = max(options, key=lambda option: option[0])
    return family, constants


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

    Also returns the looks without one of them each, if all of them stay.
    """
    accepted = list(present.accepted)
    probabilities = list(p_values)
    looks: list[Analysis] = []
    changed = False
    k = 0
    while k < len(accepted) and len(accepted) > 1:
        others = tuple(accepted[:k] + accepted[k + 1 :])
        look = analyse(fit(model, recording, free, others), recording, tied, level=level)
        looks.append(look)
        if look.p_value > settings.level:
            accepted = list(look.fit.accepted)
            del probabilities[k]
            changed = True
            continue
        choice = choose(look, level=settings.level)
        if choice is None:
            k += 1
            continue
        family, constants = choice
        if look.families[family].key != accepted[k].family.key and _gain(look, family, accepted[k]) > 3.0:
            accepted = list(look.fit.accepted)
            accepted.insert(k, accepted_from(look, family, constants))
            changed = True
        k += 1
    return tuple(accepted), probabilities, () if changed else tuple(looks)


def _gain(look: Analysis, family: int, present: Accepted) -> float:
    """Logarithm of the posterior odds of a family against the one that stands."""
    standing = [f for f, other in enumerate(look.families) if other.key == present.family.key]
    weight = max((float(look.ranked.log_weight[f]) for f in standing), default=-np.inf)
    return float(look.ranked.log_weight[family]) - weight


def poses_that_carry(signature: Array, row_pose: Array, names: tuple[str, ...], most: int = 20) -> tuple[str, ...]:
    """Poses that carry half of a projected signature's square sum, strongest first."""
    power = np.bincount(row_pose, weights=signature**2, minlength=len(names))
    order = np.argsort(-power)
    share = np.cumsum(power[order]) / max(power.sum(), 1e-300)
    count = min(int(np.searchsorted(share, 0.5)) + 1, most)
    return tuple(names[i] for i in order[:count])
