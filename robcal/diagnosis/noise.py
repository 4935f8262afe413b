"""Noise before physics: a factor on the stated covariance and the repeatability of the joints.

Restricted maximum likelihood (Patterson and Thompson 1971): the covariance of an observation is
`s2 C + sj2 A A'` with `A` the displacement of the observation by the joints; both factors maximise the likelihood of
the residuals after the fitted parameters have been projected out.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import optimize

from robcal.diagnosis.decorrelation import SharedNoise
from robcal.diagnosis.recording import Accepted, Fit, Recording, fit
from robcal.physics.family import Array
from robcal.robot.model import RobotModel


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
    """Maximise the restricted likelihood over the ratio of the components; the common factor follows in closed form.

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
    blocks = []
    for rows in np.split(order, starts[1:]):
        A = moved[rows].reshape(len(rows) * per, -1)
        values, vectors = np.linalg.eigh(A @ A.T)
        blocks.append((values, vectors.T @ residual[rows].reshape(-1), vectors.T @ jacobian[rows].reshape(len(A), -1)))
    values = np.clip(np.concatenate([b[0] for b in blocks]), 0.0, None)
    r = np.concatenate([b[1] for b in blocks])
    J = np.concatenate([b[2] for b in blocks])
    if common is not None:
        shared, fitted = common.shape[1], present.jacobian.shape[1]
        values, r = (np.concatenate([known, np.zeros(shared)]) for known in (values, r))
        J = np.vstack([J, np.eye(shared, fitted + shared, fitted)])
    U, s, _ = np.linalg.svd(J / np.maximum(np.linalg.norm(J, axis=0), 1e-300), full_matrices=False)
    J = U[:, s > 1e-9 * s[0]]
    freedom = len(r) - J.shape[1]

    def profile(log_ratio: float) -> tuple[float, float]:
        weight = 1.0 / (1.0 + np.exp(log_ratio) * values)
        normal = J.T @ (weight[:, None] * J)
        left = r - J @ np.linalg.solve(normal, J.T @ (weight * r))
        variance = float(np.sum(weight * left**2)) / freedom
        log_det = float(np.linalg.slogdet(normal)[1])
        return freedom * np.log(variance) - float(np.sum(np.log(weight))) + log_det, variance

    scale = -np.log(max(float(np.mean(values[: len(present.residual)])), 1e-300))
    none = profile(-700.0)
    found = optimize.minimize_scalar(
        lambda x: profile(x)[0], bounds=(scale - 8.0, scale + 6.0), method="bounded", options={"xatol": 0.02}
    )
    # twice the logarithm of the likelihood ratio; below one the simpler model of the noise is taken
    if none[0] - float(found.fun) < 1.0:
        return Noise(none[1], 0.0, moved)
    variance = profile(float(found.x))[1]
    return Noise(variance, float(np.sqrt(variance * np.exp(found.x))), moved)
