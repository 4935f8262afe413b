"""Command program: a program of a robot controller corrected in place for the calibrated robot."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np

from pipeline.robot_in_force import robot_in_force
from robcal.calibration.calibrated import with_folded_cell
from robcal.errors import InvalidInput
from robcal.files.cell_files import read_placed
from robcal.files.schemas import proposal
from robcal.files.storage import read_bytes, write_atomic
from robcal.files.yaml_io import read_yaml
from robcal.programs.correction import Corrected, GivenFrames, correct
from robcal.programs.dialects import dialect_of, read_program
from robcal.programs.text import Source
from robcal.robot.kernel_cache import kernel_of
from robcal.transforms import Array, frame_from_xyzrpy

MAX_BYTES = 50_000_000


def correct_program(  # noqa: PLR0913 - options by keyword
    folder: Path,
    program: Path,
    out: Path,
    *,
    tools: Sequence[str] = (),
    bases: Sequence[str] = (),
    robot_base: bool = False,
    dialect: str | None = None,
    payload: str | None = None,
    instrument: str | None = None,
    at_cycle: int | None = None,
) -> dict[str, Any]:
    """Write the program with all its targets corrected; of KRL with the `.dat` beside it.

    Parameters
    ----------
    tools, bases : `NAME=FILE`, results of `pipeline cell`.

    Raises
    ------
    InvalidInput : something in the program cannot be corrected right; nothing is written.
    """
    robot = robot_in_force(folder, at_cycle, instrument)
    if payload is not None and payload not in robot.model.payloads:
        raise InvalidInput(f"{folder}: there is no payload '{payload}'{proposal(payload, list(robot.model.payloads))}")
    language = dialect_of(program.suffix, dialect)
    source, data = _source(program), _data_file(program) if language == "krl" else None
    places = [out] if data is None else [out, _beside(out, data)]
    for place, given_file in zip(places, [program, data or program], strict=False):
        if place.resolve() == given_file.resolve():
            raise InvalidInput(f"{place}: is the program itself: choose another file with --out, it is kept as it is")
    read = read_program(language, source, None if data is None else _source(data))
    given = GivenFrames(_frames(tools, "tool"), _frames(bases, "base"), robot_base)
    found = correct(
        read,
        kernel_of(with_folded_cell(robot.model), robot.statics),
        given,
        payload=payload,
        covariates=robot.defaults,
        near=None if robot.q is None else robot.q[0],
    )
    if not found.joints and not found.frames:
        raise InvalidInput(
            f"{program}: no motion to a target was found, there is nothing to correct and nothing was written: is it "
            f"the file with the motions, and a program of {language} (--dialect)?"
        )
    for place, text in reversed(list(zip(places, found.texts, strict=True))):  # the program last: it uses the data
        write_atomic(place, lambda stream, content=text: stream.write(content.encode("latin-1")))  # type: ignore[misc]
    return _answer(found, program, places, payload, list(robot.model.payloads))


def _answer(
    found: Corrected, program: Path, places: Sequence[Path], payload: str | None, payloads: Sequence[str]
) -> dict[str, Any]:
    warnings = list(found.notes)
    if payload is None and payloads:
        warnings.append(f"corrected for the robot without payload: name what it carries with --payload ({payloads[0]})")
    before, remaining = (1e3 * np.linalg.norm(t[:, :3], axis=1) for t in (found.before, found.remaining))
    return {
        "targets": found.joints + found.frames,
        "joint_targets": found.joints,
        "cartesian_targets": found.frames,
        "out": [str(place) for place in places],
        "uncorrected_mean_mm": float(before.mean()) if len(before) else 0.0,
        "uncorrected_max_mm": float(before.max(initial=0.0)),
        "remaining_max_mm": float(remaining.max(initial=0.0)),
        "warnings": warnings,
    }


def _source(path: Path) -> Source:
    return Source(str(path), read_bytes(path, MAX_BYTES).decode("latin-1"))


def _data_file(program: Path) -> Path | None:
    """The `.dat` beside a `.src`, however its suffix is spelt."""
    for suffix in (".dat", ".DAT", ".Dat"):
        if (path := program.with_suffix(suffix)).is_file():
            return path
    return None


def _beside(out: Path, data: Path) -> Path:
    return out.with_suffix(data.suffix)


def _placed(path: Path, key: Literal["flange_T_tool", "base_T_object"]) -> Array:
    """The frame in a result of the cell, or in a YAML file that holds nothing but it."""
    document = read_yaml(path)
    alone = document.data.get(key)
    if "format" in document.data or not isinstance(alone, dict):
        return read_placed(path, key).T
    six = []
    for name, scale in (("xyz_mm", 1e-3), ("rpy_deg", np.pi / 180)):
        values = alone.get(name, [0.0, 0.0, 0.0])
        numbers = isinstance(values, list) and all(isinstance(v, int | float) and np.isfinite(v) for v in values)
        if not numbers or len(values) != 3:
            line = document.line((key, name))
            raise InvalidInput(f"{path}, line {line}: {key}.{name} must be three numbers")
        six += [scale * float(v) for v in values]
    return frame_from_xyzrpy(six)


def _frames(options: Sequence[str], what: str) -> dict[str, Array]:
    """Frames of `NAME=FILE` options by name."""
    found: dict[str, Array] = {}
    for option in options:
        name, equals, path = option.partition("=")
        if not equals or not name.strip() or not path:
            raise InvalidInput(f"--{what} is NAME=FILE (a result of 'pipeline cell'), not '{option}'")
        if name.strip() in found:
            raise InvalidInput(f"--{what} {name.strip()} is given twice: give one file")
        found[name.strip()] = _placed(Path(path), "flange_T_tool" if what == "tool" else "base_T_object")
    return found
