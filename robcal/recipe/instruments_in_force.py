"""What a diagnosis of several instruments adds has to earn its place on poses that it was not fitted to.

As of one instrument (:mod:`robcal.recipe.in_force`): forms of the robot are compared over blocked folds of the poses,
in which robot, worlds, tools and wires are fitted anew, to first order; a stop of the robot that several instruments
saw lies in one fold.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from robcal.calibration.identifiability import repetitions
from robcal.calibration.identification import IdentifyOptions
from robcal.calibration.instruments import IdentifiedInstruments
from robcal.calibration.instruments.linearised import LinearInstruments, linearised
from robcal.calibration.joint_log import JointLog
from robcal.diagnosis.gain.delivered import Gain, blocks_of, gain_of
from robcal.estimation.minimum_norm import solve
from robcal.recipe.in_force import FEW, Form, Groups, InForce, contradicted, groups_of, with_terms
from robcal.robot.model import RobotModel
from robcal.transforms import Array


@dataclass(frozen=True)
class JointDelivery:
    """What robots deliver to all instruments at poses of other folds.

    Attributes
    ----------
    fitted, given : linearised at the poses as recorded, and as they would be stated to predict.
    labels : fold (n,) of each stop. missing : parameters that this form of the robot does not have.
    """

    fitted: LinearInstruments = field(repr=False)
    given: LinearInstruments = field(repr=False)
    labels: Array = field(repr=False)
    missing: tuple[str, ...] = ()

    @cached_property
    def _compressed(self) -> dict[int, Array]:
        """By fold, the triangular factor of Jacobian and residual of all others."""
        rows = np.concatenate([self.fitted.jacobian, self.fitted.residual[:, :, None]], axis=2)
        width = rows.shape[2]
        return {
            int(k): np.asarray(np.linalg.qr(rows[self.labels != k].reshape(-1, width), mode="r"))
            for k in np.unique(self.labels)
        }

    def errors(self, dropped: Sequence[str] = ()) -> tuple[Array, Array]:
        """Lengths (n,) of the position errors of stops, m, and of the whitened ones; without some amplitudes."""
        names = np.array(self.fitted.names)
        out = np.isin(names, (*self.missing, *dropped))
        value = self.fitted.values * out
        kept = ~np.any(self.fitted.prior[:, out] != 0.0, axis=1)
        prior, expected = self.fitted.prior[kept][:, ~out], self.fitted.prior_residual[kept]
        plain, white = self.given.plain.copy(), self.given.residual.copy()
        for fold, rows in self._compressed.items():
            test = self.labels == fold
            at_fit = rows[:, -1] + rows[:, :-1] @ value
            change = -value
            change[~out] = solve(np.vstack([rows[:, :-1][:, ~out], prior]), np.concatenate([at_fit, expected]))
            if self.given is not self.fitted:
                change = change + self._turned(change, ~test)
            plain[test] -= self.given.plain_jacobian[test] @ change
            white[test] -= self.given.jacobian[test] @ change
        places = np.maximum(self.given.spatial.sum(axis=1) / 3.0, 1.0)
        squares = np.sum(np.where(self.given.spatial, plain, 0.0) ** 2, axis=1)
        return np.sqrt(squares / places), np.linalg.norm(white, axis=1)

    def _turned(self, change: Array, known: Array) -> Array:
        """Change (p,) of worlds and tools that puts them where the measurements have them as they are stated."""
        own = [k for k, n in enumerate(self.given.names) if n.rsplit(".", 2)[-2:][0] in ("base", "tool")]
        jacobian = self.given.jacobian[known]
        after = self.given.residual[known] - jacobian @ change
        turned = np.zeros(len(change))
        turned[own] = solve(jacobian[:, :, own].reshape(-1, len(own)), after.ravel())
        return turned


@dataclass(frozen=True)
class InstrumentFolds:
    """Forms of a robot compared at all instruments, each a part of ``found``, which has everything that was told.

    ``model`` : the robot with its terms that ``found`` was identified from.
    """

    model: RobotModel = field(repr=False)
    found: IdentifiedInstruments = field(repr=False)
    log: JointLog = field(repr=False)
    options: IdentifyOptions

    @cached_property
    def _fitted(self) -> LinearInstruments:
        return linearised(self.model, self.found, self.log, self.options)

    @cached_property
    def _stated(self) -> LinearInstruments:
        return linearised(self.model, self.found, self.log.as_stated(), self.options)

    @cached_property
    def of_rows(self) -> Array:
        """Block (n,) of each stop."""
        return blocks_of(self._fitted.pose, self.log.q[self._fitted.pose])

    @cached_property
    def labels(self) -> Array:
        """What each stop (n,) is left out with: its block or, of few poses, its repeats alone."""
        alike = repetitions(self.log.q[self._fitted.pose])
        return np.asarray(alike) if int(alike.max(initial=-1)) + 1 < FEW else self.of_rows

    def delivery(self, form: Form, given: JointLog) -> JointDelivery:
        """A form predicted from a table of poses: as they were recorded, or as stated."""
        missing = tuple(n for n in self._fitted.names if n not in form.free)
        at = self._fitted if given.inferred or not self.log.inferred else self._stated
        return JointDelivery(self._fitted, at, self.labels, missing)

    def gain(self, before: Form, after: Form, given: JointLog) -> tuple[Gain, Gain]:
        """What one form gains against another: of plain lengths, and weighted by their uncertainty."""
        errors = [self.delivery(form, given).errors() for form in (before, after)]
        plain, weighted = (gain_of(b, a, self.of_rows) for b, a in zip(*errors, strict=True))
        return plain, weighted


def contradicted_groups(folds: InstrumentFolds, groups: Groups) -> list[str]:
    """Groups of parameters without which blocked folds are predicted no worse."""
    return list(contradicted(folds.delivery(_full(folds.found), folds.log), groups, folds.of_rows))


def choose_among(folds: InstrumentFolds, added: Sequence[str]) -> InForce:
    """Which of the robot's parameters that were ``added`` are delivered, as :func:`robcal.recipe.in_force.choose`.

    The instruments are judged beside the faults of theirs that were found.
    """
    full = _full(folds.found)
    bare = full.without(added)
    groups = groups_of(bare, full)
    if not groups:
        gain, _ = folds.gain(bare, full, folds.log.as_stated())
        return InForce(full, False, gain.before, gain.after, "nothing was added to the robot")
    chosen, reasons, waits = with_terms(folds, bare, full, groups)
    whole, _ = folds.gain(bare, chosen, folds.log.as_stated())
    reason = "; ".join(reasons) + ("" if chosen is not bare else "; the robot is delivered without them")
    return InForce(chosen, chosen is not bare, whole.before, whole.after, reason, waits)


def _full(found: IdentifiedInstruments) -> Form:
    robot = found.placed[found.leading].robot
    assert robot is not None
    return Form(robot.model, found.names)
