"""What a report is made of: chapters of text, tables, figures, pictures and key figures. No HTML here."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

from pipeline.json_io import plain

Grade = Literal["good", "care", "bad", "none"]


def script_json(value: object) -> str:
    """JSON that is safe inside a script element."""
    text = json.dumps(plain(value), allow_nan=False)
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


@dataclass(frozen=True)
class Text:
    """A paragraph; `kind` 'lead', 'note' or 'plain'."""

    text: str
    kind: str = "plain"


@dataclass(frozen=True)
class Bullets:
    """A list of sentences; more than `shown` are folded away."""

    items: tuple[str, ...]
    title: str = ""
    shown: int = 12


@dataclass(frozen=True)
class Table:
    """A table; cells are text already formatted. `numeric` columns are set flush right.

    `poses`: the pose (row in the joint log) that each row is about, so that it can be chosen by its first cell.
    """

    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    caption: str = ""
    numeric: frozenset[int] = frozenset()
    shown: int = 60
    emphasis: frozenset[int] = frozenset()
    poses: tuple[int | None, ...] = ()


@dataclass(frozen=True)
class Figure:
    """A Plotly figure as plain data, with a caption that says what is to be seen.

    A trace's `customdata` holds the pose (row in the joint log) of each point, or a list of them: choosing one marks it
    in every plot.
    """

    data: tuple[Mapping[str, Any], ...]
    layout: Mapping[str, Any]
    caption: str
    alt: str
    height: int = 360
    wide: bool = True

    @property
    def payload(self) -> str:
        """JSON that is safe inside a script element."""
        return script_json({"data": list(self.data), "layout": dict(self.layout)})


@dataclass(frozen=True)
class Mark:
    """A target in a picture, px of the image: centre, semi-axes, angle (deg); `tip` of its residual, drawn large."""

    x: float
    y: float
    a: float
    b: float
    angle: float
    name: str
    kind: str
    text: str
    tip: tuple[float, float] | None = None


@dataclass(frozen=True)
class Picture:
    """An embedded JPEG, with what was found in it.

    `box`: x, y, width, height of the part of the image that it shows, px; `refused`: candidates that are no target;
    `pose`: the pose it shows; `extra`: shown only while that pose is chosen.
    """

    jpeg_base64: str
    caption: str
    width: int
    height: int
    box: tuple[int, int, int, int]
    marks: tuple[Mark, ...] = ()
    refused: tuple[tuple[float, float], ...] = ()
    pose: int | None = None
    extra: bool = False


@dataclass(frozen=True)
class Pictures:
    """Pictures side by side."""

    pictures: tuple[Picture, ...]
    caption: str = ""


@dataclass(frozen=True)
class KeyFigure:
    """One number of the top of the report."""

    value: str
    unit: str
    name: str
    detail: str = ""
    grade: Grade = "none"


Block = Text | Bullets | Table | Figure | Pictures


@dataclass(frozen=True)
class Chapter:
    """A chapter; it is left out where it has no blocks. One of the appendix holds evidence, not results."""

    anchor: str
    title: str
    lead: str
    blocks: tuple[Block, ...]
    appendix: bool = False


@dataclass(frozen=True)
class Verdict:
    """The top of the report: how good, how it is known, what to load.

    `diagnosis` says what is missing, `enough` whether a tolerance is kept.
    """

    grade: Grade
    word: str
    sentence: str
    reason: str
    load: str
    diagnosis: str = ""
    figures: tuple[KeyFigure, ...] = field(default=())
    table: Table | None = None
    enough: str = ""


def table(
    columns: Sequence[str],
    rows: Sequence[Sequence[object]],
    caption: str = "",
    text: Sequence[int] = (0,),
    emphasis: Sequence[int] = (),
    shown: int = 60,
    poses: Sequence[int | None] = (),
) -> Table:
    """A table from anything that can be printed; all columns but `text` are numbers."""
    numeric = frozenset(range(len(columns))) - frozenset(text)
    cells = tuple(tuple("" if c is None else str(c) for c in row) for row in rows)
    return Table(tuple(columns), cells, caption, numeric, shown, frozenset(emphasis), tuple(poses))
