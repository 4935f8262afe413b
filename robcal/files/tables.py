"""CSV tables of people: comma, decimal point, one header line; every problem in one sentence with file and row.

Read: UTF-8 with or without byte order mark, any line ending, blank lines. Refused with a remedy: semicolons and decimal
commas, other encodings, missing or doubled columns, rows of another length, text or NaN where a number is needed.
Rows are counted as in an editor: the header is row 1.
"""

import csv
import io
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from robcal.errors import InvalidInput
from robcal.files.schemas import LARGEST, proposal, shown
from robcal.files.storage import read_bytes, write_text
from robcal.transforms import Array

MAX_BYTES = 400_000_000
MAX_ROWS = 5_000_000
MAX_CELL = 10_000
MOST_REPORTED = 20
"""Faulty rows of one kind that are listed."""
MISSING = frozenset({"", "nan", "na", "n/a", "null", "none", "-"})


class FaultyRows(InvalidInput):
    """Rows of a table that contradict its format.

    Attributes
    ----------
    rest : the table without them.
    """

    def __init__(self, faults: Sequence[str], rest: "Table") -> None:
        super().__init__(faults[0], faults)
        self.rest = rest


@dataclass(frozen=True)
class Table:
    """A CSV file as text columns.

    Attributes
    ----------
    columns : name -> cells, stripped of blanks.
    rows : row number in the file of each record.
    """

    path: Path
    columns: Mapping[str, tuple[str, ...]]
    rows: NDArray[np.int64] = field(repr=False)

    def __len__(self) -> int:
        return len(self.rows)

    def has(self, *names: str) -> bool:
        """Whether all these columns are there."""
        return all(name in self.columns for name in names)

    def error(self, record: int, message: str) -> FaultyRows:
        """An error that names file and row."""
        return FaultyRows([self._located(record, message)], self.without([record]))

    def _located(self, record: int, message: str) -> str:
        return f"{self.path}, row {int(self.rows[record])}: {message}"

    def refuse(self, bad: ArrayLike, message: Callable[[int], str]) -> None:
        """Raise an error that names all bad records (mask), if there are any; ``message`` says what is wrong with one.

        Raises
        ------
        FaultyRows : some are bad.
        """
        records = np.flatnonzero(bad)
        if len(records):
            faults = [self._located(int(i), message(int(i))) for i in records[:MOST_REPORTED]]
            if len(records) > MOST_REPORTED:
                faults.append(f"{self.path}: {len(records) - MOST_REPORTED} more rows like these")
            raise FaultyRows(faults, self.without(records))

    def without(self, records: ArrayLike) -> "Table":
        """The table without some records."""
        kept = np.setdiff1d(np.arange(len(self)), records)
        columns = {name: tuple(cells[i] for i in kept) for name, cells in self.columns.items()}
        return replace(self, columns=columns, rows=self.rows[kept])

    def require(self, names: Sequence[str]) -> None:
        """Raise InvalidInput if columns are missing."""
        have = [column for column in self.columns if column not in names]
        needed = ", ".join(names)
        missing = [
            f"{self.path}, row 1: column '{name}' is missing{proposal(name, have)}: needed are {needed}"
            for name in names
            if name not in self.columns
        ]
        if missing:
            raise InvalidInput(missing[0], missing)

    def texts(self, name: str) -> tuple[str, ...]:
        """A column of names, none empty."""
        self.require([name])
        self.refuse(
            [not cell for cell in self.columns[name]], lambda i: f"{name} is empty: give a name or remove the row"
        )
        return self.columns[name]

    def numbers(self, name: str, *, positive: bool = False) -> Array:
        """A column of finite numbers.

        Raises
        ------
        InvalidInput : a cell is empty, NaN, infinite or text; with ``positive`` also where it is not above zero.
        """
        self.require([name])
        cells = self.columns[name]
        values = np.array([_float_or_nan(cell) for cell in cells], dtype=float)
        self.refuse(
            ~np.isfinite(values), lambda i: f"{name} is {_bad_number(cells[i])}: give a finite number or remove the row"
        )
        remedy = "give the number or remove the row"
        self.refuse(
            np.abs(values) > LARGEST, lambda i: f"{name} is {shown(cells[i])}, no quantity is as large: {remedy}"
        )
        if positive:
            remedy = "it must be larger than zero: correct it or remove the column"
            self.refuse(values <= 0, lambda i: f"{name} is {cells[i]}, {remedy}")
        return values

    def whole_numbers(self, name: str) -> NDArray[np.int64]:
        """A column of whole numbers."""
        values = self.numbers(name)
        cells = self.columns[name]
        bad = (values != np.round(values)) | (np.abs(values) > 2**53)
        self.refuse(bad, lambda i: f"{name} is {shown(cells[i])}, it must be a whole number")
        return values.astype(np.int64)

    def number_column(self, name: str) -> Array | None:
        """A column of numbers if every cell is one, None if not (an unknown column of text)."""
        values = np.array([_float_or_nan(cell) for cell in self.columns[name]], dtype=float)
        return values if (np.abs(values) <= LARGEST).all() and len(values) else None

    def unique(self, names: Sequence[str]) -> None:
        """Raise InvalidInput if two rows agree in these columns."""
        keys = list(zip(*(self.columns[name] for name in names), strict=True))
        seen: dict[tuple[str, ...], int] = {}
        first = [seen.setdefault(key, i) for i, key in enumerate(keys)]

        def sentence(i: int) -> str:
            what = ", ".join(f"{name} {cell}" for name, cell in zip(names, keys[i], strict=True))
            return f"{what} stands twice (first in row {int(self.rows[first[i]])}): remove one of them"

        self.refuse(np.array(first, dtype=np.int64) != np.arange(len(keys)), sentence)


