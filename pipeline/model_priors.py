"""``model.priors`` of campaign.yaml: how far a robot's geometry is believed to be from its drawing."""

import math
from collections.abc import Mapping

from robcal.errors import InvalidInput
from robcal.files.schemas import proposal
from robcal.robot.model import RobotModel

LENGTHS, ANGLES = ("x", "y", "z"), ("roll", "pitch", "yaw")
UNITS = [(kind, "_mm") for kind in LENGTHS] + [(kind, "_deg") for kind in ANGLES]
ALL: Mapping[str, tuple[str, ...]] = {"lengths_mm": LENGTHS, "angles_deg": ANGLES}
"""Keys that stand for all parameters of these kinds."""


def model_priors(stated: Mapping[str, float], robot: RobotModel) -> dict[str, float]:
    """Standard deviations (m, rad) by parameter of a robot; single ones go before those of all.

    Parameters
    ----------
    stated : ``lengths_mm``, ``angles_deg``, or a parameter with its unit (``axis3.x_mm``, ``axis2.pitch_deg``).

    Raises
    ------
    InvalidInput : a key that is none of these, or names no length or angle of this robot; its first word is the key.
    """
    frames = [f.name for f in robot.frames]
    out: dict[str, float] = {}
    for key in sorted(stated, key=lambda k: k not in ALL):
        value = stated[key] * (1e-3 if key.endswith("_mm") else math.radians(1.0))
        if key in ALL:
            out |= {f"{frame}.{kind}": value for frame in frames for kind in ALL[key]}
            continue
        known = [
            f"{f}.{kind}_{unit}" for f in frames for unit, kinds in (("mm", LENGTHS), ("deg", ANGLES)) for kind in kinds
        ]
        if key not in known:
            raise InvalidInput(f"'{key}' is no length or angle of robot '{robot.name}'{proposal(key, [*ALL, *known])}")
        out[key.rpartition("_")[0]] = value
    return out
