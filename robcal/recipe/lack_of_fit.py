"""How far the joints are from where the model has them: what poses kept out in folds show beyond measurement and
parameters, so that predictions state it.

The mean square of the errors at poses that a fit has not seen is the sum of three variances: of the measurement, of
the parameters, and of what the model misses. The last one is told as a scatter of the joints, each by its own share:
squared errors regressed on squared displacements with non-negative variances (Amemiya, 1977), drawn half way to one
variance for all joints, since few poses tell joints apart poorly.
"""

from dataclasses import replace

import numpy as np
from scipy import optimize

from robcal.calibration.identifiability import repetitions
from robcal.calibration.observations import FrameObservations, PointObservations
from robcal.diagnosis.core.fitting import Fit
from robcal.diagnosis.core.recording import Recording
from robcal.diagnosis.gain.delivered import Delivery
from robcal.robot.kernel import PoseInputs
from robcal.transforms import Array

FOLDS = 10
SHARE = 0.5
"""Weight of the joints' own variances against one for all."""


def missing_joint_sigma(recording: Recording, fitted: Fit, inputs: PoseInputs, scale: float) -> Array | None:
    """Standard deviation (N,) of each joint, rad or m, that kept-out errors show; None where they measure no place.

    Parameters
    ----------
    recording : as it was measured. fitted : to it, errors common to all poses not taken off.
    inputs : its poses as they would be stated to predict.
    scale : factor on the stated variances that makes them those of the measurement alone.
    """
    observations = recording.observations
    if not isinstance(observations, FrameObservations | PointObservations):
        return None
    plain = replace(recording, common=None, shared=None)
    groups = repetitions(recording.q)
    count = int(groups.max()) + 1
    labels = (np.argsort(np.random.default_rng(0).permutation(count)) % min(FOLDS, count))[groups]
    errors = Delivery(plain, fitted, inputs, labels, freed=True).vectors()[0][:, :3]
    measured = scale * np.diagonal(observations.noise(fitted.frames), axis1=1, axis2=2)[:, :3]
    known = np.zeros_like(measured)
    if len(fitted.free):
        columns = plain.unwhiten(fitted.jacobian[:, : len(fitted.free)], fitted.frames)[:, :3]
        size = len(fitted.free)
        covariance = fitted.covariance[:size, :size] * fitted.variance_factor
        known = np.einsum("mip,pq,miq->mi", columns, covariance, columns)
    _, flat = observations.linearise(fitted.frames, fitted.kernel.joint_jacobian(fitted.theta, fitted.inputs))
    square = plain.unwhiten(flat, fitted.frames)[:, :3] ** 2
    return _balanced(errors**2 - measured - known, square)


def _balanced(excess: Array, square: Array) -> Array:
    """Standard deviations (N,) whose displacements (m, 3, N), squared, make up an excess (m, 3) of variance."""
    y, X = excess.ravel(), square.reshape(-1, square.shape[2])
    total = float(y.sum())
    if total <= 0:
        return np.zeros(X.shape[1])
    alike = np.full(X.shape[1], total / max(float(X.sum()), 1e-300))
    size = np.linalg.norm(X, axis=0)
    safe = np.where(size > 0, size, 1.0)
    own = optimize.nnls(X / safe, y)[0] / safe
    made = float((X @ own).sum())
    own = own * total / made if made > 0 else alike
    return np.asarray(np.sqrt(SHARE * own + (1.0 - SHARE) * alike))
