"""Frames and loads as they stand in files: millimetres, degrees, kilograms."""

import math
from collections.abc import Mapping
from typing import Annotated, Any

import numpy as np
from pydantic import BeforeValidator

from robcal.files.robot_frames import listed, metres
from robcal.files.schemas import Entry, NotNegative, Triple
from robcal.files.yaml_io import FlowMapping
from robcal.robot.model import Payload
from robcal.transforms import Array, frame_from_xyzrpy, xyzrpy_from_frame


def _six(value: Any) -> Any:
    if isinstance(value, list) and len(value) == 6:
        return {"xyz_mm": value[:3], "rpy_deg": value[3:]}
    return value


class PlacementEntry(Entry):
    """A frame in a file: millimetres and degrees."""

    xyz_mm: Triple = (0.0, 0.0, 0.0)
    rpy_deg: Triple = (0.0, 0.0, 0.0)

    def matrix(self) -> Array:
        """The 4x4 frame in metres."""
        return frame_from_xyzrpy([v / 1000 for v in self.xyz_mm] + [math.radians(v) for v in self.rpy_deg])


Placement = Annotated[PlacementEntry, BeforeValidator(_six)]


def placement_data(a_T_b: Array) -> FlowMapping:
    """A frame as the mapping that stands in files."""
    six = xyzrpy_from_frame(a_T_b)
    return FlowMapping(xyz_mm=listed(six[:3] * 1000), rpy_deg=listed(np.degrees(six[3:])))


class PayloadEntry(Entry):
    """A load on the flange, in flange coordinates."""

    mass_kg: NotNegative
    cog_mm: Triple = (0.0, 0.0, 0.0)

    def payload(self) -> Payload:
        """The load in SI units."""
        return Payload(mass=self.mass_kg, cog=metres(self.cog_mm))


def payload_data(loads: Mapping[str, Payload]) -> dict[str, FlowMapping]:
    """Loads as they stand in files."""
    return {
        name: FlowMapping(mass_kg=float(load.mass), cog_mm=listed(np.asarray(load.cog) * 1000))
        for name, load in loads.items()
    }
