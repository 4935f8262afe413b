"""What may not be accepted however well it fits: impossible sizes, times that are patterns of poses, no gain.

A cause must be possible by its sign and size; one bound to the time or the order of the poses must not follow what
else changes from pose to pose; and it must gain on poses kept out in blocks.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from robcal.diagnosis.core.fitting import Accepted, Fit
from robcal.diagnosis.core.recording import Recording
from robcal.diagnosis.gain.heldout import folds
from robcal.diagnosis.scan.tangents import Tangents
from robcal.estimation.minimum_norm import solve
from robcal.physics.cause import Array

CONFOUNDED = 0.8
"""Share of a pattern over time that the poses may explain."""
RESTING = 1e-6
"""A joint that differs less than this (rad, m) from where it mostly is rests there."""
LEAST_REST = 0.15
"""Share of the poses in which a joint must rest at one place for its setting out to be a pattern."""
LEAST_FURTHER = 0.01
"""Share by which a cause beside others has to lower the sum of squares over folds: half a percent of the error."""
SURE = 2.0
"""Change of a fold's sum of squares, in units of the variance factor, that counts for or against a cause."""


@dataclass(frozen=True)
class Refusal:
    """Why a cause that fits is not accepted.

    Attributes
    ----------
    confounded : what else changed at its time explains it as well. small : the search has come to what matters no more.
    """

    reason: str
    confounded: bool = False
    small: bool = False


def refusal(item: Accepted, before: Fit, after: Fit, at: Tangents) -> Refusal | None:
    """Why a cause is not accepted although it fits; None if it may be.

    Parameters
    ----------
    item : the cause as fitted. before, after : fits without and with it. at : tangents of the first.
    """
    cause = item.cause
    if not possible(item, after):
        return Refusal(f"{cause.describe(cause.report(item.values, item.constants))}, which cannot be")
    if cause.of_order:
        if not cause.kind.named:
            return Refusal(
                f"something at {cause.where} follows the order or the time of the poses, which is no law of a robot"
            )
        together = confounded_with(item, at)
        if together:
            return Refusal(
                f"{cause.kind.words} at {cause.where} cannot be told from what follows {together}, which changes at "
                "the same time: repeat some of the first poses at the end",
                confounded=True,
            )
        return None
    gain, clear = fold_gain(before, after, at.recording)
    if not clear:
        return Refusal(f"{cause.kind.words} at {cause.where} does not gain on blocks of poses that are kept out")
    if before.accepted and gain < LEAST_FURTHER:
        return Refusal(
            f"{cause.kind.words} at {cause.where} would be next, but the mean square error over blocks of poses falls "
            f"by {gain:.1%} only: the search ended there",
            small=True,
        )
    return None


def possible(item: Accepted, fitted: Fit) -> bool:
    """Whether the amplitudes have signs and sizes that physics allows, and the data tell the first one."""
    low, high = item.cause.limits
    if not np.all((item.values >= low) & (item.values <= high)):
        return False
    return bool(np.sqrt(item.covariance[0, 0] * fitted.variance_factor) < item.cause.known_within)


def confounded_with(item: Accepted, at: Tangents) -> str:
    """What changes from pose to pose as a cause over time does: `axisK`, a payload; empty where nothing does.

    A joint that rests and sets out, or a load that is changed, at the time of a jump explains it as well.
    """
    pattern = _pattern(item, at)
    pattern = pattern - np.mean(pattern)
    for name, column in _settings(at.recording).items():
        other = column - np.mean(column)
        size = float((other @ other) * (pattern @ pattern))
        if size > 0 and float(other @ pattern) ** 2 > CONFOUNDED * size:
            return name
    return ""


def _pattern(item: Accepted, at: Tangents) -> Array:
    """The course (n,) of a cause over the poses: zero before and one after a jump, or the value of its law."""
    if "pose" in item.constants:
        return np.asarray(at.recording.covariates["index"] >= item.constants["pose"] - 0.5, dtype=float)
    laws = item.cause.laws(item.constants)
    return at.laws.value(laws[0], at.variables) if laws else np.asarray(at.recording.covariates["index"])


def _settings(recording: Recording) -> Mapping[str, Array]:
    """Columns (n,) that tell in which poses a joint is away from where it rests, or the robot carries a load."""
    out: dict[str, Array] = {}
    for k in range(recording.q.shape[1]):
        places, number, times = np.unique(
            np.round(recording.q[:, k] / RESTING), return_inverse=True, return_counts=True
        )
        if len(places) > 1 and times.max() >= LEAST_REST * len(number):
            out[f"axis{k + 1}"] = (number != int(np.argmax(times))).astype(float)
    for payload in set(recording.payload) if len(set(recording.payload)) > 1 else ():
        out[f"payload {payload}"] = np.array([p == payload for p in recording.payload], dtype=float)
    return out


def fold_gain(before: Fit, after: Fit, recording: Recording) -> tuple[float, bool]:
    """Share by which the sum of squares over blocked folds falls, and whether most blocks that say anything agree."""
    label = folds(recording)[before.row_pose]
    left = _kept_out(before, label)
    change = left - _kept_out(after, label)
    unit = SURE * after.variance_factor
    clear = bool(change.sum() > 0 and np.sum(change > unit) >= np.sum(change < -unit))
    return float(change.sum() / max(left.sum(), 1e-300)), clear


def _kept_out(fitted: Fit, label: Array) -> Array:
    """Sum of squares (folds,) of each fold's whitened residuals, predicted from the others to first order."""
    out = []
    for fold in np.unique(label):
        test = label == fold
        rows = np.vstack([fitted.jacobian[~test], fitted.prior])
        step = solve(rows, np.concatenate([fitted.residual[~test], fitted.prior_residual]))
        left = fitted.residual[test] - fitted.jacobian[test] @ step
        out.append(float(left @ left))
    return np.array(out)
