"""Files of a reseau camera: the grid (format robcal/reseau-1), and the list of tiles of an image."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from robcal.errors import InvalidInput
from robcal.files.images import SUFFIXES, natural_key
from robcal.files.schemas import Entry, NotNegative, Positive, Text, read_entry
from robcal.files.tables import read_table
from robcal.imaging.grid_crosses import CrossSize
from robcal.photogrammetry.tiles.transformation import Reseau
from robcal.transforms import Array

FORMAT = "robcal/reseau-1"
LEAST_LINE, LEAST_ARM = 1.5, 3.0
"""Width of a bar in px, and length of an arm by that width, below which no cross can be fitted."""
Count = Annotated[int, Field(ge=3, le=2000)]


class ReseauEntry(Entry):
    """The whole file."""

    format: Literal["robcal/reseau-1"]
    columns: Count
    rows: Count
    pitch_mm: Positive
    line_um: Positive
    arm_um: Positive
    pixel_um: Positive
    polarity: Literal["dark", "bright"] = "dark"
    sigma_um: NotNegative = 0.0
    crosses: Text | None = None


@dataclass(frozen=True)
class TileFile:
    """A tile: its image, the image of the crosses (the same file where they show in it), its middle on the plate, m."""

    image: Path
    grid: Path
    centre: Array
    row: int


def read_reseau(path: Path) -> tuple[Reseau, tuple[Path, ...]]:
    """A grid, and the files that it was read from.

    Raises
    ------
    InvalidInput : contradictions, or crosses that are too small to be fitted.
    """
    entry, document = read_entry(path, ReseauEntry, FORMAT)
    pixel = entry.pixel_um
    size = CrossSize(entry.line_um / pixel, entry.arm_um / pixel, entry.polarity == "dark")
    if size.width < LEAST_LINE or size.arm < LEAST_ARM * size.width or entry.arm_um > 450.0 * entry.pitch_mm:
        raise InvalidInput(
            f"{path}, line {document.line(('line_um',))}: crosses with lines of {size.width:.2g} px and arms of "
            f"{size.arm:.3g} px: lines need {LEAST_LINE:g} px, arms (from the middle) {LEAST_ARM:g} lines and less "
            "than half the pitch: check line_um, arm_um, pitch_mm, pixel_um"
        )
    y, x = np.mgrid[: entry.rows, : entry.columns] * (entry.pitch_mm / 1000.0)
    places = np.stack([x, y], axis=-1)
    files: tuple[Path, ...] = (path,)
    if entry.crosses is not None:
        table = path.parent / entry.crosses
        places = _calibrated(table, places, entry.pitch_mm / 1000.0)
        files = (path, table)
    return Reseau(places, entry.sigma_um * 1e-6, entry.pitch_mm / 1000.0, pixel * 1e-6, size), files


def _calibrated(path: Path, nominal: Array, pitch: float) -> Array:
    """Places of a certificate ``column, row, x_mm, y_mm`` in place of the nominal ones; others stay nominal."""
    table = read_table(path)
    table.require(["column", "row", "x_mm", "y_mm"])
    column, row = table.whole_numbers("column"), table.whole_numbers("row")
    rows, columns = nominal.shape[:2]
    table.refuse(
        (column < 0) | (column >= columns) | (row < 0) | (row >= rows),
        lambda i: f"column {column[i]}, row {row[i]} is not in a grid of {columns} x {rows}: both count from 0",
    )
    table.unique(["column", "row"])
    places = nominal.copy()
    places[row, column] = np.column_stack([table.numbers("x_mm"), table.numbers("y_mm")]) / 1000.0
    off = np.linalg.norm(places - nominal, axis=-1)[row, column]
    table.refuse(
        off > 0.1 * pitch, lambda i: f"the cross lies {1000 * off[i]:.3g} mm from its place in the grid: check the unit"
    )
    return places


def list_tiled(folder: Path, what: str) -> dict[str, Path]:
    """File name -> path of the lists of tiles in a folder, one CSV file an image, in natural order.

    Raises
    ------
    InvalidInput : there is no such folder, or no list in it.
    """
    found = sorted(folder.glob("*.csv"), key=lambda p: natural_key(p.name)) if folder.is_dir() else []
    if not found:
        raise InvalidInput(
            f"{folder}: no lists of tiles (one CSV file an image: file, x_mm, y_mm), which {what} needs beside 'tiles'"
        )
    return {path.name: path for path in found}


def read_tiles(path: Path) -> tuple[TileFile, ...]:
    """The tiles of an image: ``file, x_mm, y_mm`` (its middle on the plate as driven), optional ``grid`` (the image of
    the crosses at the same stop).

    Raises
    ------
    InvalidInput : missing columns, files that are not there, a tile that stands twice.
    """
    table = read_table(path)
    table.require(["file", "x_mm", "y_mm"])
    if not len(table):
        raise InvalidInput(f"{path}: lists no tiles")
    table.unique(["file"])
    names = table.texts("file")
    grids = table.texts("grid") if table.has("grid") else names
    absent = [[n for n in pair if not _is_image(path.parent / n)] for pair in zip(names, grids, strict=True)]
    table.refuse(
        [bool(wrong) for wrong in absent],
        lambda i: f"{absent[i][0]} is no image beside this list: copy it there or remove the row",
    )
    centre = np.column_stack([table.numbers("x_mm"), table.numbers("y_mm")]) / 1000.0
    return tuple(
        TileFile(path.parent / name, path.parent / grid, place, int(row))
        for name, grid, place, row in zip(names, grids, centre, table.rows, strict=True)
    )


def _is_image(path: Path) -> bool:
    return path.suffix.lower() in SUFFIXES and path.is_file()
