"""Ground rules of every YAML file: unknown keys are errors with the nearest known one, numbers are finite numbers.

A validation error becomes one sentence that names the file, the line, the entry and the remedy.
"""

import copy
import difflib
import functools
import math
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, TypeVar

from pydantic import BaseModel, BeforeValidator, ConfigDict, ValidationError, model_validator
from pydantic_core import ErrorDetails, PydanticCustomError

from robcal.errors import InvalidInput
from robcal.files.yaml_io import YamlDocument, read_yaml

MAX_TEXT = 1000
"""Characters of a name or path; longer ones are no names."""
LARGEST = 1e30
"""Numbers beyond are no quantity of any robot, and their squares overflow."""
MOST_ROUNDS = 12
"""How often an entry is left out and the rest looked at again."""

Place = tuple[int | str, ...]


def _number(value: Any) -> Any:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise ValueError(f"must be a number, found {shown(value)}")
    try:
        number = float(value)
    except OverflowError:
        raise ValueError("is too large for a number") from None
    if not math.isfinite(number):
        raise ValueError(f"must be a finite number, found {value}")
    if abs(number) > LARGEST:
        raise ValueError(f"must be a number below {LARGEST:g}, found {value}")
    return number


def _positive(value: Any) -> Any:
    if _number(value) <= 0:
        raise ValueError(f"must be larger than zero, found {value}")
    return float(value)


def _not_negative(value: Any) -> Any:
    if _number(value) < 0:
        raise ValueError(f"must not be negative, found {value}")
    return float(value)


def _whole(value: Any) -> Any:
    if isinstance(value, bool) or not isinstance(value, int):
        raise ValueError(f"must be a whole number, found {shown(value)}")
    if abs(value) > 2**53:
        raise ValueError("is too large for a whole number here")
    return value


def _text(value: Any) -> Any:
    if isinstance(value, int | float) and not isinstance(value, bool):
        return str(value)  # a name like 007 or 3 is text although YAML reads a number
    if not isinstance(value, str) or not value.strip():
        raise ValueError(f"must be text, found {shown(value)}")
    if len(value) > MAX_TEXT or not value.isprintable():
        raise ValueError(f"must be one line of at most {MAX_TEXT} printable characters, found {shown(value)}")
    return value


def shown(value: Any) -> str:
    """A value cut short for a message."""
    if value is None:
        return "nothing"
    text = repr(value)
    return text if len(text) <= 60 else text[:57] + "..."


Number = Annotated[float, BeforeValidator(_number)]
Positive = Annotated[float, BeforeValidator(_positive)]
NotNegative = Annotated[float, BeforeValidator(_not_negative)]
Whole = Annotated[int, BeforeValidator(_whole)]
Text = Annotated[str, BeforeValidator(_text)]
Triple = tuple[Number, Number, Number]


class Entry(BaseModel):
    """Base of all entries: frozen, strict, unknown keys refused with a proposal."""

    model_config = ConfigDict(extra="forbid", frozen=True, arbitrary_types_allowed=False)

    @model_validator(mode="before")
    @classmethod
    def _known_keys(cls, data: Any) -> Any:
        if isinstance(data, cls):
            return data
        if not isinstance(data, dict):
            raise ValueError(f"must be a mapping with the keys {', '.join(_names(cls))}, found {shown(data)}")
        known = _names(cls)
        for key in data:
            if key not in known:
                message = f"unknown key '{key}'{proposal(str(key), known)}"
                context = {"told": message, "key": str(key), "meant": nearest(str(key), known) or ""}
                raise PydanticCustomError("unknown_key", "{told}", context)
        return data


def _names(cls: type[BaseModel]) -> list[str]:
    return [info.alias or name for name, info in cls.model_fields.items()]


def nearest(word: str, known: list[str]) -> str | None:
    """The known word that is meant, None when none is near."""
    lowered = {name.lower(): name for name in known}
    near = difflib.get_close_matches(word.lower(), lowered, n=1, cutoff=0.6)
    return lowered[near[0]] if near else None


def proposal(word: str, known: list[str]) -> str:
    """Text that names the nearest known word, or all of them when none is near."""
    near = nearest(word, known)
    if near:
        return f": did you mean '{near}'?"
    listed = ", ".join(known[:30]) + (", ..." if len(known) > 30 else "")
    return f": known are {listed}" if known else ""


E = TypeVar("E", bound=Entry)


def parse(document: YamlDocument, schema: type[E], file_format: str) -> E:
    """The validated content of a document.

    Raises
    ------
    InvalidInput : wrong or missing ``format``, unknown key, wrong type; all problems in a sentence each.
    """
    entry, faults = parse_leniently(document, schema, file_format)
    if entry is None or faults:
        raise InvalidInput(faults[0], faults)
    return entry


