"""robot.yaml (format robcal/robot-1 or robcal/hexapod-1): nominal and calibrated robots, read and written without loss.

Beside the contract's keys a calibrated robot may hold ``terms`` (extra physical terms found by the diagnosis),
``payloads`` and the reference frames ``world_T_base`` and ``flange_T_tool``.
"""

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Literal

from pydantic import Field

from robcal.errors import InvalidInput
from robcal.files.hexapod_file import FORMAT as HEXAPOD
from robcal.files.hexapod_file import HexapodEntry, hexapod_data, hexapod_faults, hexapod_of
from robcal.files.placement import PayloadEntry, Placement, payload_data, placement_data
from robcal.files.robot_frames import FrameEntry, chain_frames, frame_data, frame_faults
from robcal.files.schemas import Entry, Number, Text, Triple, parse, proposal
from robcal.files.storage import write_text
from robcal.files.yaml_io import YamlDocument, read_yaml, yaml_text
from robcal.robot.loops import FOUR_BAR_KINDS
from robcal.robot.model import RESERVED_FRAME_NAMES, RobotModel, Term

FORMAT = "robcal/robot-1"
STANDARD_GRAVITY = (0.0, 0.0, -9.80665)


class TermEntry(Entry):
    """An extra physical term: the value of ``expression`` is added to the named angle or offset of a frame."""

    name: Text
    frame: Text
    kind: Literal["q", "roll", "pitch", "yaw", "x", "y", "z"]
    expression: Text
    parameters: dict[str, Number] = Field(default_factory=dict)
    units: dict[str, str] = Field(default_factory=dict)
    priors: dict[str, Number] = Field(default_factory=dict)
    cause: str | None = None


class RobotEntry(Entry):
    """The whole file."""

    format: Literal["robcal/robot-1"]
    name: Text
    gravity_m_s2: Triple = STANDARD_GRAVITY
    gravity_frame: Literal["base", "world"] = "base"
    frames: list[FrameEntry]
    parameters: dict[str, Number] = Field(default_factory=dict)
    terms: list[TermEntry] = Field(default_factory=list)
    payloads: dict[str, PayloadEntry] = Field(default_factory=dict)
    world_T_base: Placement | None = None
    flange_T_tool: Placement | None = None


def read_robot(path: Path | str) -> RobotModel:
    """Read a robot: a chain (robcal/robot-1) or a Stewart platform (robcal/hexapod-1).

    Raises
    ------
    InvalidInput : the file contradicts the contract; the message names line and remedy.
    """
    document = read_yaml(Path(path))
    if document.data.get("format") == HEXAPOD:
        platform = parse(document, HexapodEntry, HEXAPOD)
        faults = list(hexapod_faults(platform, document))
        if faults:
            raise InvalidInput(faults[0], faults)
        return hexapod_of(platform)
    entry = parse(document, RobotEntry, FORMAT)
    faults = list(_faults(entry, document))
    if faults:
        raise InvalidInput(faults[0], faults)
    return RobotModel(
        name=entry.name,
        frames=chain_frames(entry.frames),
        gravity=entry.gravity_m_s2,
        gravity_frame=entry.gravity_frame,
        parameters=dict(entry.parameters),
        terms=tuple(
            Term(t.name, t.frame, t.kind, t.expression, dict(t.parameters), dict(t.units), dict(t.priors), t.cause)
            for t in entry.terms
        ),
        payloads={name: load.payload() for name, load in entry.payloads.items()},
        world_T_base=entry.world_T_base.matrix() if entry.world_T_base else None,
        flange_T_tool=entry.flange_T_tool.matrix() if entry.flange_T_tool else None,
    )


