"""The parameters that explain how targets at rest have moved for the sensor since the reference."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from robcal.drift.reference import DriftReference, Ints, Readings
from robcal.estimation.gauss_newton import solve_step
from robcal.transforms import Array

MEDIAN = float(stats.chi2.median(3))
GROSS = float(stats.chi2.isf(1e-6, 3))
"""Squared normalised residual (3 coordinates) beyond which a reading is a gross error."""


@dataclass(frozen=True)
class Linearised:
    """Displacements of a tour about the model in force.

    Attributes
    ----------
    r : (m, 3) unexplained displacement; A : (m, 3, p) derivative of the model; C : (m, 3, 3) covariance of ``r``.
    """

    r: Array
    A: Array
    C: Array

    def whitened(self) -> tuple[Array, Array]:
        """(m, 3) and (m, 3, p) in units of the readings' standard deviations."""
        L = np.linalg.cholesky(self.C)
        white = np.linalg.solve(L, np.concatenate([self.r[..., None], self.A], axis=2))
        return white[..., 0], white[..., 1:]


@dataclass(frozen=True)
class DriftFit:
    """Outcome of a tour.

    Attributes
    ----------
    change : (p,) of the drifting parameters since the reference, m and rad; covariance : (p, p).
    kept : (m,) readings that took part. size : (m,) squared normalised residual of each reading (3 coordinates).
    at_bound : names that would go beyond their bounds and are held there.
    uncorrected, residual : (m, 3) m, displacements with the robot of the reference, and with this one.
    linear : displacements about the model that was in force.
    noise : factor of the readings' variance that the kept ones show (robust).
    """

    change: Array
    covariance: Array
    kept: NDArray[np.bool_]
    size: Array
    at_bound: tuple[str, ...]
    uncorrected: Array
    residual: Array
    linear: Linearised
    noise: float


def linearise(reference: DriftReference, readings: Readings, slots: Ints, change: Array, noise: float) -> Linearised:
    """Displacements about a change (p,), with the covariance of sensor and reference; older readings count less."""
    r, A, R = reference.displacements(readings, slots, change)
    age = readings.time.max() - readings.time
    C = noise * (R @ readings.covariance @ np.swapaxes(R, 1, 2) + reference.covariance[slots])
    C = C + ((reference.settings.rate * age) ** 2)[:, None, None] * np.eye(3)
    return Linearised(r, A, C)


def fit_drift(
    reference: DriftReference, readings: Readings, slots: Ints, in_force: Array, noise: float = 1.0
) -> DriftFit:
    """Minimise ``sum |T(x1, q_now) x_sensor - T(x0, q_ref) x_sensor_ref|^2`` over the drifting parameters.

    Their expected thermal changes enter as a prior, so that what the tour hardly tells stays where it was. Readings
    that do not fit are left out one by one, the worst first, by the size of their residual freed of its share in the
    fit (Baarda 1968).

    Parameters
    ----------
    in_force : (p,) change to start from. noise : factor of the readings' variance known so far.
    """
    kept = np.ones(len(readings), dtype=bool)
    linear = linearise(reference, readings, slots, in_force, noise)
    while True:
        change = _solve(reference, linear, in_force, kept)
        covariance = _covariance(reference, linear, kept)
        size = _sizes(reference, linear, change - in_force, covariance, kept)
        scale = max(1.0, float(np.median(size[kept])) / MEDIAN)
        worst = int(np.argmax(np.where(kept, size, -1.0)))
        if size[worst] <= GROSS * scale or kept.sum() <= max(6, len(kept) // 2):
            break
        kept[worst] = False
    # drift is small: a second step, with the derivatives of the first, moves the targets by nanometres
    there = replace(linear, r=reference.unexplained(readings, slots, change))
    change = _solve(reference, there, change, kept)
    change, at_bound = _bounded(reference, linear, in_force, change, kept)
    return DriftFit(
        change,
        covariance,
        kept,
        size,
        at_bound,
        linear.r + linear.A @ in_force,
        linear.r - linear.A @ (change - in_force),
        linear,
        float(np.median(size[kept])) / MEDIAN * noise,
    )


def _solve(reference: DriftReference, linear: Linearised, about: Array, kept: NDArray[np.bool_]) -> Array:
    """The change (p,) that explains the kept readings best, linearised about a change."""
    r, A = linear.whitened()
    J = np.concatenate([A[kept].reshape(-1, len(about)), np.diag(1 / reference.sizes)])
    return np.asarray(about + solve_step(np.concatenate([r[kept].ravel(), -about / reference.sizes]), J))


def _covariance(reference: DriftReference, linear: Linearised, kept: NDArray[np.bool_]) -> Array:
    _, A = linear.whitened()
    J = A[kept].reshape(-1, A.shape[2])
    scaled = J * reference.sizes
    return np.linalg.inv(scaled.T @ scaled + np.eye(J.shape[1])) * np.outer(reference.sizes, reference.sizes)


def _sizes(reference: DriftReference, linear: Linearised, step: Array, fit: Array, kept: NDArray[np.bool_]) -> Array:
    r = linear.r - linear.A @ step
    by_fit = linear.A @ fit @ np.swapaxes(linear.A, 1, 2)
    # a reading that took part has drawn the fit to itself, one that did not adds the fit's own uncertainty
    C = linear.C + np.where(kept, -1.0, 1.0)[:, None, None] * by_fit
    C = np.where((np.linalg.eigvalsh(C)[:, 0] > 0.05 * np.linalg.eigvalsh(linear.C)[:, 0])[:, None, None], C, linear.C)
    return np.asarray(np.einsum("mi,mi->m", r, np.linalg.solve(C, r[..., None])[..., 0]))


def _bounded(
    reference: DriftReference, linear: Linearised, start: Array, change: Array, kept: NDArray[np.bool_]
) -> tuple[Array, tuple[str, ...]]:
    """The change with all parameters within their bounds; the others make up for those that are held."""
    limit = reference.settings.bounds * reference.sizes
    if np.all(np.abs(change) <= limit):
        return change, ()
    r, A = linear.whitened()
    J = np.concatenate([A[kept].reshape(-1, len(change)), np.diag(1 / reference.sizes)])
    b = np.concatenate([r[kept].ravel() + (A[kept] @ start).ravel(), np.zeros(len(change))])
    held: dict[int, float] = {}
    out = change.copy()
    for _ in range(len(change)):
        beyond = [k for k in range(len(change)) if abs(out[k]) > limit[k] * (1 + 1e-12) and k not in held]
        if not beyond:
            break
        held.update({k: float(np.sign(out[k]) * limit[k]) for k in beyond})
        free = [k for k in range(len(change)) if k not in held]
        out[list(held)] = list(held.values())
        if free:
            out[free] = np.linalg.lstsq(J[:, free], b - J[:, list(held)] @ out[list(held)], rcond=None)[0]
    return out, tuple(reference.names[k] for k in sorted(held))
