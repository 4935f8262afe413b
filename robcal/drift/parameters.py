"""Which parameters of a robot drift with its temperature, by how much, and which of them a tour can tell."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from robcal.robot.model import ANGLE_OF_AXIS, RobotModel

if TYPE_CHECKING:
    from robcal.drift.reference import DriftReference, Readings

EXPANSION = 1.2e-5
"""1/K; steel and cast iron; light alloys have twice as much."""
WARMING = 30.0
"""K; from a cold to a warm robot."""
LEAST_LENGTH = 5e-5
"""m; housings grow also where the nominal offset is short."""
ANGLE = 2.6e-4
"""rad; a gear that warms unevenly turns its link by about 0.015 deg."""
TILT = 1.3e-4
"""rad; a casting that warms unevenly bends by less."""
TOLD = 0.9
"""A parameter counts as told by a tour if its standard deviation falls below this share of its expected change."""


def thermal_sizes(model: RobotModel) -> dict[str, float]:
    """Expected thermal changes (m, rad): offsets of the chain, zero offsets and tilts of the joints.

    Castings that warm unevenly bend, which tilts the joint that they carry. Elasticities hardly depend on the
    temperature and stay. A tilt about a line along which the next joint lies parallel acts like its zero offset; which
    of the two stays is a matter of the choice below.
    """
    sizes: dict[str, float] = {}
    for frame in model.frames:
        reach = math.hypot(*frame.xyz)
        for kind, length in zip("xyz", frame.xyz, strict=True):
            if reach > 1e-3:  # along the casting it grows, across it bends
                across = 0.5 * TILT * math.sqrt(max(reach**2 - length**2, 0.0))
                sizes[f"{frame.name}.{kind}"] = max(EXPANSION * WARMING * abs(length), across, LEAST_LENGTH)
        for kind in ("roll", "pitch", "yaw"):
            if frame.axis is not None:
                own = not frame.prismatic and kind == ANGLE_OF_AXIS[frame.axis]
                sizes[f"{frame.name}.{kind}"] = ANGLE if own else TILT
    return sizes


def choose_parameters(reference: DriftReference, tour: Readings, required: bool) -> NDArray[np.intp]:
    """Rows of the reference's parameters that one tour can tell.

    The worst one is left out until all are told: of two that act alike one stays. With ``required`` only parameters
    that the tour does not feel at all are left out.
    """
    slots = np.arange(len(tour))
    _, A, R = reference.displacements(tour, slots, np.zeros(len(reference.names)))
    spread = R @ tour.covariance @ np.swapaxes(R, 1, 2) + reference.covariance
    white = np.linalg.solve(np.linalg.cholesky(spread), A * reference.sizes).reshape(-1, len(reference.names))
    kept = np.flatnonzero(np.linalg.norm(white, axis=0) > 1.0)
    while len(kept) and not required:
        part = white[:, kept]
        covariance = np.linalg.inv(part.T @ part + np.eye(len(kept)))
        share = np.sqrt(np.diag(covariance))
        if share.max() <= TOLD:
            break
        kept = np.delete(kept, int(np.argmax(share)))
    return kept
