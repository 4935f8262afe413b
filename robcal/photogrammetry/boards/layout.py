"""Printed boards: which targets they carry, with which ids, and where.

Frame: origin in the upper left of the pattern as printed, x to the right along the columns, y down along the rows, z
into the sheet. Ids count from 0 row by row; those of an AprilGrid are 4 tag + 0..3, clockwise from the upper left of a
tag.
"""

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from robcal.errors import InvalidInput
from robcal.imaging.aruco_markers import dictionary_by_name
from robcal.photogrammetry.core.bodies import Body, IntArray
from robcal.transforms import Array

BoardKind = Literal["charuco", "chessboard", "aprilgrid", "circles", "asymmetric_circles"]
KINDS: tuple[str, ...] = get_args(BoardKind)
CORNER, CIRCLE = "corner", "circle"
"""Codes of a board's targets."""

_LARGEST = 500
_SIZES: dict[str, tuple[tuple[str, ...], tuple[str, ...]]] = {
    "charuco": (("square", "marker", "dictionary"), ()),
    "chessboard": (("square",), ()),
    "aprilgrid": (("marker", "spacing"), ("dictionary",)),
    "circles": (("spacing",), ("diameter",)),
    "asymmetric_circles": (("spacing",), ("diameter",)),
}
"""What each kind must state, and may."""
_APRILGRID_DICTIONARY = "DICT_APRILTAG_36h11"


