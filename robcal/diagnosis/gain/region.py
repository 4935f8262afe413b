"""One region of the workspace kept out altogether: effects that parameters absorb show outside the range only."""

import numpy as np

from robcal.diagnosis.core.fitting import Fit, damping, solve
from robcal.diagnosis.core.recording import Recording
from robcal.diagnosis.gain.heldout import rms
from robcal.physics.cause import Array

SHARE = 0.2
"""Share of the poses that lie in the region."""
LEAST_POSES = 25
"""Recordings with fewer poses are not divided."""


def outermost(frames: Array, share: float = SHARE) -> Array:
    """Poses (n,) at one end of the measured space: along the direction in which their positions (n, 4, 4) spread most.

    The end is that with the longer tail, where a model has to reach farthest.
    """
    p = frames[:, :3, 3] - frames[:, :3, 3].mean(axis=0)
    along = p @ np.linalg.svd(p, full_matrices=False)[2][0]
    if -along.min() > along.max():
        along = -along
    return np.asarray(along >= np.quantile(along, 1.0 - share))


def extrapolated(recording: Recording, fitted: Fit, region: Array) -> float:
    """Root mean square of the position errors (m) in a region (n,) of poses, predicted from all others.

    By the linearised fit; what the other poses leave open stays near the whole fit by the size that deviations have.
    """
    test = region[fitted.row_pose]
    per = len(fitted.residual) // len(recording.observations.pose)
    variables = fitted.kernel.variables(fitted.theta, fitted.inputs)
    brakes = np.diag(damping(fitted.free, fitted.jacobian.shape[1], variables))
    rows = np.vstack([fitted.jacobian[~test], brakes, fitted.prior])
    step = solve(rows, np.concatenate([fitted.residual[~test], np.zeros(len(brakes)), fitted.prior_residual]))
    predicted = np.where(test, fitted.residual - fitted.jacobian @ step, 0.0)
    errors = recording.unwhiten(predicted[:, None], fitted.frames)[:, : min(per, 3), 0]
    return rms(errors[region[recording.observations.pose]])


def region_errors(recording: Recording, before: Fit, after: Fit) -> tuple[float, float] | None:
    """Errors (m) in the outermost region, predicted from all other poses: without and with what was found."""
    if len(recording.q) < LEAST_POSES:
        return None
    region = outermost(after.frames)
    return extrapolated(recording, before, region), extrapolated(recording, after, region)
