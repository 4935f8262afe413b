"""Stewart platforms in a file (format robcal/hexapod-1): joints of base and platform, ranges and offsets of legs."""

from collections.abc import Iterator
from typing import Any, Literal

import numpy as np
from pydantic import Field

from robcal.files.placement import PayloadEntry, Placement, payload_data, placement_data
from robcal.files.robot_frames import listed
from robcal.files.schemas import Entry, Number, Text, Triple, proposal
from robcal.files.yaml_io import FlowMapping, YamlDocument
from robcal.robot.hexapod import legs_of
from robcal.robot.legs import LEG_KINDS, Leg, Legs, home_frame
from robcal.robot.model import Frame, RobotModel
from robcal.transforms import Array

FORMAT = "robcal/hexapod-1"
NAMES = tuple(f"leg{k}" for k in range(1, 7))
FLAT = 1e-3
"""Smallest over largest singular value of the legs' lines at home below which they do not hold the platform."""

Six = tuple[Triple, Triple, Triple, Triple, Triple, Triple]


class HexapodEntry(Entry):
    """The whole file."""

    format: Literal["robcal/hexapod-1"]
    name: Text
    base_mm: Six
    platform_mm: Six
    leg_mm: tuple[Number, Number]
    offsets_mm: tuple[Number, Number, Number, Number, Number, Number] = (0.0,) * 6
    home: Placement | None = None
    parameters: dict[str, Number] = Field(default_factory=dict)
    payloads: dict[str, PayloadEntry] = Field(default_factory=dict)
    world_T_base: Placement | None = None
    flange_T_tool: Placement | None = None


def hexapod_of(entry: HexapodEntry) -> RobotModel:
    """The robot of a file without :func:`hexapod_faults`."""
    legs = _legs(entry)
    limits = (entry.leg_mm[0] / 1000, entry.leg_mm[1] / 1000)
    return RobotModel(
        name=entry.name,
        frames=tuple(
            Frame(name, "z", prismatic=True, limits=limits, leg=leg) for name, leg in zip(NAMES, legs, strict=True)
        ),
        parameters=dict(entry.parameters),
        payloads={name: load.payload() for name, load in entry.payloads.items()},
        world_T_base=entry.world_T_base.matrix() if entry.world_T_base else None,
        flange_T_tool=entry.flange_T_tool.matrix() if entry.flange_T_tool else None,
        home=_home(entry, legs),
    )


def hexapod_faults(entry: HexapodEntry, document: YamlDocument) -> Iterator[str]:
    """A sentence for each contradiction in the file."""
    low, high = entry.leg_mm

    def where(key: str) -> str:
        return f"{document.path}, line {document.line((key,))}: {key}"

    if not 0.0 < low < high:
        yield f"{where('leg_mm')} [{low:g}, {high:g}] is no range of lengths: the smaller one, above zero, comes first"
        return
    for key, points in (("base_mm", entry.base_mm), ("platform_mm", entry.platform_mm)):
        gaps = np.linalg.norm(np.subtract(points, np.mean(points, axis=0)), axis=1)
        if np.max(gaps) < 1.0:
            yield f"{where(key)}: all six points are the same: give the joints of the six legs, in their order"
            return
    legs = _legs(entry)
    arrays = Legs.of(legs, _home(entry, legs))
    lengths = 1000 * arrays.lengths(arrays.home[None])[0]
    k = int(np.argmax(np.maximum(low - lengths, lengths - high)))
    if not low - 1e-6 <= lengths[k] <= high + 1e-6:
        yield (
            f"{where('leg_mm')}: at home leg {k + 1} would be {lengths[k]:.1f} mm long, beyond {low:g} to {high:g} mm: "
            "correct the points, the range, or state 'home' (the frame of the platform in the base)"
        )
        return
    A = arrays.linearised(arrays.home[None], arrays.lengths(arrays.home[None]))[1][0]
    values = np.linalg.svd(A / np.array([1.0] * 3 + [arrays.size] * 3), compute_uv=False)
    if values[-1] < FLAT * values[0]:
        yield (
            f"{where('platform_mm')}: at home the six legs do not hold the platform (their lines are dependent): check "
            "the order of the points, or state another 'home'"
        )
    known = ["base", "tool", *NAMES]
    for name in entry.parameters:
        owner, _, kind = name.rpartition(".")
        kinds = ["offset", *LEG_KINDS] if owner in NAMES else ["x", "y", "z", "roll", "pitch", "yaw"]
        at = f"{document.path}, line {document.line(('parameters', name))}: parameter '{name}'"
        if owner not in known:
            yield f"{at}: there is no '{owner}'{proposal(owner, known)}"
        elif kind not in kinds:
            yield f"{at}: unknown kind '{kind}'{proposal(kind, kinds)}"


def _legs(entry: HexapodEntry) -> list[Leg]:
    points = zip(entry.base_mm, entry.platform_mm, entry.offsets_mm, strict=True)
    return [
        Leg((b[0] / 1000, b[1] / 1000, b[2] / 1000), (p[0] / 1000, p[1] / 1000, p[2] / 1000), o / 1000)
        for b, p, o in points
    ]


def _home(entry: HexapodEntry, legs: list[Leg]) -> Array:
    return entry.home.matrix() if entry.home is not None else home_frame(legs, sum(entry.leg_mm) / 2000)


def hexapod_data(model: RobotModel) -> dict[str, Any]:
    """The file's content as plain data."""
    legs = legs_of(model)
    low, high = model.frames[0].limits or (0.0, 0.0)
    data: dict[str, Any] = {
        "format": FORMAT,
        "name": model.name,
        "base_mm": [listed(p * 1000) for p in legs.base],
        "platform_mm": [listed(p * 1000) for p in legs.platform],
        "leg_mm": listed(np.array([low, high]) * 1000),
        "offsets_mm": listed(legs.offset * 1000),
        "home": placement_data(legs.home),
        "parameters": FlowMapping() if not model.parameters else {n: float(v) for n, v in model.parameters.items()},
    }
    if model.payloads:
        data["payloads"] = payload_data(model.payloads)
    for key, frame in (("world_T_base", model.world_T_base), ("flange_T_tool", model.flange_T_tool)):
        if frame is not None:
            data[key] = placement_data(frame)
    return data
