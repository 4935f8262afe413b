"""Causes that cannot be: signs, sizes, and effects of an instrument that it does not have."""

from collections.abc import Mapping
from typing import Any

POSITIVE = {"backlash": "width_deg", "hysteresis": "width_deg", "payload_mass": "mass_kg"}
"""Parameters that have a sign by nature."""
LARGEST = {
    "zero_jump": ("jump_deg", 0.3),
    "transmission_ratio": ("ratio_error_ppm", 3000.0),
    "base_tilt": ("tilt_deg", 3.0),
}
"""Sizes beyond which no robot that drives is wrong."""
COURSE = ("index", "order", "pose", "time_s", "hours")
"""Variables that belong to the course of the measurement and to no robot."""


def impossible(cause: Mapping[str, Any], *, moved: bool) -> str | None:
    """Why a cause of diagnosis.json cannot be, or None.

    Parameters
    ----------
    moved : the station really moved; else a cause that says so is one that cannot be.
    """
    name, parameters = str(cause["cause"]), cause.get("parameters") or {}
    where = f"{name} at {cause.get('where')}"
    sign, size = POSITIVE.get(name), LARGEST.get(name)
    if sign and float(parameters.get(sign, 1.0)) <= 0.0:
        return f"{where}: {sign} {parameters[sign]:.4g}"
    if size and abs(float(parameters.get(size[0], 0.0))) > size[1]:
        return f"{where}: {size[0]} {parameters[size[0]]:.4g}"
    if name in ("camera_moved", "base_moved") and not moved:
        return f"{where}, where nothing moved"
    if name == "refraction":
        return f"{where}, through a few metres of air"
    variables = ((parameters.get("term") or {}).get("variables")) or []
    if cause.get("stage") == "robot" and set(variables) & set(COURSE):
        return f"{where}: a robot's error over {', '.join(variables)}"
    insignificant = _weakest(parameters, cause.get("sigma") or {})
    return f"{where}: {insignificant}" if insignificant else None


def _weakest(parameters: Mapping[str, Any], sigma: Mapping[str, Any]) -> str | None:
    """A cause all of whose numbers are below their own sigma."""
    known = {
        k: (parameters[k], s) for k, s in sigma.items() if isinstance(s, (int, float)) and k in parameters and s > 0
    }
    if known and all(abs(float(value)) < s for value, s in known.values()):
        name, (value, s) = next(iter(known.items()))
        return f"{name} {value:.3g} +- {s:.3g}"
    return None
