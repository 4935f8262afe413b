"""Noise before physics: the variance components of :mod:`robcal.calibration.noise` at a fit of the diagnosis."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from robcal.calibration.noise import restricted_components
from robcal.diagnosis.core.decorrelation import SharedNoise
from robcal.diagnosis.core.fitting import Accepted, Fit, fit
from robcal.diagnosis.core.recording import Recording
from robcal.physics.cause import Array
from robcal.robot.model import RobotModel

SWALLOWED = 0.25
"""Share of the stated variance below which single numbers are not believed to scatter."""


@dataclass(frozen=True)
class Noise:
    """Variance factor of the stated covariance, and standard deviation of the joints' positions (rad or m)."""

    factor: float
    joint_sigma: float
    moved: Array

    def apply(self, recording: Recording) -> Recording:
        """The recording with the joints' repeatability in its weights; the common factor stays with the tests."""
        if self.joint_sigma == 0.0:
            return replace(recording, shared=None)
        ratio = self.joint_sigma**2 / self.factor
        return replace(recording, shared=SharedNoise(recording.observations.pose, self.moved, ratio))


def estimate_noise(
    model: RobotModel, recording: Recording, free: Sequence[str], accepted: Sequence[Accepted] = ()
) -> Noise:
    """Estimate both components at the fit of the given model."""
    plain = replace(recording, shared=None, common=None)
    present = fit(model, plain, free, accepted)
    common = None if recording.common is None else plain.whiten(recording.common, present.frames)
    return restricted_likelihood(present, plain, common)


def restricted_likelihood(present: Fit, recording: Recording, common: Array | None = None) -> Noise:
    """Both components from a fit.

    `recording` must be whitened by its stated covariance alone; `common` (m, k) are whitened displacements by one
    standard deviation of errors that all poses share: random numbers of unit variance, so each enters as an unknown
    that was observed to be zero (Henderson's mixed model equations).
    """
    joints = present.kernel.joint_jacobian(present.theta, present.inputs)
    _, flat = recording.observations.linearise(present.frames, joints)
    observations = len(recording.observations.pose)
    per = len(flat) // observations
    moved = flat.reshape(observations, per, -1)
    residual = present.residual.reshape(observations, per)
    absorbed = present.jacobian if common is None else np.column_stack([present.jacobian, common])
    jacobian = absorbed.reshape(observations, per, -1)
    order = np.argsort(recording.observations.pose, kind="stable")
    pose = recording.observations.pose[order]
    starts = np.flatnonzero(np.r_[True, pose[1:] != pose[:-1]])
    blocks = [
        (moved[rows].reshape(len(rows) * per, -1), residual[rows].ravel(), jacobian[rows].reshape(len(rows) * per, -1))
        for rows in np.split(order, starts[1:])
    ]
    if common is not None:
        shared, fitted = common.shape[1], present.jacobian.shape[1]
        seen_zero = np.eye(shared, fitted + shared, fitted)
        blocks.append((np.zeros((shared, moved.shape[2])), np.zeros(shared), seen_zero))
    found = restricted_components(blocks)
    # One number a pose hardly tells the joints' scatter from its own: where the joints swallow all of it, they have
    # swallowed what is missing in the model.
    swallowed = per == 1 and len(blocks) == observations and found.variance < SWALLOWED * min(1.0, found.alone)
    # below one the simpler model of the noise is taken
    if found.statistic < 1.0 or swallowed:
        return Noise(found.alone, 0.0, moved)
    return Noise(found.variance, float(np.sqrt(found.variance * found.ratio)), moved)
