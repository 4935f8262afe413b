"""Which robot is delivered: what the diagnosis added has to earn its place on poses that it was not fitted to."""

from __future__ import annotations

from dataclasses import dataclass, replace

from robcal.calibration.joint_log import JointLog
from robcal.calibration.measurements import Rows
from robcal.diagnosis.core.fitting import Fit
from robcal.diagnosis.core.recording import Recording
from robcal.diagnosis.gain.delivered import WAITING, blocked_folds, delivered_errors, gain_of


@dataclass(frozen=True)
class InForce:
    """Whether the diagnosed robot is delivered.

    Attributes
    ----------
    diagnosed : true: it is; false: the identified robot is.
    identified_mm, diagnosed_mm : errors of both, RMS over blocked folds of the identification poses, predicted from
        what the table of poses states.
    reason : in words.
    """

    diagnosed: bool
    identified_mm: float
    diagnosed_mm: float
    reason: str


def choose(recording: Recording, log: JointLog, rows: Rows, identified: Fit, diagnosed: Fit) -> InForce:
    """Compare two fits to the same recording by what they deliver over blocked folds.

    Terms that depend on approach directions which nobody stated wait for them: they are in force if they pay with the
    directions inferred and cost nothing without.
    """
    plain = replace(recording, common=None, shared=None)
    labels = blocked_folds(recording)
    fold = labels[recording.observations.pose]
    logs = [log.as_stated(), log] if log.inferred else [log]
    gains = []
    for given in logs:
        errors = [
            delivered_errors(plain, f, given.inputs(f.kernel).subset(rows), labels) for f in (identified, diagnosed)
        ]
        gains.append(gain_of(errors[0], errors[1], fold))
    stated, inferred = gains[0], gains[-1]
    before, after = stated.before * 1e3, stated.after * 1e3
    told = f"{before:.3g} mm without the terms, {after:.3g} mm with them"
    if stated.pays:
        return InForce(True, before, after, f"the error over blocked folds falls: {told}")
    if inferred.pays and stated.even and after <= WAITING * before:
        return InForce(
            True,
            before,
            after,
            f"the error falls where approach directions are stated: {1e3 * inferred.before:.3g} mm without the terms, "
            f"{1e3 * inferred.after:.3g} mm with them; without directions {told}",
        )
    why = "grows" if after > before else "does not fall by more than its standard error"
    if stated.before - stated.after > stated.sigma:
        why = "grows much in a part of the poses"
    return InForce(
        False, before, after, f"the error over blocked folds {why}: {told}; the identified robot is delivered"
    )
