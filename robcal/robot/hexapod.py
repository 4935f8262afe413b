"""A Stewart platform's own kinematics, nominal or with its deviations, and what a chain and it have in common."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from robcal.errors import InvalidInput
from robcal.robot.chain import chain_of, forward
from robcal.robot.legs import LEG_KINDS, Leg, Legs
from robcal.robot.model import RobotModel
from robcal.transforms import Array


def legs_of(model: RobotModel, calibrated: bool = False) -> Legs:
    """The six legs of a Stewart platform, ``calibrated`` with their deviations.

    Raises
    ------
    InvalidInput : the robot is a chain.
    """
    if not model.is_hexapod or model.home is None:
        raise InvalidInput(f"robot '{model.name}' is a chain of joints, no Stewart platform")
    legs = []
    for f in model.frames:
        if f.leg is None:
            continue
        off = [model.parameters.get(f"{f.name}.{k}", 0.0) if calibrated else 0.0 for k in (*LEG_KINDS, "offset")]
        bx, by, bz = (float(v) for v in np.add(f.leg.base, off[:3]))
        px, py, pz = (float(v) for v in np.add(f.leg.platform, off[3:6]))
        legs.append(Leg((bx, by, bz), (px, py, pz), f.leg.offset + off[6]))
    return Legs.of(legs, model.home)


def nominal_frames(model: RobotModel, q: ArrayLike, strict: bool = True) -> Array:
    """Nominal base_T_flange (n, 4, 4) of a chain or a Stewart platform at joint values or leg lengths (n, N).

    Raises
    ------
    InvalidInput : no position of a platform has the lengths, where that is asked for (``strict``); the message names
        the row.
    """
    if not model.is_hexapod:
        return forward(chain_of(model), q)
    T, found = legs_of(model).forward(np.atleast_2d(np.asarray(q, dtype=float)))
    if strict and not np.all(found):
        raise InvalidInput(f"row {int(np.argmin(found)) + 1}: no position of the platform has these leg lengths")
    return T


@dataclass(frozen=True)
class LegCommands:
    """Leg lengths for n wanted frames of the platform.

    Attributes
    ----------
    q : (n, 6) indicated lengths, m, NaN where not reachable; reachable (n,); reason (n) in words, None if reachable.
    """

    q: Array
    reachable: NDArray[np.bool_]
    reason: tuple[str | None, ...]


def leg_commands(model: RobotModel, base_T_platform: Array, calibrated: bool = True) -> LegCommands:
    """Closed-form inverse within the legs' ranges; extra terms are not in it."""
    q = legs_of(model, calibrated).lengths(base_T_platform)
    limits = np.array([f.limits if f.limits is not None else (0.0, np.inf) for f in model.frames])
    beyond = np.maximum(limits[:, 0] - q, q - limits[:, 1])
    reasons: list[str | None] = []
    for row, over in zip(q, beyond, strict=True):
        k = int(np.argmax(over))
        side = "below its lower" if row[k] < limits[k, 0] else "above its upper"
        reasons.append(
            f"{model.frames[k].name} would be {1e3 * over[k]:.2f} mm {side} limit" if over[k] > 1e-9 else None
        )
    reachable = np.array([reason is None for reason in reasons], dtype=bool)
    return LegCommands(np.where(reachable[:, None], q, np.nan), reachable, tuple(reasons))