def _faults(entry: RobotEntry, document: YamlDocument) -> Iterator[str]:
    """A sentence for each contradiction in the file."""
    names = [frame.name for frame in entry.frames]
    for i, frame in enumerate(entry.frames):
        where = f"{document.path}, line {document.line(('frames', i))}: frame '{frame.name}'"
        if names.index(frame.name) != i:
            yield f"{where} stands twice: give every frame its own name"
        if frame.name in {*RESERVED_FRAME_NAMES, "world"} or "." in frame.name:
            yield (
                f"{where}: a frame's name must have no dot and not be base, tool, gravity, payload or world: "
                "it is the first half of parameter names"
            )
    yield from frame_faults(entry.frames, document)
    if not any(frame.axis for frame in entry.frames):
        yield f"{document.path}: the chain has no joints: at least one frame needs an axis (x, y or z)"
    size = math.dist(entry.gravity_m_s2, (0, 0, 0))
    if size > 30:
        yield (
            f"{document.path}, line {document.line(('gravity_m_s2',))}: gravity of {size:.4g} m/s2 is not of this "
            "world: it is in m/s2, about 9.81"
        )
    kinds = {f.name: [*_FRAME_KINDS, *(FOUR_BAR_KINDS if f.fourbar else ())] for f in entry.frames}
    known_terms = {term.name for term in entry.terms}
    for key in entry.parameters:
        yield from _parameter_faults(key, kinds, known_terms, set(entry.payloads), document)
    for i, term in enumerate(entry.terms):
        if term.frame not in {*names, "base", "tool"}:
            yield (
                f"{document.path}, line {document.line(('terms', i, 'frame'))}: term '{term.name}' acts on the unknown "
                f"frame '{term.frame}'{proposal(term.frame, [*names, 'base', 'tool'])}"
            )


_KINDS = ["x", "y", "z", "roll", "pitch", "yaw"]
_FRAME_KINDS = [*_KINDS, "elastic_roll", "elastic_pitch", "elastic_yaw"]


def _parameter_faults(
    key: str, frames: dict[str, list[str]], terms: set[str], payloads: set[str], document: YamlDocument
) -> Iterator[str]:
    owner, _, kind = key.rpartition(".")
    where = f"{document.path}, line {document.line(('parameters', key))}: parameter '{key}'"
    if owner in terms:
        return
    if owner.startswith("payload."):
        if owner.removeprefix("payload.") not in payloads or kind not in {"mass", "x", "y", "z"}:
            yield f"{where} names no payload of this file: payload.<name>.mass, x, y or z"
        return
    known = {"base": _KINDS, "tool": _KINDS, "gravity": ["tilt_x", "tilt_y"], **frames}
    if owner not in known:
        yield f"{where}: there is no frame '{owner}'{proposal(owner, list(known))}"
    elif kind not in known[owner]:
        yield f"{where}: unknown kind '{kind}'{proposal(kind, known[owner])}"


def robot_data(model: RobotModel) -> dict[str, Any]:
    """The file's content as plain data."""
    if model.is_hexapod:
        return hexapod_data(model)
    data: dict[str, Any] = {"format": FORMAT, "name": model.name, "gravity_m_s2": [float(v) for v in model.gravity]}
    if model.gravity_frame != "base":
        data["gravity_frame"] = model.gravity_frame
    data["frames"] = frame_data(model.frames)
    data["parameters"] = {name: float(value) for name, value in model.parameters.items()}
    if model.terms:
        data["terms"] = [_term_data(term) for term in model.terms]
    if model.payloads:
        data["payloads"] = payload_data(model.payloads)
    if model.world_T_base is not None:
        data["world_T_base"] = placement_data(model.world_T_base)
    if model.flange_T_tool is not None:
        data["flange_T_tool"] = placement_data(model.flange_T_tool)
    return data


def _term_data(term: Term) -> dict[str, Any]:
    data: dict[str, Any] = {
        "name": term.name,
        "frame": term.frame,
        "kind": term.kind,
        "expression": term.expression,
        "parameters": {k: float(v) for k, v in term.parameters.items()},
    }
    if term.units:
        data["units"] = dict(term.units)
    if term.priors:
        data["priors"] = {k: float(v) for k, v in term.priors.items()}
    if term.cause:
        data["cause"] = term.cause
    return data


def robot_text(model: RobotModel, comment: str = "") -> str:
    """The text of a robot file."""
    return yaml_text(robot_data(model), comment)


def write_robot(path: Path | str, model: RobotModel, comment: str = "") -> None:
    """Write a robot atomically; reading it back gives the same model."""
    write_text(Path(path), robot_text(model, comment))
