"""Instruments in result.json, and what is told of them."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from robcal.calibration.instruments import IdentifiedInstruments, PlacedInstrument
from robcal.files.frame_tables import six_covariance
from robcal.files.poses_table import Poses
from robcal.transforms import Array, xyzrpy_from_frame


def instruments_result(
    found: IdentifiedInstruments, verified: Mapping[str, Mapping[str, Any]] | None = None
) -> dict[str, Any]:
    """Section `instruments` of result.json; ``verified`` : section `verification` of each that has one."""
    return {
        name: {
            "kind": placed.instrument.kind,
            "poses": len(placed.rows),
            "sigma0": placed.sigma0 if np.isfinite(placed.sigma0) else None,
            "world_T_base": _frame(placed.world_T_base, placed.covariance[:6, :6]),
            "flange_T_tool": _frame(placed.flange_T_tool, placed.covariance[6:, 6:]),
            "held": list(placed.held),
            "wire": _wire(placed.wire),
            "verification": (verified or {}).get(name),
        }
        for name, placed in found.placed.items()
    }


WIRE_UNITS = {"radius": ("radius_mm", 1e3), "stretch": ("ppm_per_m", 1e6), "scale": ("ppm", 1e6), "offset": ("mm", 1e3)}


def _wire(found: Mapping[str, tuple[float, float]]) -> dict[str, dict[str, float]]:
    """Identified parameters of a wire in the units of people, with their standard deviations."""
    out = {}
    for kind, (value, sigma) in found.items():
        if kind == "sag":  # the square of the mass a length is what is identified
            mass = float(np.sqrt(max(value, 0.0)))
            out["g_per_m"] = {"value": 1e3 * mass, "sigma": 1e3 * sigma / (2.0 * mass) if mass > 0 else float("inf")}
            continue
        name, unit = WIRE_UNITS[kind]
        out[name] = {"value": unit * value, "sigma": unit * sigma}
    return out


def _frame(T: Array, covariance: Array) -> dict[str, list[float]]:
    six = xyzrpy_from_frame(T)
    sigma = np.sqrt(np.clip(np.diag(six_covariance(T[None], covariance[None])[0]), 0.0, None))
    return {
        "xyz_mm": (1000.0 * six[:3]).tolist(),
        "rpy_deg": np.degrees(six[3:]).tolist(),
        "sigma_mm": (1000.0 * sigma[:3]).tolist(),
        "sigma_deg": np.degrees(sigma[3:]).tolist(),
    }


def instrument_notes(found: IdentifiedInstruments, poses: Poses) -> list[str]:
    """What was held, left out or reweighted, a sentence each."""
    notes = []
    for name, placed in found.placed.items():
        if placed.held:
            notes.append(f"instrument '{name}' does not tell {', '.join(placed.held)}: held")
        notes += [
            f"pose '{poses.names[int(k)]}' of instrument '{name}' contradicts all others and was left out"
            for k in placed.rows[~placed.used]
        ]
        notes += _scatter_note(name, placed)
    return notes


def _scatter_note(name: str, placed: PlacedInstrument) -> list[str]:
    if not placed.recording.stated or placed.variance == 1.0:
        return []
    return [
        f"instrument '{name}' scatters {placed.sigma0:.2f} times as much as it states (p = {placed.p_value:.1g}): it "
        "is weighted as it scatters"
    ]
