"""Tables of other programs: other separators, decimal commas, headings, units and orientations, by a map of columns.

A map names for each column of the project's own (``x_mm``, ``q1_deg``) the heading, or the number from 1, of the
column that holds it. Where the unit differs, the own name says so: ``x_m``, ``q1_rad`` become ``x_mm``, ``q1_deg``.
"""

import csv
import io
import math
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np

from robcal.errors import InvalidInput
from robcal.files.schemas import proposal
from robcal.files.storage import read_bytes
from robcal.files.tables import MAX_BYTES, MAX_ROWS, MOST_REPORTED, FaultyRows, Table
from robcal.transforms import Array, exp_so3, rotation_from_rpy, rpy_from_rotation

Orientation = Literal["rpy", "intrinsic_zyx", "abc", "quaternion", "rotation_vector"]
ROW_NUMBER = "#"
"""In place of a heading: the number of the row."""
SEPARATORS = {"tab": "\t", "space": " ", "\\t": "\t"}

_UNITS = {"m": ("mm", 1e3), "um": ("mm", 1e-3), "cm": ("mm", 10.0), "in": ("mm", 25.4), "rad": ("deg", 180.0 / math.pi)}
_UNITS["mrad"] = ("deg", 0.18 / math.pi)
_QUATERNION = ("qw", "qx", "qy", "qz")
_ROTATION_VECTOR = ("rx_deg", "ry_deg", "rz_deg")
_ABC = ("a_deg", "b_deg", "c_deg")


@dataclass(frozen=True)
class TableMap:
    """How to read a table of another program.

    Attributes
    ----------
    columns : own name -> heading, number of the column from 1, or '#' (number of the row).
    sep : separator of columns, one character, 'tab' or 'space' (any number of blanks). decimal : '.' or ','.
    skip_rows : rows in front of the headings. header : whether there are headings.
    orientation : what the angles of frames mean. ``rpy``: about the fixed axes x, y, z in this order, which is the same
        as about the moving axes z, y, x (``intrinsic_zyx``); ``abc``: KUKA's A about z, B about y, C about x;
        ``quaternion``: columns qw, qx, qy, qz; ``rotation_vector``: axis times angle, rx_deg, ry_deg, rz_deg.
    """

    columns: Mapping[str, str] = field(default_factory=dict)
    sep: str = ","
    decimal: Literal[".", ","] = "."
    skip_rows: int = 0
    header: bool = True
    orientation: Orientation = "rpy"


def read_mapped_table(path: Path, use: TableMap) -> Table:
    """A table of another program under the project's own names and units.

    Raises
    ------
    InvalidInput : not such a table, a heading that it does not have, an orientation that lacks columns.
    FaultyRows : rows of another length, or text where a number is converted.
    """
    sep = SEPARATORS.get(use.sep, use.sep)
    if sep == use.decimal:
        raise InvalidInput(f"{path}: separator and decimal mark are both '{sep}': state 'sep' and 'decimal'")
    headings, records, rows = _records(path, use, sep)
    width = len(headings)
    ragged = [k for k, record in enumerate(records) if len(record) != width]
    kept = [k for k, record in enumerate(records) if len(record) == width]
    theirs = {name: tuple(records[k][i] for k in kept) for i, name in enumerate(headings)}
    numbers = np.array([rows[k] for k in kept], dtype=np.int64)
    table = _units(_renamed(Table(path, theirs, numbers), headings, use), use.decimal)
    table = _oriented(table, use.orientation)
    if ragged:
        faults = [
            f"{path}, row {rows[k]}: has {len(records[k])} cells where there are {width} columns: check 'sep' and "
            "'decimal'"
            for k in ragged[:MOST_REPORTED]
        ]
        raise FaultyRows(faults, table)
    return table


def _text(path: Path) -> str:
    raw = read_bytes(path, MAX_BYTES)
    if raw[:2] in (b"\xff\xfe", b"\xfe\xff"):
        return raw.decode("utf-16", errors="replace")
    try:
        return raw.decode("utf-8-sig")
    except UnicodeDecodeError:
        return raw.decode("cp1252", errors="replace")  # what Windows programs write for degree signs


