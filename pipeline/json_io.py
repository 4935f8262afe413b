"""JSON files written by this program, and the hash of plain data."""

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from robcal.errors import InvalidInput
from robcal.files.storage import write_text


def write_json(path: Path, data: Mapping[str, Any]) -> None:
    """Write JSON atomically; numbers that are not finite become null."""
    text = json.dumps(plain(data), indent=1, ensure_ascii=False, allow_nan=False)
    if any("\ud800" <= c <= "\udfff" for c in text):  # a file name in another encoding: only escapes bring it back
        text = json.dumps(plain(data), indent=1, allow_nan=False)
    write_text(path, text + "\n")


def read_json(path: Path) -> dict[str, Any]:
    """Read a JSON object written by this program.

    Raises
    ------
    InvalidInput : missing or damaged.
    """
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise InvalidInput(f"{path}: no such file: run the campaign first") from None
    except (OSError, ValueError) as error:
        raise InvalidInput(f"{path}: damaged ({error}): run the campaign again") from None
    if not isinstance(data, dict):
        raise InvalidInput(f"{path}: damaged: run the campaign again")
    return data


def plain(value: Any) -> Any:
    """Data that JSON can hold: numpy scalars and arrays to numbers and lists, not finite numbers to None."""
    if isinstance(value, Mapping):
        return {str(k): plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple | set | frozenset):
        return [plain(v) for v in value]
    if hasattr(value, "tolist"):
        return plain(value.tolist())
    if isinstance(value, float):
        return value if value == value and abs(value) != float("inf") else None
    if isinstance(value, Path):
        return str(value)
    return value


def fingerprint(*pieces: Any) -> str:
    """Hash of plain data."""
    text = json.dumps(plain(list(pieces)), sort_keys=True, default=str)
    return hashlib.sha256(text.encode()).hexdigest()