def parse_leniently(document: YamlDocument, schema: type[E], file_format: str) -> tuple[E | None, list[str]]:
    """The content of a document as far as it can be read, and a sentence for every problem in it.

    A misspelt key is taken for the one that is meant, other entries that are wrong are left out; None where nothing
    is left to go on with.
    """
    faults: list[str] = []
    left_out: set[Place] = set()
    data = copy.deepcopy(document.data)
    found = data.get("format")
    if found != file_format:
        message = "is missing" if found is None else f"is {shown(found)}"
        return None, [f"{document.path}: 'format' {message}, this must be a file of the format '{file_format}'"]
    for _ in range(MOST_ROUNDS):
        try:
            return schema.model_validate(data), faults
        except ValidationError as error:
            problems = _problems(replace(document, data=data), error)
        faults += [
            text
            for problem, place, text in problems
            if text not in faults
            and not (problem["type"] == "missing" and (*place, problem["loc"][-1]) in left_out)  # told already
        ]
        left_out |= {_entry_of(place) for problem, place, _ in problems if problem["type"] != "unknown_key"}
        corrected = [_corrected(data, place, problem) for problem, place, _ in problems]
        if not all(corrected):
            break
    return None, faults


def _problems(document: YamlDocument, error: ValidationError) -> list[tuple[ErrorDetails, Place, str]]:
    """Problems of a validation error, each with its place and its sentence.

    An alternative (a | b) reports one problem for each branch; the deepest place is the branch that was meant.
    """
    found: list[tuple[ErrorDetails, Place, str]] = []
    for problem in sorted(error.errors(), key=lambda item: -len(_place(item["loc"], document))):
        place = _place(problem["loc"], document)
        if problem["type"] == "unknown_key" or all(other[: len(place)] != place for _, other, _ in found):
            found.append((problem, place, _sentence(document, problem, place)))
    return found


def _inside(data: Any, place: Place) -> Any:
    return functools.reduce(lambda inner, step: inner[step], place, data)


def _entry_of(place: Place) -> Place:
    """The entry with a key of its own that a place belongs to: a list goes as a whole."""
    while place and isinstance(place[-1], int):
        place = place[:-1]
    return place


def _corrected(data: dict[str, Any], place: Place, problem: ErrorDetails) -> bool:
    """Rename a misspelt key, or leave out the entry of a problem; false where that is not possible."""
    if problem["type"] == "unknown_key":
        holder = _inside(data, place)
        key, meant = problem["ctx"]["key"], problem["ctx"]["meant"]
        value = next((holder.pop(name) for name in list(holder) if str(name) == key), None)
        if meant and meant not in holder:
            holder[meant] = value
        return True
    place = _entry_of(place)
    if not place:
        return False
    _inside(data, place[:-1]).pop(place[-1], None)
    return True


def read_entry(path: Path, schema: type[E], file_format: str) -> tuple[E, YamlDocument]:
    """Read and validate a YAML file."""
    document = read_yaml(path)
    return parse(document, schema, file_format), document


def _sentence(document: YamlDocument, problem: ErrorDetails, place: Place) -> str:
    """One sentence about a problem, with file and line."""
    key = problem.get("ctx", {}).get("key") if problem["type"] == "unknown_key" else None
    line = document.line(place if key is None else (*place, key))
    where = f"{document.path}, line {line}" if line else f"{document.path}"
    name = _dotted(place)
    message = problem["msg"].removeprefix("Value error, ")
    if problem["type"] == "missing":
        missing = str(problem["loc"][-1])
        message = f"the entry '{missing}' is missing"
    elif problem["type"] in {"tuple_type", "list_type", "dict_type"} or problem["type"].startswith("too_"):
        message = f"{message[0].lower()}{message[1:]}, found {shown(problem['input'])}"
    elif problem["type"] == "literal_error":
        message = f"must be {problem['ctx']['expected']}, found {shown(problem['input'])}"
    return f"{where}: {name + ': ' if name else ''}{message}"


def _place(location: Place, document: YamlDocument) -> Place:
    """Pydantic's location without the names of union branches, which are no keys of the file."""
    place: list[int | str] = []
    data: Any = document.data
    for step in location:
        inside = step in data if isinstance(data, dict) else isinstance(data, list) and step in range(len(data))
        if inside:
            data = data[step]
            place.append(step)
    return tuple(place)


def _dotted(place: Place) -> str:
    text = ""
    for step in place:
        text += f"[{step}]" if isinstance(step, int) else f".{step}" if text else str(step)
    return text