@dataclass(frozen=True)
class Board:
    """A printed board; lengths in m.

    Attributes
    ----------
    kind : of the pattern. columns, rows : counts; squares (charuco), inner corners (chessboard), tags (aprilgrid) or
        circles.
    square : side of a square. marker : side of a marker with its dark border. dictionary : OpenCV's name.
    spacing : gap between tags (aprilgrid), distance of neighbouring circles (circles), half of that along a row
        (asymmetric_circles: rows are one ``spacing`` apart, every other one moved by one). diameter : of a circle.

    Raises
    ------
    InvalidInput : a size is missing, does not belong to the kind, or contradicts another one.
    """

    kind: BoardKind
    columns: int
    rows: int
    square: float | None = None
    marker: float | None = None
    dictionary: str | None = None
    spacing: float | None = None
    diameter: float | None = None

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise InvalidInput(f"board kind {self.kind!r} is unknown: use one of {', '.join(KINDS)}")
        if self.kind == "aprilgrid" and self.dictionary is None:
            object.__setattr__(self, "dictionary", _APRILGRID_DICTIONARY)
        needed, possible = _SIZES[self.kind]
        for name in ("square", "marker", "dictionary", "spacing", "diameter"):
            value = getattr(self, name)
            key = name if name == "dictionary" else f"{name}_mm"
            if value is None and name in needed:
                raise InvalidInput(f"a board of kind {self.kind} needs '{key}'")
            if value is not None and name not in needed + possible:
                raise InvalidInput(f"a board of kind {self.kind} has no '{key}': remove it, or correct the kind")
            if isinstance(value, float) and not (np.isfinite(value) and value > 0):
                raise InvalidInput(f"'{key}' of a board must be larger than zero, not {value}")
        self._check_counts()
        self._check_sizes()

    def _check_counts(self) -> None:
        least = 3 if self.kind == "chessboard" else 2
        if self.kind == "aprilgrid":
            least = 1
        if not (least <= self.columns <= _LARGEST and least <= self.rows <= _LARGEST):
            what = {"charuco": "squares", "chessboard": "inner corners", "aprilgrid": "tags"}.get(self.kind, "circles")
            raise InvalidInput(
                f"a {self.kind} board of {self.columns} x {self.rows} {what}: columns and rows must be {least} to "
                f"{_LARGEST}"
            )
        if self.dictionary is not None:
            available = len(dictionary_by_name(self.dictionary).bytesList)
            if self.markers > available:
                raise InvalidInput(
                    f"a {self.kind} board of {self.columns} x {self.rows} needs {self.markers} markers, the dictionary "
                    f"{self.dictionary} has {available}: choose a larger one"
                )

    def _check_sizes(self) -> None:
        square, marker, spacing, diameter = self.square, self.marker, self.spacing, self.diameter
        if square is not None and marker is not None and not marker < square:
            raise InvalidInput(
                f"marker_mm {marker * 1000:g} does not fit into squares of {square * 1000:g} mm: the marker is smaller "
                "than its square"
            )
        if spacing is not None and diameter is not None:
            nearest = spacing * (np.sqrt(2.0) if self.kind == "asymmetric_circles" else 1.0)
            if diameter >= nearest:
                raise InvalidInput(
                    f"circles of diameter_mm {diameter * 1000:g} touch one another at spacing_mm {spacing * 1000:g}: "
                    "check both"
                )

    @property
    def markers(self) -> int:
        """Number of square markers."""
        if self.kind == "charuco":
            return self.columns * self.rows // 2
        return self.columns * self.rows if self.kind == "aprilgrid" else 0

    @property
    def has_circles(self) -> bool:
        """True for grids of circles, false for boards of corners."""
        return self.kind in ("circles", "asymmetric_circles")

    @property
    def size(self) -> tuple[float, float]:
        """Width and height of the pattern in m: with dark squares, without the white margin around it."""
        if self.kind == "charuco":
            return self.columns * _known(self.square), self.rows * _known(self.square)
        if self.kind == "chessboard":
            return (self.columns + 1) * _known(self.square), (self.rows + 1) * _known(self.square)
        spacing = _known(self.spacing)
        if self.kind == "aprilgrid":
            pitch = _known(self.marker) + spacing
            return self.columns * pitch + spacing, self.rows * pitch + spacing
        last = self.points().max(axis=0) + (self.diameter or 0.0)
        return float(last[0]), float(last[1])

    @property
    def turns(self) -> int:
        """Number of ways to turn the board (in steps of a quarter) that look the same: 1, 2 or 4."""
        if self.kind == "chessboard":
            if self.columns == self.rows and self.columns % 2 == 0:
                return 4
            return 2 if (self.columns + self.rows) % 2 == 0 else 1
        if self.kind == "circles":
            return 4 if self.columns == self.rows else 2
        if self.kind == "asymmetric_circles":
            return 2 if self.rows % 2 == 0 else 1
        return 1

    @property
    def same_when_turned(self) -> str:
        """A sentence about boards that look the same when turned; empty for others."""
        if self.turns == 1:
            return ""
        how = "half a turn" if self.turns == 2 else "a quarter turn"
        return (
            f"this {self.kind} board looks the same after {how}: images are numbered with the x axis to the right, so "
            "do not turn the board before the camera by more than a fraction of that, or print one that is unambiguous"
        )

    def ids(self) -> IntArray:
        """(t,) ids of the targets in the order of :meth:`points`."""
        return np.arange(len(self.points()), dtype=np.int64)

    def points(self) -> Array:
        """(t, 3) m, targets in the order of their ids."""
        if self.kind == "aprilgrid":
            return _flat(self._tag_corners().reshape(-1, 2))
        if self.has_circles:
            row, column = _grid(self.rows, self.columns)
            if self.kind == "asymmetric_circles":
                column = 2 * column + row % 2
            return _flat(np.stack([column, row], axis=-1) * _known(self.spacing))
        fewer = 1 if self.kind == "charuco" else 0
        row, column = _grid(self.rows - fewer, self.columns - fewer)
        return _flat(np.stack([column + 1, row + 1], axis=-1) * _known(self.square))

    def _tag_corners(self) -> Array:
        """(tags, 4, 2) m, clockwise from the upper left; tag 0 is at the lower left, the next to its right."""
        row, column = _grid(self.rows, self.columns)
        marker, spacing = _known(self.marker), _known(self.spacing)
        lower_first = self.rows - 1 - row
        corner = np.stack([column, lower_first], axis=-1) * (marker + spacing) + spacing
        return corner[:, None] + marker * np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])

    def marker_corners(self, *, legacy: bool = False) -> Array:
        """(markers, 4, 2) m of the square markers by marker id, clockwise from their upper left.

        ``legacy``: ChArUco boards of an even number of rows as OpenCV printed them before version 4.6, with a marker
        in the upper left.
        """
        if self.kind == "aprilgrid":
            return self._tag_corners()
        if self.kind != "charuco":
            return np.empty((0, 4, 2))
        row, column = _grid(self.rows, self.columns)
        odd = 0 if legacy and self.rows % 2 == 0 else 1
        bright = (row + column) % 2 == odd
        square, marker = _known(self.square), _known(self.marker)
        first = np.stack([column[bright], row[bright]], axis=-1) * square + 0.5 * (square - marker)
        return first[:, None] + marker * np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])

    def body(self, name: str = "board") -> Body:
        """The board as a body, coordinates exact."""
        points = self.points()
        return Body(
            name=name,
            ids=self.ids(),
            points=points,
            codes=((CIRCLE if self.has_circles else CORNER),) * len(points),
            diameters=np.full(len(points), np.nan if self.diameter is None else self.diameter),
            polarity="dark",
            normals=np.tile([0.0, 0.0, -1.0], (len(points), 1)),
        )


def _known(length: float | None) -> float:
    """A length that the kind must state, so that it is there."""
    if length is None:
        raise InvalidInput("a size of the board is missing")
    return length


def _grid(rows: int, columns: int) -> tuple[IntArray, IntArray]:
    """Row and column (rows * columns,) of the cells, row by row."""
    row, column = np.divmod(np.arange(rows * columns, dtype=np.int64), columns)
    return row, column


def _flat(xy: NDArray[np.floating]) -> Array:
    return np.column_stack([xy, np.zeros(len(xy))]).astype(float)
