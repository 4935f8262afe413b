"""Frames in tables: six numbers, their covariance, and its relation to the perturbation used inside."""

from __future__ import annotations

import numpy as np

from robcal.transforms import Array, frame_from_xyzrpy, xyzrpy_from_frame

SIX = ("x", "y", "z", "roll", "pitch", "yaw")


def frame_covariance_columns() -> list[tuple[str, int, int]]:
    """Column names of a full 6x6 covariance of x, y, z, roll, pitch, yaw and the places of its elements."""
    columns = []
    for i, first in enumerate(SIX):
        for j in range(i, 6):
            unit = "mm2" if j < 3 else "deg2" if i >= 3 else "mm_deg"
            columns.append((f"s{first}{SIX[j]}_{unit}", i, j))
    return columns


def twist_from_six(six: Array) -> Array:
    """(n, 6, 6) Jacobian of the right perturbation (rho, omega) of a frame by its numbers x, y, z, roll, pitch, yaw.

    With R = Rz(yaw) Ry(pitch) Rx(roll): rho = R' dt, and the body's turn is the sum of the rates about the line that
    each angle turns about: omega = droll ex + Rx' dpitch ey + Rx' Ry' dyaw ez.
    """
    zero = np.zeros_like(six)
    roll, pitch = zero.copy(), zero.copy()
    roll[:, 3], pitch[:, 4] = six[:, 3], six[:, 4]
    Rx = frame_from_xyzrpy(roll)[:, :3, :3]
    Ry = frame_from_xyzrpy(pitch)[:, :3, :3]
    R = frame_from_xyzrpy(six)[:, :3, :3]
    jacobian = np.zeros((len(six), 6, 6))
    jacobian[:, :3, :3] = np.swapaxes(R, 1, 2)
    jacobian[:, 3, 3] = 1.0
    jacobian[:, 3:, 4] = np.swapaxes(Rx, 1, 2)[:, :, 1]
    jacobian[:, 3:, 5] = (np.swapaxes(Rx, 1, 2) @ np.swapaxes(Ry, 1, 2))[:, :, 2]
    return jacobian


def frame_columns(T: Array) -> dict[str, list[str]]:
    """Columns of frames (n, 4, 4) for a table: mm with six decimals, deg with eight."""
    six = xyzrpy_from_frame(T)
    columns = {f"{name}_mm": [f"{v:.6f}" for v in six[:, k] * 1000] for k, name in enumerate(SIX[:3])}
    columns.update({f"{name}_deg": [f"{v:.8f}" for v in np.degrees(six[:, k + 3])] for k, name in enumerate(SIX[3:])})
    return columns


def sigma_columns(T: Array, covariance: Array) -> dict[str, list[str]]:
    """Standard deviations of the six numbers of frames from the covariance (n, 6, 6) of their right perturbation."""
    jacobian = np.linalg.inv(twist_from_six(xyzrpy_from_frame(T)))
    variances = np.einsum("nij,njk,nik->ni", jacobian, covariance, jacobian)
    sigma = np.sqrt(np.clip(variances, 0, None)) * np.array([1000.0] * 3 + [180 / np.pi] * 3)
    names = [f"s{name}_{'mm' if k < 3 else 'deg'}" for k, name in enumerate(SIX)]
    return {name: [f"{v:.6g}" for v in sigma[:, k]] for k, name in enumerate(names)}
