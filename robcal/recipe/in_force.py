"""Which robot is delivered: what the diagnosis added has to earn its place on poses that it was not fitted to."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

from robcal.calibration.joint_log import JointLog
from robcal.calibration.measurements import Rows
from robcal.diagnosis.core.fitting import Accepted, Fit, fit
from robcal.diagnosis.core.recording import Recording
from robcal.diagnosis.gain.delivered import WAITING, Gain, blocked_folds, delivered_errors, gain_of
from robcal.robot.model import RobotModel


@dataclass(frozen=True)
class Form:
    """A model with its free parameters, beside displacements of what was measured."""

    model: RobotModel
    free: Sequence[str]
    direct: Sequence[Accepted] = ()

    def fit(self, recording: Recording) -> Fit:
        """Everything together fitted to a recording."""
        return fit(self.model, recording, self.free, self.direct)


@dataclass(frozen=True)
class InForce:
    """Whether anything that the diagnosis found is delivered.

    Attributes
    ----------
    form : of the robot that is delivered.
    diagnosed : whether it differs from the identified robot's.
    identified, diagnosed_error : errors (m) without and with everything that was found, RMS over blocked folds of the
        identification poses, predicted from what the table of poses states.
    reason : in words.
    """

    form: Form
    diagnosed: bool
    identified: float
    diagnosed_error: float
    reason: str


def choose(recording: Recording, log: JointLog, rows: Rows, bare: Form, extended: Form) -> InForce:
    """Decide by what the robots deliver over blocked folds.

    First come faults of the measuring system: the robot is fitted beside them if the measurements agree with it clearly
    better in every fold. Then terms of the robot, against measurements that are free of such faults. Terms that depend
    on approach directions which nobody stated wait for them: they are in force if they pay with the directions inferred
    and cost nothing without.
    """
    plain = replace(recording, common=None, shared=None)
    labels = blocked_folds(recording)
    fold = labels[recording.observations.pose]

    def gain(before: Form, after: Form, given: JointLog, freed: bool) -> tuple[Gain, Gain]:
        fits = [form.fit(plain) for form in (before, after)]
        errors = [delivered_errors(plain, f, given.inputs(f.kernel).subset(rows), labels, freed=freed) for f in fits]
        plain_gain, weighted = (gain_of(b, a, fold) for b, a in zip(*errors, strict=True))
        return plain_gain, weighted

    stated = log.as_stated()
    whole, _ = gain(bare, extended, stated, False)
    chosen, reasons = bare, []
    if extended.direct:
        beside = replace(bare, direct=extended.direct)
        found, _ = gain(bare, beside, stated, True)
        chosen = beside if found.clear else bare
        reasons.append(_told("faults of the measuring", found, found.clear, found))
    if extended.model.terms != bare.model.terms or set(extended.free) != set(bare.free):
        full = replace(extended, direct=chosen.direct)
        found, weighted = gain(chosen, full, stated, True)
        pays = found.pays_beside(weighted)
        reasons.append(_told("terms of the robot", found, pays, weighted))
        if not pays and log.inferred and found.even and found.after <= WAITING * found.before:
            known, weighted = gain(chosen, full, log, True)
            pays = known.pays_beside(weighted)
            if pays:
                reasons[-1] = _told("terms of the robot, where approach directions are stated", known, True, weighted)
        chosen = full if pays else chosen
    reason = "; ".join(reasons) + ("" if chosen is not bare else "; the identified robot is delivered")
    return InForce(chosen, chosen is not bare, whole.before, whole.after, reason)


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
