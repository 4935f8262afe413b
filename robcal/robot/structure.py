"""Which closed-form inverse a chain admits, read off its joint lines at zero position.

Parameter patterns (which frame has which offset) depend on how a file writes the robot; lines that meet or are parallel
do not. Deviations from the ideal structure up to a millimetre and a milliradian (rounded exports) are accepted: the
solutions found are then refined on the true chain.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from robcal.robot.chain import Chain
from robcal.transforms import Array

LENGTH_TOLERANCE = 1e-3
ANGLE_TOLERANCE = 1e-3

ArmKind = Literal["parallel_23", "meeting_12", "parallel_12"]


@dataclass(frozen=True)
class SphericalWrist:
    """Axes 4, 5, 6 meet in ``centre``; ``arm`` says how axes 1 to 3 place it. ``shoulder``: where axes 1, 2 meet."""

    centre: Array
    arm: ArmKind
    shoulder: Array | None


@dataclass(frozen=True)
class ParallelArm:
    """Axes 2, 3, 4 are parallel (UR-like) and axes 5, 6 meet in ``centre``."""

    centre: Array


Structure = SphericalWrist | ParallelArm | None


def parallel(a: Array, b: Array) -> bool:
    """Directions parallel or opposite within tolerance."""
    return float(np.linalg.norm(np.cross(a, b))) < ANGLE_TOLERANCE


def meeting_point(axes: Array, points: Array) -> Array | None:
    """The point in which lines (k, 3) meet within tolerance, None if they don't or are all parallel."""
    projectors = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    normal = projectors.sum(axis=0)
    if np.linalg.eigvalsh(normal)[0] < ANGLE_TOLERANCE**2:
        return None
    point = np.linalg.solve(normal, np.einsum("kij,kj->i", projectors, points))
    distances = np.linalg.norm(np.einsum("kij,kj->ki", projectors, point - points), axis=1)
    return point if float(distances.max()) < LENGTH_TOLERANCE else None


def find_structure(chain: Chain) -> Structure:
    """The closed-form structure of a chain of six rotary joints, None where only a numeric inverse is known."""
    if chain.n_joints != 6 or bool(np.any(chain.prismatic)) or chain.coupling is not None:
        return None
    w, p = chain.axes, chain.points
    if parallel(w[1], w[2]) and parallel(w[2], w[3]) and not parallel(w[0], w[1]):
        centre = meeting_point(w[4:], p[4:])
        if centre is not None and not parallel(w[3], w[4]) and _on_circle(w[0], p[0], centre):
            return ParallelArm(centre)
    centre = meeting_point(w[3:], p[3:])
    if centre is None or parallel(w[3], w[4]) or parallel(w[4], w[5]):
        return None
    if not _on_circle(w[2], p[2], centre):
        return None
    if parallel(w[1], w[2]) and not parallel(w[0], w[1]):
        return SphericalWrist(centre, "parallel_23", None)
    if parallel(w[0], w[1]):
        return None if parallel(w[1], w[2]) else SphericalWrist(centre, "parallel_12", None)
    shoulder = meeting_point(w[:2], p[:2])
    return SphericalWrist(centre, "meeting_12", shoulder) if shoulder is not None else None


def _on_circle(axis: Array, point: Array, moved: Array) -> bool:
    """Whether turning about the line moves the point at all."""
    return float(np.linalg.norm(np.cross(axis, moved - point))) > LENGTH_TOLERANCE
