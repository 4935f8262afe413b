"""What a robot delivers at poses that it was not fitted to: predicted from what a table of poses states, no more.

Approach directions that were inferred and displacements of the measurement are left out, base and tool are those of the
measurements as they are. Errors come from blocked folds (Roberts et al., 2017): poses that follow one another stay
together, and so do repeats.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from robcal.calibration.identifiability import repetitions
from robcal.diagnosis.core.fitting import Fit
from robcal.diagnosis.core.recording import Recording
from robcal.diagnosis.gain.heldout import block_labels
from robcal.estimation.minimum_norm import solve
from robcal.physics.cause import Array, ObservationCause
from robcal.robot.kernel import PoseInputs
from robcal.robot.model import GEOMETRIC_KINDS

MUCH_WORSE = 1.25
"""Factor by which the error in one fold may grow."""
PAYING_SIGMAS = 2.0
"""Standard errors that the gain of the folds has to reach: over eight folds about 95 % of a one-sided test."""
CLEAR, CLEAR_SIGMAS = 0.9, 3.0
"""Factor to which the error has to fall, and standard errors, for a fault of the measuring to be beyond doubt."""
WAITING = 1.01
"""Factor by which the error may grow where terms wait for approach directions that the user may state."""


def blocked_folds(recording: Recording) -> Array:
    """Fold of each pose (n,): blocks of consecutive poses; repeats of a pose are in the fold of the first of them."""
    return blocks_of(recording.covariates["index"], recording.q)


def blocks_of(index: Array, q: Array) -> Array:
    """The same of poses (n, joints) that were driven in the order of ``index`` (n,)."""
    labels = block_labels(index, q)
    groups = repetitions(q)
    first = np.unique(groups, return_index=True)[1]
    return np.asarray(labels[first[groups]])


def delivered_errors(
    recording: Recording, fitted: Fit, inputs: PoseInputs, labels: Array, *, freed: bool = False
) -> tuple[Array, Array]:
    """Lengths (m_obs,) of the position errors, m, and of the whitened ones, of observations predicted from other folds.

    Parameters
    ----------
    recording : as it was measured. fitted : a fit to it, errors common to all poses not taken off.
    inputs : the poses as they would be stated to predict. labels : fold of each pose (n,).
    freed : whether the measurements count without the displacements that the fit holds for faults of the measuring.
    """
    return Delivery(recording, fitted, inputs, labels, freed).errors()


@dataclass(frozen=True)
class Delivery:
    """What a fitted robot delivers at poses of other folds: see :func:`delivered_errors`."""

    recording: Recording
    fitted: Fit
    inputs: PoseInputs
    labels: Array
    freed: bool = False

    @cached_property
    def _stated(self) -> tuple[Array, Array, Array]:
        """Frames, whitened residuals and Jacobian at the poses as they are stated."""
        kernel = self.fitted.kernel
        columns = np.array([kernel.index[name] for name in self.fitted.free], dtype=np.intp)
        frames, J = kernel.frames_and_jacobian(self.fitted.theta, self.inputs, columns)
        residual, jacobian = replace(self.recording, common=None, shared=None).linearise(frames, J)
        return frames, residual, jacobian

    @cached_property
    def _compressed(self) -> dict[int, Array]:
        """By fold, the triangular factor of Jacobian and residual of all others: every subset of columns has its least
        squares solution in it."""
        fold_of_row = self.labels[self.fitted.row_pose]
        rows = np.column_stack([self.fitted.jacobian, self.fitted.residual])
        return {int(k): np.asarray(np.linalg.qr(rows[fold_of_row != k], mode="r")) for k in np.unique(self.labels)}

    def vectors(self, dropped: Sequence[str] = ()) -> tuple[Array, Array]:
        """Errors (m_obs, k), m and rad, and whitened ones; without the amplitudes ``dropped``, to first order."""
        fitted, labels = self.fitted, self.labels
        frames, residual, jacobian = self._stated
        count = len(fitted.free)
        out = np.isin(np.array(fitted.free), list(dropped))
        value = fitted.theta[[fitted.kernel.index[name] for name in fitted.free]] * out
        # a term is left out by an amplitude of zero: in small effects the fit is linear
        residual = residual + jacobian @ value
        stay = np.concatenate([~out, np.ones(fitted.jacobian.shape[1] - count, dtype=bool)])
        kept = ~np.any(fitted.prior[:, :count][:, out] != 0.0, axis=1)
        prior, expected = fitted.prior[kept][:, stay], fitted.prior_residual[kept]
        jacobian = jacobian[:, ~out]
        cell = [f"{end}.{kind}" for end in ("base", "tool") for kind in GEOMETRIC_KINDS]
        own = [k for k, name in enumerate(np.array(fitted.free)[~out]) if name in cell]
        displaced = fitted.jacobian[:, count:]
        direct = [item.values for item in fitted.accepted if isinstance(item.cause, ObservationCause)]
        amplitudes = np.concatenate(direct) if direct else np.zeros(0)
        fold_of_row = labels[fitted.row_pose]
        left = np.empty(len(residual))
        for fold in np.unique(labels):
            test = fold_of_row == fold
            rows = self._compressed[int(fold)]
            at_fit = rows[:, -1] + rows[:, :count] @ value
            step = solve(np.vstack([rows[:, :-1][:, stay], prior]), np.concatenate([at_fit, expected]))
            after = residual - jacobian @ step[: jacobian.shape[1]]
            if self.freed:
                after = after - displaced @ (amplitudes + step[jacobian.shape[1] :])
            # base and tool are those of the measurements as they are
            left[test] = after[test] - jacobian[np.ix_(test, own)] @ solve(jacobian[np.ix_(~test, own)], after[~test])
        plain = replace(self.recording, common=None, shared=None)
        per = len(left) // len(self.recording.observations.pose)
        return plain.unwhiten(left[:, None], frames)[:, :, 0], left.reshape(-1, per)

    def errors(self, dropped: Sequence[str] = ()) -> tuple[Array, Array]:
        """Lengths (m_obs,) of the position errors, m, and of the whitened ones."""
        errors, white = self.vectors(dropped)
        return np.linalg.norm(errors[:, :3], axis=1), np.linalg.norm(white, axis=1)


@dataclass(frozen=True)
class Gain:
    """What a change of the robot gains: errors before and after (RMS), standard error, errors of the folds."""

    before: float
    after: float
    sigma: float
    folds_before: Array
    folds_after: Array

    @property
    def strength(self) -> float:
        """Mean of the folds' gains by its standard error; the gain of a fold is the logarithm of the factor by which
        its error falls, so that one pose of great leverage does not drown what all others say."""
        tiny = np.finfo(float).tiny
        gains = np.log(np.maximum(self.folds_before, tiny)) - np.log(np.maximum(self.folds_after, tiny))
        error = np.std(gains, ddof=1) / np.sqrt(len(gains)) if len(gains) > 1 else np.inf
        return float(np.mean(gains) / max(error, 1e-12))

    @property
    def pays(self) -> bool:
        """The error falls, in the folds by clearly more than their standard error, and in none it grows much."""
        return self.after < self.before and self.strength > PAYING_SIGMAS and self.even

    def pays_jointly(self, weighted: "Gain") -> bool:
        """The error falls, or that weighted by its uncertainty does beyond doubt while this one stays as it is.

        Directions and places that are measured best show small effects which the plain length hides in noise.
        """
        return self.pays or (weighted.pays and self.even and self.after <= WAITING * self.before)

    @property
    def clear(self) -> bool:
        """The error falls much, far beyond its standard error, and in every fold."""
        falls = self.after <= CLEAR * self.before and self.before - self.after > CLEAR_SIGMAS * self.sigma
        return falls and bool(np.all(self.folds_after <= self.folds_before))

    @property
    def even(self) -> bool:
        """In no fold the error grows much."""
        return bool(np.all(self.folds_after <= MUCH_WORSE * self.folds_before))


def gain_of(before: Array, after: Array, fold: Array) -> Gain:
    """Gain from errors (m_obs,) of the same observations; its standard error is that of the jackknife over folds."""

    def rms(errors: Array, keep: Array) -> float:
        return float(np.sqrt(np.mean(errors[keep] ** 2)))

    labels = np.unique(fold)
    without = np.array([rms(before, fold != k) - rms(after, fold != k) for k in labels])
    n = len(labels)
    sigma = float(np.sqrt((n - 1) / n * np.sum((without - without.mean()) ** 2)))
    inside = [np.array([rms(errors, fold == k) for k in labels]) for errors in (before, after)]
    whole = np.ones(len(fold), dtype=bool)
    return Gain(rms(before, whole), rms(after, whole), sigma, inside[0], inside[1])
