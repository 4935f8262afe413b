"""Sizes that deviations of robots usually have: the measure of priors, steps, and doubts about what is held."""

from collections.abc import Mapping, Sequence

import numpy as np

from robcal.physics.cause import Array
from robcal.robot.terms import identifier

DEVIATION = 1e-3
"""m or rad."""
DEFLECTION = 3e-4
"""rad under the largest load of a recording."""
LEAST_MOMENT = 0.1
"""N m; what stays below it carries no load."""


def prior_scale(name: str, variables: Mapping[str, Array]) -> float:
    """Usual size of a deviation (m, rad), or of an elasticity (rad/(N m)) by the deflection under the largest load.

    Zero for anything else (loads, gravity, amplitudes), and for elasticities without a load.
    """
    frame, _, kind = name.rpartition(".")
    if not kind.startswith("elastic_"):
        geometric = kind in ("x", "y", "z", "roll", "pitch", "yaw") and not frame.startswith("payload.")
        return DEVIATION if geometric else 0.0
    moment = variables.get(f"{identifier(frame)}_m{kind.removeprefix('elastic_')}")
    largest = 0.0 if moment is None else float(np.max(np.abs(moment)))
    return DEFLECTION / largest if largest > LEAST_MOMENT else 0.0


def prior_scales(names: Sequence[str], variables: Mapping[str, Array]) -> Array:
    """The same for many names (p,)."""
    return np.array([prior_scale(name, variables) for name in names])
