"""Frames in tables: six numbers, their covariance, and its relation to the perturbation used inside."""

import numpy as np

from robcal.transforms import Array, twist_from_six, xyzrpy_from_frame

LOCKED, NEARLY_LOCKED = 1e-3, 0.05
"""Cosine of pitch below which roll and yaw count as turning about one line, and as nearly so."""
OPEN = 0.25
"""Share of pitch's variance that every direction of a turn has at least where roll and yaw nearly share a line."""
SIX = ("x", "y", "z", "roll", "pitch", "yaw")


def frame_covariance_columns() -> list[tuple[str, int, int]]:
    """Column names of a full 6x6 covariance of x, y, z, roll, pitch, yaw and the places of its elements."""
    columns = []
    for i, first in enumerate(SIX):
        for j in range(i, 6):
            unit = "mm2" if j < 3 else "deg2" if i >= 3 else "mm_deg"
            columns.append((f"s{first}{SIX[j]}_{unit}", i, j))
    return columns


def frame_columns(T: Array) -> dict[str, list[str]]:
    """Columns of frames (n, 4, 4) for a table: mm with six decimals, deg with eight."""
    six = xyzrpy_from_frame(T)
    columns = {f"{name}_mm": [f"{v:.6f}" for v in six[:, k] * 1000] for k, name in enumerate(SIX[:3])}
    columns.update({f"{name}_deg": [f"{v:.8f}" for v in np.degrees(six[:, k + 3])] for k, name in enumerate(SIX[3:])})
    return columns


def six_covariance(T: Array, covariance: Array) -> Array:
    """Covariance (n, 6, 6) of the six numbers of frames, m and rad, from that of their right perturbation.

    At a pitch of +-90 degrees roll and yaw turn about one line, and one alone is as uncertain as can be: there all
    three angles are given the mean variance of the turn, which :func:`twist_covariance` reads back.
    """
    six = xyzrpy_from_frame(T)
    locked = np.abs(np.cos(six[:, 4])) < LOCKED
    jacobian = twist_from_six(six)
    jacobian[locked, 3:, 3:] = np.eye(3)
    inverse: Array = np.asarray(np.linalg.inv(jacobian), dtype=float)
    out: Array = inverse @ covariance @ np.swapaxes(inverse, 1, 2)
    turn = np.trace(covariance[locked, 3:, 3:], axis1=1, axis2=2) / 3.0
    out[locked, 3:, 3:] = turn[:, None, None] * np.eye(3)
    out[locked, :3, 3:], out[locked, 3:, :3] = 0.0, 0.0
    return out


def twist_covariance(six: Array, covariance: Array) -> Array:
    """Covariance (n, 6, 6) of the right perturbation of frames from that of their six numbers, m and rad.

    Near a pitch of +-90 degrees the angles' variances say nothing about one direction of the turn (or say it with
    numbers beyond any precision): there pitch's variance, which is well defined, holds for what they leave open.
    """
    jacobian = twist_from_six(six)
    out = jacobian @ covariance @ np.swapaxes(jacobian, 1, 2)
    pitch = covariance[:, 4, 4]
    cosine = np.abs(np.cos(six[:, 4]))
    locked = (cosine < LOCKED) | ((cosine < NEARLY_LOCKED) & (np.linalg.eigvalsh(out)[:, 0] <= 0))
    out[locked, 3:, 3:] = pitch[locked, None, None] * np.eye(3)
    out[locked, :3, 3:], out[locked, 3:, :3] = 0.0, 0.0
    for i in np.flatnonzero(~locked & (cosine < NEARLY_LOCKED)):
        values, vectors = np.linalg.eigh(out[i, 3:, 3:])
        short = np.clip(OPEN * pitch[i] - values, 0.0, None)
        out[i, 3:, 3:] += (vectors * short) @ vectors.T
    return out


def sigma_columns(T: Array, covariance: Array) -> dict[str, list[str]]:
    """Standard deviations of the six numbers of frames from the covariance (n, 6, 6) of their right perturbation."""
    variances = np.diagonal(six_covariance(T, covariance), axis1=1, axis2=2)
    sigma = np.sqrt(np.clip(variances, 0, None)) * np.array([1000.0] * 3 + [180 / np.pi] * 3)
    names = [f"s{name}_{'mm' if k < 3 else 'deg'}" for k, name in enumerate(SIX)]
    return {name: [f"{v:.6g}" for v in sigma[:, k]] for k, name in enumerate(names)}
