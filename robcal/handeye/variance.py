"""Variance components of a hand-eye calibration: pixels, the robot's misses, deviations of its geometry.

Restricted maximum likelihood (Patterson and Thompson 1971) on the linearised problem. With random unknowns in the
normal equations (Henderson 1975) the restricted likelihood needs only their determinants:
``rows log s^2 + log|I + L V L / s^2| (each twist) + log|T| (deviations of the robot) + log|reduced normals| + sum of
squares``. A robot that misses by millimetres thus cannot pass for one that leaves the noise of pixels.
"""

from dataclasses import replace

import numpy as np
from scipy import optimize

from robcal.handeye.unknowns import System, Variances, reduced
from robcal.transforms import Array

LEAST_PLACE, MOST_PLACE = 1e-7, 0.5
LEAST_TURN, MOST_TURN = 1e-7, 0.5
LEAST_PIXEL, MOST_PIXEL = 1e-3, 1e3
SINGULAR = 1e12
END = {"maxiter": 60, "ftol": 1e-8, "gtol": 0.05}
"""The criterion is curved by hundreds a unit of a logarithm: a slope below this is a ten thousandth of a component."""
NEGLIGIBLE = 3e-7
"""Components (m, rad) below this are none."""


def criterion(system: System, variances: Variances) -> float:
    """Minus twice the restricted log likelihood of variance components, but for a constant; huge where singular."""
    normals = reduced(system, variances)
    prior = system.sigmas(variances)
    random = np.isfinite(prior) & (system.place | system.turn)
    try:
        L = np.linalg.cholesky(normals.V)
        half = np.linalg.solve(L, np.swapaxes(normals.G, 1, 2))
        u = np.linalg.solve(L, normals.s[..., None])[..., 0]
        flat = half.reshape(-1, half.shape[2])
        S = normals.A - flat.T @ flat
        b = normals.b - flat.T @ u.ravel()
        scale = 1.0 / np.sqrt(np.diag(normals.A))
        root = np.linalg.cholesky(S * scale[:, None] * scale)
        z = np.linalg.solve(root, scale * b)
    except np.linalg.LinAlgError:
        return SINGULAR
    square = system.square / variances.pixel**2 - float(u.ravel() @ u.ravel()) - float(z @ z)
    logs = 2.0 * np.log(np.diagonal(L, axis1=1, axis2=2)).sum() + 2.0 * np.log(prior[random]).sum()
    logs += 2.0 * np.log(np.diag(root)).sum() - 2.0 * np.log(scale).sum()
    return float(2.0 * system.rows * np.log(variances.pixel) + logs + square)


def estimate(system: System, start: Variances, wide: bool = True) -> tuple[Variances, float]:
    """Variance components of highest restricted likelihood, and the criterion there.

    Components of the robot's geometry are estimated where it is adjusted, else they stay zero. ``wide``: look from two
    starts, since the likelihood may have a second maximum at no scatter at all, where the first one is hardly curved.
    """
    names = ["pixel", "place", "turn"]
    bounds = [(LEAST_PIXEL, MOST_PIXEL), (LEAST_PLACE, MOST_PLACE), (LEAST_TURN, MOST_TURN)]
    if system.place.any():
        names += ["robot_place", "robot_turn"]
        bounds += [(1e-6, 0.05), (1e-6, 0.1)]

    def of(logs: Array) -> Variances:
        return replace(start, **dict(zip(names, map(float, np.exp(logs)), strict=True)))

    limits = np.log(np.array(bounds))
    best: tuple[float, Array] | None = None
    for share in (1.0, 0.05) if wide else (1.0,):
        guess = np.array([getattr(start, name) * (1.0 if name == "pixel" else share) for name in names])
        first = np.clip(np.log(np.maximum(guess, np.exp(limits[:, 0]))), limits[:, 0] + 1.0, limits[:, 1])
        found = optimize.minimize(
            lambda logs: criterion(system, of(logs)), first, method="L-BFGS-B", bounds=limits, options=END
        )
        if best is None or found.fun < best[0]:
            best = (float(found.fun), np.asarray(found.x))
    if best is None:
        return start, SINGULAR
    variances = of(best[1])
    small = {name: 0.0 for name in ("place", "turn") if getattr(variances, name) < NEGLIGIBLE}
    return replace(variances, **small), best[0]