def _records(path: Path, use: TableMap, sep: str) -> tuple[list[str], list[list[str]], list[int]]:
    """Headings, rows of cells without blank ones, and their row numbers."""
    text = _text(path)
    if sep == " ":
        lines = [(row, line.split()) for row, line in enumerate(text.splitlines(), start=1)]
    else:
        try:
            reader = csv.reader(io.StringIO(text, newline=""), delimiter=sep)
            lines = [(reader.line_num, record) for record in reader]
        except csv.Error as error:
            raise InvalidInput(f"{path}: not a table: {error}") from None
    if len(lines) > MAX_ROWS:
        raise InvalidInput(f"{path}: has more than {MAX_ROWS} rows: split it into campaigns")
    cells = [(row, [cell.strip() for cell in record]) for row, record in lines if row > use.skip_rows]
    filled = [(row, record) for row, record in cells if any(record)]
    if not filled:
        raise InvalidInput(f"{path}: is empty after {use.skip_rows} skipped rows")
    first = filled[0][1]
    while use.header and first and not first[-1]:
        first.pop()
    headings = [cell or f"column {i + 1}" for i, cell in enumerate(first)]
    if not use.header:
        headings = [f"column {i + 1}" for i in range(len(first))]
    twice = next((name for i, name in enumerate(headings) if headings.index(name) != i), None)
    if twice is not None:
        headings = [name if headings.index(name) == i else f"{name} ({i + 1})" for i, name in enumerate(headings)]
    data = filled[1:] if use.header else filled
    trimmed = [(row, record[: len(headings)] if not any(record[len(headings) :]) else record) for row, record in data]
    return headings, [record for _, record in trimmed], [row for row, _ in trimmed]


def _renamed(table: Table, headings: list[str], use: TableMap) -> Table:
    """Own names for the mapped columns; the others keep theirs."""
    columns: dict[str, tuple[str, ...]] = {}
    taken: set[str] = set()
    faults: list[str] = []
    for own, given in use.columns.items():
        if given == ROW_NUMBER:
            columns[own] = tuple(str(k) for k in range(1, len(table) + 1))
            continue
        heading = given
        if heading not in headings and given.isdigit() and 0 < int(given) <= len(headings):
            heading = headings[int(given) - 1]
        if heading not in headings:
            faults.append(f"{table.path}: there is no column '{given}' for {own}{proposal(given, headings)}")
            continue
        columns[own] = table.columns[heading]
        taken.add(heading)
    if faults:
        raise InvalidInput(faults[0], faults)
    others = {name: cells for name, cells in table.columns.items() if name not in taken and name not in columns}
    return Table(table.path, {**columns, **others}, table.rows)


def _units(table: Table, decimal: str) -> Table:
    """Decimal points, and columns in the project's units."""
    columns: dict[str, tuple[str, ...]] = {}
    for name, cells in table.columns.items():
        stem, _, unit = name.rpartition("_")
        pointed = tuple(cell.replace(",", ".") for cell in cells) if decimal == "," else cells
        if (
            stem
            and unit in _UNITS
            and re.fullmatch(r"(s?[xyz]|distance|sigma|q\d+|s?(roll|pitch|yaw)|r[xyz]|[abc])", stem)
        ):
            target, factor = _UNITS[unit]
            values = Table(table.path, {name: pointed}, table.rows).numbers(name) * factor
            columns[f"{stem}_{target}"] = _written(values)
        else:
            columns[name] = pointed if name not in ("pose", "payload", "set") else cells
    return Table(table.path, columns, table.rows)


def _written(values: Array) -> tuple[str, ...]:
    return tuple(repr(float(value)) for value in values)


def _oriented(table: Table, orientation: Orientation) -> Table:
    """Roll, pitch and yaw in place of other angles."""
    if orientation in ("rpy", "intrinsic_zyx"):
        return table
    names, rotation = _READINGS[orientation]
    table.require(names)
    values = np.column_stack([table.numbers(name) for name in names])
    if orientation == "quaternion":
        length = np.linalg.norm(values, axis=1)
        table.refuse(
            np.abs(length - 1.0) > 0.01,
            lambda i: f"the quaternion has the length {length[i]:.4g}: it is 1 for a rotation, check the columns",
        )
    rpy = np.degrees(rpy_from_rotation(rotation(values)))
    columns = {name: cells for name, cells in table.columns.items() if name not in names}
    columns |= {name: _written(rpy[:, k]) for k, name in enumerate(("roll_deg", "pitch_deg", "yaw_deg"))}
    return Table(table.path, columns, table.rows)


def _from_quaternion(q: Array) -> Array:
    """Rotations (n, 3, 3) of quaternions (n, 4), scalar first (Horn 1987)."""
    w, x, y, z = (q / np.linalg.norm(q, axis=1, keepdims=True)).T
    R = np.empty((len(q), 3, 3))
    R[:, 0] = np.column_stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)])
    R[:, 1] = np.column_stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)])
    R[:, 2] = np.column_stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)])
    return R


_READINGS: dict[str, tuple[tuple[str, ...], Callable[[Array], Array]]] = {
    "abc": (_ABC, lambda a: rotation_from_rpy(np.radians(a[:, ::-1]))),
    "quaternion": (_QUATERNION, _from_quaternion),
    "rotation_vector": (_ROTATION_VECTOR, lambda a: exp_so3(np.radians(a))),
}