def _float_or_nan(cell: str) -> float:
    try:
        # float() takes the digit groups of Python source, 1_000, which no table means
        return float(cell) if "_" not in cell else math.nan
    except ValueError:
        return math.nan


def _bad_number(cell: str) -> str:
    if cell.lower() in MISSING:
        return "missing (empty or NaN)"
    if cell.lower().lstrip("+-") in {"inf", "infinity"}:
        return "infinite"
    return f"{shown(cell)}, not a number"


def read_table(path: Path) -> Table:
    """Read a CSV file.

    Raises
    ------
    InvalidInput : unreadable, other separators or encodings, doubled columns.
    FaultyRows : rows of another length.
    """
    raw = read_bytes(path, MAX_BYTES)
    if raw[:2] in (b"\xff\xfe", b"\xfe\xff"):
        raise InvalidInput(f"{path}: is UTF-16 text: save it as 'CSV UTF-8'")
    if b"\x00" in raw[:4096]:
        raise InvalidInput(f"{path}: is not a text file: a CSV table is needed")
    try:
        text = raw.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        row = raw[: error.start].count(b"\n") + 1
        raise InvalidInput(f"{path}, row {row}: is not UTF-8 text: save it as 'CSV UTF-8'") from None
    reader = csv.reader(io.StringIO(text, newline=""), strict=True)
    header: list[str] | None = None
    records: list[list[str]] = []
    rows: list[int] = []
    ragged: list[str] = []
    start = 1
    try:
        for record in reader:
            row, start = start, reader.line_num + 1
            if not record or all(not cell.strip() for cell in record):
                continue
            if header is None:
                header = _header(path, row, record)
                continue
            if len(record) > len(header) and not any(cell.strip() for cell in record[len(header) :]):
                record = record[: len(header)]
            if len(record) != len(header):
                ragged.append(
                    f"{path}, row {row}: has {len(record)} cells where the header has {len(header)}: "
                    "add or remove cells (decimal point, not comma)"
                )
                continue
            records.append([cell.strip() for cell in record])
            rows.append(row)
            if len(rows) > MAX_ROWS:
                raise InvalidInput(f"{path}: has more than {MAX_ROWS} rows: split it into campaigns")
    except csv.Error as error:
        raise InvalidInput(f"{path}, row {reader.line_num}: not a CSV table: {error}") from None
    if header is None:
        raise InvalidInput(f"{path}: is empty: the first row must name the columns")
    by_column = zip(*records, strict=True) if records else [() for _ in header]
    columns = {name: tuple(cells) for name, cells in zip(header, by_column, strict=True)}
    table = Table(path, columns, np.array(rows, dtype=np.int64))
    if ragged:
        raise FaultyRows(ragged[:MOST_REPORTED], table)
    return table


def _header(path: Path, row: int, record: list[str]) -> list[str]:
    names = [cell.strip() for cell in record]
    if len(names) == 1 and (";" in names[0] or "\t" in names[0]):
        mark = "semicolons" if ";" in names[0] else "tabs"
        raise InvalidInput(f"{path}, row {row}: columns are separated by {mark}: use commas, and a decimal point")
    while names and not names[-1]:
        names.pop()
    for i, name in enumerate(names):
        if not name:
            raise InvalidInput(f"{path}, row {row}: column {i + 1} has no name: name or remove it")
        if len(name) > MAX_CELL:
            raise InvalidInput(f"{path}, row {row}: the name of column {i + 1} has {len(name)} characters")
        if names.index(name) != i:
            raise InvalidInput(f"{path}, row {row}: column '{name}' stands twice: remove or rename one of them")
    return names


def table_text(columns: Mapping[str, Iterable[object]]) -> str:
    """CSV text; floats with the digits given by their strings or, if floats, with twelve significant ones."""
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(columns.keys())
    for row in zip(*columns.values(), strict=True):
        writer.writerow([f"{cell:.12g}" if isinstance(cell, float) else cell for cell in row])
    return stream.getvalue()


def write_table(path: Path, columns: Mapping[str, Iterable[object]]) -> None:
    """Write a CSV file atomically."""
    write_text(path, table_text(columns))
