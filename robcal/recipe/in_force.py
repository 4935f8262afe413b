"""Which robot is delivered: what the diagnosis added has to earn its place on poses that it was not fitted to."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

from robcal.calibration.joint_log import JointLog
from robcal.calibration.measurements import Rows
from robcal.diagnosis.core.fitting import Accepted, Fit, fit
from robcal.diagnosis.core.recording import Recording
from robcal.diagnosis.gain.delivered import WAITING, Delivery, Gain, blocked_folds, gain_of
from robcal.physics.cause import ObservationCause
from robcal.robot.model import RobotModel
from robcal.transforms import Array

Groups = Mapping[str, tuple[str, ...]]

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

    def without(self, names: Sequence[str]) -> Form:
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
    reason : in words. dropped : parameters that were found and are not in force.
    """

    form: Form
    diagnosed: bool
    identified: float
    diagnosed_error: float
    reason: str
    dropped: tuple[str, ...] = field(default=())


def choose(recording: Recording, log: JointLog, rows: Rows, bare: Form, extended: Form) -> InForce:
    """Decide by what the robots deliver over blocked folds.

    First come faults of the measuring system: the robot is fitted beside them if the measurements agree with it clearly
    better in every fold. Then terms of the robot, against measurements that are free of such faults: those that do not
    pay beside the others are left out one by one, and what is left has to pay against the identified robot. Terms that
    depend on approach directions which nobody stated wait for them: they are in force if they pay with the directions
    inferred and cost nothing without.
    """
    plain = replace(recording, common=None, shared=None)
    labels = blocked_folds(recording)
    fold = labels[recording.observations.pose]
    stated = log.as_stated()

    def delivery(form: Form, given: JointLog, freed: bool) -> Delivery:
        fitted = form.fit(plain)
        return Delivery(plain, fitted, given.inputs(fitted.kernel).subset(rows), labels, freed)

    def gain(before: Form, after: Form, given: JointLog, freed: bool) -> tuple[Gain, Gain]:
        errors = [delivery(form, given, freed).errors() for form in (before, after)]
        plain_gain, weighted = (gain_of(b, a, fold) for b, a in zip(*errors, strict=True))
        return plain_gain, weighted

    chosen, reasons = bare, []
    dropped: tuple[str, ...] = ()
    if extended.direct:
        beside = replace(bare, direct=extended.direct)
        found, _ = gain(bare, beside, stated, True)
        if any(_is_move(item) for item in extended.direct) and found.after > MOVED_SHARE * found.before:
            reasons.append(
                "moves of the station are not taken back, as they explain less than half: "
                f"{1e3 * found.before:.3g} mm without, {1e3 * found.after:.3g} mm with them"
            )
            beside = replace(bare, direct=tuple(item for item in extended.direct if not _is_move(item)))
            found, _ = gain(bare, beside, stated, True)
        chosen = beside if beside.direct and found.clear else bare
        if beside.direct:
            reasons.append(_told("faults of the measuring", found, found.clear, found))
    if groups := groups_of(bare, extended):
        full = replace(extended, direct=chosen.direct)
        pays = False
        for given in (stated, log) if log.inferred else (stated,):
            dropped = not_paying(delivery(full, given, True), groups, fold)
            part = full.without(dropped)
            if len(dropped) == sum(map(len, groups.values())):
                break
            found, weighted = gain(chosen, part, stated, True)
            pays = found.pays_beside(weighted)
            reasons.append(_told("terms of the robot", found, pays, weighted))
            if given is log and not pays and found.even and found.after <= WAITING * found.before:
                known, weighted = gain(chosen, part, log, True)
                pays = known.pays_beside(weighted)
                words = "terms of the robot, where approach directions are stated"
                reasons[-1] = _told(words, known, pays, weighted)
            if pays:
                break
        chosen = part if pays else chosen
        dropped = dropped if pays else tuple(name for names in groups.values() for name in names)
        told = [name for name, names in groups.items() if set(names) <= set(dropped)]
        if told and (pays or not reasons):
            reasons.append(f"not in force, as they do not pay beside the others: {', '.join(told)}")
    whole, _ = gain(bare, chosen, stated, False)
    reason = "; ".join(reasons) + ("" if chosen is not bare else "; the identified robot is delivered")
    return InForce(chosen, chosen is not bare, whole.before, whole.after, reason, dropped)


def _is_move(item: Accepted) -> bool:
    return isinstance(item.cause, ObservationCause) and item.cause.of_order


def groups_of(bare: Form, extended: Form) -> Groups:
    """What was added to a form, by name: the amplitudes of a term together, a parameter that was set free by itself."""
    present = {name for term in bare.model.terms for name in term.parameter_names} | set(bare.free)
    groups: dict[str, tuple[str, ...]] = {}
    of_terms: set[str] = set()
    for term in extended.model.terms:
        names = tuple(name for name in term.parameter_names if name not in present)
        of_terms.update(term.parameter_names)
        if names:
            groups[term.name] = tuple(dict.fromkeys((*groups.get(term.name, ()), *names)))
    return groups | {name: (name,) for name in extended.free if name not in present | of_terms}


def not_paying(full: Delivery, groups: Groups, fold: Array) -> tuple[str, ...]:
    """Parameters of the groups that do not pay beside those that stay: backward, the most useless one first."""
    left = dict(groups)
    dropped: tuple[str, ...] = ()
    errors = full.errors()
    while left:
        trials: dict[str, tuple[float, bool, tuple[str, ...], tuple[Array, Array]]] = {}
        for name, names in left.items():
            without = full.errors((*dropped, *names))
            found, weighted = (gain_of(b, a, fold) for b, a in zip(without, errors, strict=True))
            trials[name] = (-found.strength, found.pays_beside(weighted), (*dropped, *names), without)
        useless = {name: trial for name, trial in trials.items() if not trial[1]}
        if not useless:
            break
        worst = max(useless, key=lambda name: useless[name][0])
        _, _, dropped, errors = useless[worst]
        del left[worst]
    return dropped


def _told(what: str, found: Gain, accepted: bool, weighted: Gain) -> str:
    errors = f"{1e3 * found.before:.3g} mm without, {1e3 * found.after:.3g} mm with them"
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
