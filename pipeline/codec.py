"""Typed results in one .npz file: frozen dataclasses of this project, arrays, plain values. No pickle.

The structure stands as JSON text beside the arrays; classes are looked up by name inside this project only.
"""

import dataclasses
import enum
import importlib
import io
import json
import math
import zipfile
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from robcal.errors import InvalidInput, RobcalError
from robcal.files.storage import write_atomic

_MODULES = ("robcal.", "pipeline.")
_STRUCTURE = "structure"


class StaleCache(RobcalError):
    """A cache file that cannot be read back: damaged, or written by another version."""


def encode(value: Any, arrays: dict[str, np.ndarray]) -> Any:
    """Plain JSON data of a value; arrays go into ``arrays`` by key."""
    if isinstance(value, enum.Enum):  # before str and int, which an enum may also be
        return {"$": "enum", "class": _class_name(type(value)), "value": encode(value.value, arrays)}
    if value is None or (isinstance(value, bool | str | int) and not isinstance(value, np.generic)):
        return value
    if isinstance(value, np.ndarray):
        if value.dtype == object:
            return {"$": "objects", "shape": list(value.shape), "items": [encode(v, arrays) for v in value.ravel()]}
        key = f"a{len(arrays)}"
        arrays[key] = value
        return {"$": "array", "key": key}
    if isinstance(value, np.generic):
        return encode(value.item(), arrays)
    if isinstance(value, float):
        return value if math.isfinite(value) else {"$": "float", "value": repr(value)}
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        fields = {f.name: encode(getattr(value, f.name), arrays) for f in dataclasses.fields(value) if f.init}
        return {"$": "dataclass", "class": _class_name(type(value)), "fields": fields}
    if isinstance(value, tuple):
        if hasattr(value, "_fields"):
            items = [encode(v, arrays) for v in value]
            return {"$": "namedtuple", "class": _class_name(type(value)), "items": items}
        return {"$": "tuple", "items": [encode(v, arrays) for v in value]}
    if isinstance(value, list):
        return [encode(v, arrays) for v in value]
    if isinstance(value, frozenset | set):
        return {"$": type(value).__name__, "items": [encode(v, arrays) for v in sorted(value, key=repr)]}
    if isinstance(value, Mapping):
        return {"$": "map", "items": [[encode(k, arrays), encode(v, arrays)] for k, v in value.items()]}
    if isinstance(value, Path):
        return {"$": "path", "value": str(value)}
    raise TypeError(f"a value of type {type(value).__qualname__} cannot be stored")


def _class_name(cls: type) -> str:
    if not cls.__module__.startswith(_MODULES):
        raise TypeError(f"{cls.__module__}.{cls.__qualname__} is not a type of this project")
    return f"{cls.__module__}:{cls.__qualname__}"


@cache
def _class(name: str) -> Any:
    module, _, path = name.partition(":")
    if not module.startswith(_MODULES):
        raise StaleCache(f"stored type {name} is not one of this project")
    target: Any = importlib.import_module(module)
    for step in path.split("."):
        target = getattr(target, step)
    return target


@cache
def _member(name: str, value: int | str) -> Any:
    return _class(name)(value)


def decode(data: Any, arrays: Mapping[str, np.ndarray]) -> Any:
    """Inverse of :func:`encode`; arrays come back read-only."""
    if isinstance(data, list):
        return [decode(item, arrays) for item in data]
    if not isinstance(data, dict):
        return data
    kind = data["$"]
    if kind == "enum" and isinstance(data["value"], int | str):  # thousands of reasons in an image
        return _member(data["class"], data["value"])
    if kind == "array":
        array = arrays[data["key"]]
        array.setflags(write=False)
        return array
    if kind == "float":
        return float(data["value"])
    if kind == "path":
        return Path(data["value"])
    if kind == "map":
        return {decode(k, arrays): decode(v, arrays) for k, v in data["items"]}
    if kind == "dataclass":
        return _class(data["class"])(**{name: decode(v, arrays) for name, v in data["fields"].items()})
    if kind == "enum":
        return _class(data["class"])(decode(data["value"], arrays))
    items = [decode(item, arrays) for item in data["items"]]
    if kind == "namedtuple":
        return _class(data["class"])(*items)
    if kind == "objects":
        out = np.empty(len(items), dtype=object)
        out[:] = items
        return out.reshape(data["shape"])
    return {"tuple": tuple, "set": set, "frozenset": frozenset}[kind](items)


def dumps(value: Any) -> bytes:
    """A value as the bytes of an .npz file; the same value gives the same bytes."""
    arrays: dict[str, np.ndarray] = {}
    structure = json.dumps(encode(value, arrays), separators=(",", ":"))
    arrays[_STRUCTURE] = np.frombuffer(structure.encode(), dtype=np.uint8)
    stream = io.BytesIO()
    _write_npz(stream, arrays)
    return stream.getvalue()


def _write_npz(stream: BinaryIO, arrays: Mapping[str, np.ndarray]) -> None:
    # numpy's own savez stamps the time of writing into the archive: results could not be compared by hash
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        for key, array in arrays.items():
            member = io.BytesIO()
            np.lib.format.write_array(member, np.asanyarray(array), allow_pickle=False)
            archive.writestr(zipfile.ZipInfo(f"{key}.npy", (1980, 1, 1, 0, 0, 0)), member.getvalue())


def save(path: Path, value: Any) -> None:
    """Write a value atomically."""
    data = dumps(value)
    write_atomic(path, lambda stream: stream.write(data))


def save_arrays(path: Path, arrays: Mapping[str, np.ndarray]) -> None:
    """Write named arrays as a plain .npz file, atomically."""
    write_atomic(path, lambda stream: _write_npz(stream, arrays))


def load(path: Path) -> Any:
    """Read a value back.

    Raises
    ------
    InvalidInput : there is no such file.
    StaleCache : it is damaged or of another version of the program.
    """
    if not path.exists():
        raise InvalidInput(f"{path}: no such result: run the stage that makes it first")
    try:
        with np.load(path, allow_pickle=False) as archive:
            arrays = {key: archive[key] for key in archive.files}
        structure = json.loads(arrays.pop(_STRUCTURE).tobytes().decode())
        return decode(structure, arrays)
    except (OSError, ValueError, KeyError, TypeError, AttributeError, ImportError, zipfile.BadZipFile) as error:
        reason = "damaged" if isinstance(error, zipfile.BadZipFile | OSError) or "pickle" in str(error) else str(error)
        raise StaleCache(f"{path}: cannot be read back ({reason}): run the campaign again") from None
