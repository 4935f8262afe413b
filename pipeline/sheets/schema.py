"""Description of a sheet of targets (format robcal/targets-1): the entries as a person writes them."""

from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field

from robcal.files.body_file import BoardEntry
from robcal.files.schemas import Entry, NotNegative, Positive, Text, Whole

FORMAT = "robcal/targets-1"
PAGES_MM: dict[str, tuple[float, float]] = {
    "A0": (841, 1189),
    "A1": (594, 841),
    "A2": (420, 594),
    "A3": (297, 420),
    "A4": (210, 297),
    "A5": (148, 210),
    "letter": (215.9, 279.4),
    "tabloid": (279.4, 431.8),
}


def _page(value: Any) -> Any:
    if isinstance(value, str):
        if value not in PAGES_MM:
            raise ValueError(f"is a size [width, height] in mm or one of {', '.join(PAGES_MM)}, found '{value[:20]}'")
        return PAGES_MM[value]
    return value


class RingTargets(Entry):
    """Coded and plain dots.

    ``ids``: those to print, default the first ``count`` of moderate brightness. ``plain``: number of dots without code.
    ``ground``: dark prints bright targets on dark (as retro-reflective ones look), bright the reverse.
    """

    code: Literal["ring12"] = "ring12"
    diameter_mm: Positive
    ids: list[Whole] | None = None
    count: Whole = 30
    plain: Whole = 0
    ground: Literal["dark", "bright"] = "dark"


class Cutouts(Entry):
    """Targets side by side, to be cut out and stuck on anything."""

    kind: Literal["cutouts"]


class PlateLayout(Entry):
    """Targets in place on a flat sheet, coded and plain ones mixed, their coordinates known as printed."""

    kind: Literal["plate"]
    columns: Whole
    rows: Whole
    pitch_mm: Positive


class SphereLayout(Entry):
    """Targets to be stuck on a sphere, evenly over its cap; the body file says where."""

    kind: Literal["sphere"]
    radius_mm: Positive
    cap_deg: Positive = 110.0


class SheetEntry(Entry):
    """The whole file: a board, or ring targets with their layout."""

    format: Literal["robcal/targets-1"]
    page: Annotated[tuple[Positive, Positive], BeforeValidator(_page)] = (210.0, 297.0)
    margin_mm: NotNegative = 8.0
    board: BoardEntry | None = None
    targets: RingTargets | None = None
    layout: Annotated[Cutouts | PlateLayout | SphereLayout, Field(discriminator="kind")] = Cutouts(kind="cutouts")
    title: Text | None = None
