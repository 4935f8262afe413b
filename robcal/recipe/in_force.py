"""Which robot is delivered: what the diagnosis added has to earn its place on poses that it was not fitted to."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Protocol

import numpy as np

from robcal.calibration.identifiability import repetitions
from robcal.calibration.joint_log import JointLog
from robcal.calibration.measurements import Rows
from robcal.diagnosis.core.fitting import Accepted, Fit, fit
from robcal.diagnosis.core.recording import Recording
from robcal.diagnosis.gain.delivered import WAITING, Delivery, Gain, blocked_folds, gain_of
from robcal.physics.cause import ObservationCause
from robcal.robot.model import RobotModel
from robcal.transforms import Array

Groups = Mapping[str, tuple[str, ...]]

FEW = 60
"""Different poses below which single ones are left out in place of blocks."""
CURVES = "curves of the joints"
MOVED_SHARE = 0.5
"""Moves of the station are taken back where at most this share of the error stays: else the robot would speak in a
frame that only some of the poses vouch for."""


@dataclass(frozen=True)
class Form:
    """A model with its free parameters, beside displacements of what was measured."""

    model: RobotModel
    free: Sequence[str]
    direct: Sequence[Accepted] = ()

    def fit(self, recording: Recording) -> Fit:
        """Everything together fitted to a recording."""
        return fit(self.model, recording, self.free, self.direct)

    def without(self, names: Sequence[str]) -> "Form":
        """The form without some free parameters and the terms that consist of them."""
        gone = set(names)
        terms = tuple(term for term in self.model.terms if not gone.issuperset(term.parameter_names))
        own = {name for term in self.model.terms for name in term.parameter_names}
        values = {name: 0.0 if name in gone else value for name, value in self.model.parameters.items()}
        model = replace(self.model, terms=terms, parameters={n: v for n, v in values.items() if n not in own & gone})
        return replace(self, model=model, free=tuple(name for name in self.free if name not in gone))


@dataclass(frozen=True)
class InForce:
    """Whether anything that the diagnosis found is delivered.

    Attributes
    ----------
    form : of the robot that is delivered.
    diagnosed : whether it differs from the identified robot's.
    identified, diagnosed_error : errors (m) of the identified robot and of the one that is delivered, RMS over blocked
        folds of the identification poses, predicted from what the table of poses states.
    reason : in words.
    waits : by parameter of the robot, why it was found and is not in force.
    measuring : why faults of the measuring system that were found are not taken back.
    """

    form: Form
    diagnosed: bool
    identified: float
    diagnosed_error: float
    reason: str
    waits: Mapping[str, str] = field(default_factory=dict)
    measuring: str = ""


class Delivers(Protocol):
    """What a fitted robot delivers at poses of other folds."""

    def errors(self, dropped: Sequence[str] = ()) -> tuple[Array, Array]:
        """Lengths (m_obs,) of the position errors, m, and of the whitened ones, without some amplitudes."""
        ...


class Judge(Protocol):
    """Forms of a robot compared over folds of the poses; ``of_rows`` : block (m,) of each observation."""

    @property
    def log(self) -> JointLog:
        """With approach directions as inferred."""
        ...

    @property
    def of_rows(self) -> Array:
        """Block (m,) of each observation."""
        ...

    def delivery(self, form: Form, given: JointLog) -> Delivers:
        """A form predicted from a table of poses."""
        ...

    def gain(self, before: Form, after: Form, given: JointLog) -> tuple[Gain, Gain]:
        """What one form gains against another: of plain lengths, and weighted by their uncertainty."""
        ...


@dataclass(frozen=True)
class Folds:
    """What robots deliver over blocked folds of the identification poses.

    Attributes
    ----------
    recording : as it was measured. log : with approach directions as inferred. rows : of the recording in it.
    """

    recording: Recording
    log: JointLog
    rows: Rows

    @cached_property
    def labels(self) -> Array:
        """What each pose (n,) is left out with: its block or, of few poses, its repeats alone.

        A block of few poses leaves a robot behind that is far worse than the one to be judged.
        """
        alike = repetitions(self.recording.q)
        return np.asarray(alike) if int(alike.max(initial=-1)) + 1 < FEW else blocked_folds(self.recording)

    @cached_property
    def of_rows(self) -> Array:
        """Block (m,) of each observation, by which gains are judged."""
        return blocked_folds(self.recording)[self.recording.observations.pose]

    def delivery(self, form: Form, given: JointLog, freed: bool = True) -> Delivery:
        """A form fitted, and predicted from a table of poses; `freed` of faults of the measuring system."""
        plain = replace(self.recording, common=None, shared=None)
        fitted = form.fit(plain)
        return Delivery(plain, fitted, given.inputs(fitted.kernel).subset(self.rows), self.labels, freed)

    def gain(self, before: Form, after: Form, given: JointLog, freed: bool = True) -> tuple[Gain, Gain]:
        """What one form gains against another: of plain lengths, and weighted by their uncertainty."""
        errors = [self.delivery(form, given, freed).errors() for form in (before, after)]
        plain, weighted = (gain_of(b, a, self.of_rows) for b, a in zip(*errors, strict=True))
        return plain, weighted


def choose(recording: Recording, log: JointLog, rows: Rows, bare: Form, extended: Form) -> InForce:
    """Decide by what the robots deliver over blocked folds.

    First come faults of the measuring system: the robot is fitted beside them if the measurements agree with it clearly
    better in every fold. Then terms of the robot, against measurements that are free of such faults: those that do not
    pay beside the others are left out one by one, and what is left has to pay against the identified robot. Terms that
    depend on approach directions which nobody stated wait for them: they are in force if they pay with the directions
    inferred and cost nothing without.
    """
    folds = Folds(recording, log, rows)
    chosen, reasons, measuring = _with_faults(folds, bare, extended.direct)
    waits: dict[str, str] = {}
    if groups := groups_of(bare, extended):
        chosen, message, waits = with_terms(folds, chosen, replace(extended, direct=chosen.direct), groups)
        reasons += message
    whole, _ = folds.gain(bare, chosen, log.as_stated(), freed=False)
    reason = "; ".join(reasons) + ("" if chosen is not bare else "; the identified robot is delivered")
    return InForce(chosen, chosen is not bare, whole.before, whole.after, reason, waits, measuring)


def _with_faults(folds: Folds, bare: Form, direct: Sequence[Accepted]) -> tuple[Form, list[str], str]:
    """The form beside faults of the measuring system that are beyond doubt, reasons, and why others are left."""
    if not direct:
        return bare, [], ""
    reasons, stated = [], folds.log.as_stated()
    beside = replace(bare, direct=direct)
    found, _ = folds.gain(bare, beside, stated)
    if any(_is_move(item) for item in direct) and found.after > MOVED_SHARE * found.before:
        reasons.append(
            "moves of the station are not taken back, as they explain less than half: "
            f"{1e3 * found.before:.3g} mm without, {1e3 * found.after:.3g} mm with them"
        )
        beside = replace(bare, direct=tuple(item for item in direct if not _is_move(item)))
        found, _ = folds.gain(bare, beside, stated)
    why = list(reasons)
    if beside.direct:
        reasons.append(_gain_statement("faults of the measuring", found, found.clear, found))
        why += [] if found.clear else reasons[-1:]
    return beside if beside.direct and found.clear else bare, reasons, "; ".join(why)


def with_terms(folds: Judge, base: Form, full: Form, groups: Groups) -> tuple[Form, list[str], dict[str, str]]:
    """The form with the terms that pay, reasons, and by parameter why the others wait."""
    stated = folds.log.as_stated()
    unpaid = not_paying(folds.delivery(full, stated), groups, folds.of_rows)
    part, reasons = base, []
    if len(unpaid) < len(groups):
        trial = full.without([name for group in unpaid for name in groups[group]])
        found, weighted = folds.gain(base, trial, stated)
        pays = found.pays_jointly(weighted)
        reasons.append(_gain_statement("terms of the robot", found, pays, weighted))
        part, unpaid = (trial, unpaid) if pays else (base, dict.fromkeys(groups, found))
    waits: dict[str, str] = {}
    if unpaid and folds.log.inferred:
        part, message, waits = _with_approach(folds, part, full, groups, unpaid)
        reasons += message
    unpaid = {group: gain for group, gain in unpaid.items() if not set(groups[group]) <= set(part.free)}
    left = [group for group in unpaid if group not in waits]
    if left:
        reasons.append(f"not in force, as they do not pay beside the others: {', '.join(left)}")
    why = {group: waits.get(group) or f"error over blocked folds {_errors(unpaid[group], 'it')}" for group in unpaid}
    return part, reasons, {name: why[group] for group in unpaid for name in groups[group]}


def _with_approach(
    folds: Judge, part: Form, full: Form, groups: Groups, unpaid: Mapping[str, Gain]
) -> tuple[Form, list[str], dict[str, str]]:
    """Terms that pay where the approach directions are known: in force if they cost nothing where they are not stated;
    else they wait, by group why."""
    known = not_paying(folds.delivery(full, folds.log), groups, folds.of_rows)
    waiting = [group for group in unpaid if group not in known]
    if not waiting:
        return part, [], {}
    trial = full.without([name for group in unpaid if group in known for name in groups[group]])
    found, weighted = folds.gain(part, trial, folds.log)
    if not found.pays_jointly(weighted):
        return part, [], {}
    message = f"with approach directions stated the error over blocked folds is {_errors(found, 'them')}"
    cost, _ = folds.gain(part, trial, folds.log.as_stated())
    if cost.even and cost.after <= WAITING * cost.before:
        return trial, [f"{', '.join(waiting)} pay: {message}"], {}
    why = f"waits for approach directions: {message}, without directions {_errors(cost, 'them')}"
    return part, [f"state approach: {', '.join(waiting)}: {message}"], dict.fromkeys(waiting, why)


def _is_move(item: Accepted) -> bool:
    return isinstance(item.cause, ObservationCause) and item.cause.of_order


def groups_of(bare: Form, extended: Form) -> Groups:
    """What was added to a form, by name: the amplitudes of a term together, a parameter that was set free by itself.

    Curves that their priors hold back were accepted together, over folds, and share parts: they stand or fall together.
    """
    present = {name for term in bare.model.terms for name in term.parameter_names} | set(bare.free)
    groups: dict[str, tuple[str, ...]] = {}
    of_terms: set[str] = set()
    for term in extended.model.terms:
        names = tuple(name for name in term.parameter_names if name not in present)
        of_terms.update(term.parameter_names)
        if names:
            group = CURVES if term.priors else term.name
            groups[group] = tuple(dict.fromkeys((*groups.get(group, ()), *names)))
    return groups | {name: (name,) for name in extended.free if name not in present | of_terms}


def not_paying(full: Delivers, groups: Groups, fold: Array) -> dict[str, Gain]:
    """Groups that do not pay beside those that stay, and the gain of each: backward, the most useless one first."""
    return _backward(full, groups, fold, lambda plain, weighted: plain.pays_jointly(weighted))


def contradicted(full: Delivers, groups: Groups, fold: Array) -> dict[str, Gain]:
    """Groups without which blocked folds are predicted no worse, and the weighted gain of each: backward."""
    return _backward(full, groups, fold, lambda plain, weighted: weighted.after < weighted.before)


def _backward(full: Delivers, groups: Groups, fold: Array, stays: Callable[[Gain, Gain], bool]) -> dict[str, Gain]:
    left = dict(groups)
    out: dict[str, Gain] = {}
    dropped: tuple[str, ...] = ()
    errors = full.errors()
    while left:
        trials: dict[str, tuple[Gain, tuple[Array, Array]]] = {}
        for name, names in left.items():
            without = full.errors((*dropped, *names))
            plain, weighted = (gain_of(b, a, fold) for b, a in zip(without, errors, strict=True))
            if not stays(plain, weighted):
                trials[name] = plain, without
        if not trials:
            break
        worst = min(trials, key=lambda name: trials[name][0].strength)
        out[worst], errors = trials[worst]
        dropped = (*dropped, *left.pop(worst))
    return out


def _errors(found: Gain, what: str) -> str:
    return f"{1e3 * found.before:.3g} mm without, {1e3 * found.after:.3g} mm with {what}"


def _gain_statement(what: str, found: Gain, accepted: bool, weighted: Gain) -> str:
    errors = _errors(found, "them")
    if accepted and not found.pays:
        return (
            f"{what} pay: error over blocked folds, weighted by its uncertainty, {weighted.before:.4g} without, "
            f"{weighted.after:.4g} with them; in plain length {errors}"
        )
    if accepted:
        return f"{what} pay: error over blocked folds {errors}"
    why = "the error does not fall enough"
    if found.after > found.before:
        why = "the error grows"
    elif not found.even:
        why = "the error grows much in a part of the poses"
    return f"{what} do not pay ({why} over blocked folds: {errors})"
