"""`pipeline targets CONFIG --out sheet.pdf`: sheets of targets to scale, and the body file that belongs to them."""

from pathlib import Path
from typing import Any

import numpy as np

from pipeline.sheets.drawing import Sheet
from pipeline.sheets.places import FIRST_PLAIN, chosen_ids, plate_places, sphere_places, spread_codes
from pipeline.sheets.schema import FORMAT, PlateLayout, RingTargets, SheetEntry, SphereLayout
from robcal.errors import InvalidInput
from robcal.files.body_file import board_entry, board_of, read_body
from robcal.files.schemas import read_entry
from robcal.files.storage import write_atomic, write_text
from robcal.files.yaml_io import FlowMapping, yaml_text
from robcal.photogrammetry.boards.artwork import board_artwork, ring_sectors
from robcal.photogrammetry.boards.layout import Board
from robcal.transforms import Array

_DISC, _RING = 3.6, (2.0, 3.0)
"""Radii of the dark disc and the ring in radii of the dot."""
_PLAIN_DISC = 2.0
_LABEL = 4.0
"""mm below a target for its id."""


def make_sheet(config: Path, out: Path) -> dict[str, Any]:
    """Write the PDF and, beside it, the body file; returns what was written.

    Raises
    ------
    InvalidInput : the description contradicts itself, or does not fit on the page.
    """
    entry, document = read_entry(config, SheetEntry, FORMAT)
    if out.suffix.lower() != ".pdf":
        raise InvalidInput(f"{out}: --out is the PDF to write: name it sheet.pdf, for instance")
    if (entry.board is None) == (entry.targets is None):
        raise InvalidInput(f"{config}: state either 'board' or 'targets': what is to be printed")
    width, height = entry.page
    if min(width, height) < 60 or max(width, height) > 2500:
        raise InvalidInput(f"{config}: a page of {width:g} x {height:g} mm: sides are 60 to 2500 mm")
    body_path = out.with_suffix(".yaml")
    if body_path.resolve() == config.resolve():
        raise InvalidInput(f"{out}: its body file would overwrite {config}: give the PDF another name")
    title = entry.title or config.stem
    if entry.board is not None:
        sheet, body = _board_sheet(entry, title, config)
    else:
        sheet, body = _ring_sheet(entry, title, config, document.line(("targets",)) or 1)
    write_atomic(out, lambda stream: stream.write(sheet.content()))
    write_text(body_path, yaml_text(body, f"belongs to {out.name}; measure the ruler before you trust the lengths"))
    known = read_body(body_path)
    return {"sheet": str(out), "body": str(body_path), "targets": len(known.targets)}


def _board_sheet(entry: SheetEntry, title: str, config: Path) -> tuple[Sheet, dict[str, Any]]:
    if entry.board is None:
        raise InvalidInput(f"{config}: no board")
    board = board_of(entry.board, f"{config}: board")
    low, high = _extent(board)
    margin = 1000 * _quiet_zone(board)
    needed = 1000 * (high - low) + 2 * margin
    sheet = _fitting(entry, title, config, needed, f"the {board.kind} board")
    room = sheet.room
    shift = np.array([sheet.margin, sheet.margin]) + (np.array(room) - needed) / 2 + margin - 1000 * low
    art = board_artwork(board)
    if len(art.boxes):
        sheet.boxes(1000 * art.boxes + np.tile(shift, 2))
    if len(art.discs):
        sheet.discs(1000 * art.discs + np.array([*shift, 0.0]))
    top = shift + 1000 * low
    sheet.text(top[0], top[1] - 0.4 * margin, f"x to the right, y down, from this corner: {_words(board)}", 2.0)
    sheet.end_page()
    return sheet, {"format": "robcal/body-1", "board": board_entry(board)}


def _extent(board: Board) -> tuple[Array, Array]:
    """Upper left and lower right (2,) m of what is printed."""
    if not board.has_circles:
        return np.zeros(2), np.array(board.size)
    discs = board_artwork(board).discs
    return (discs[:, :2] - discs[:, 2:]).min(axis=0), (discs[:, :2] + discs[:, 2:]).max(axis=0)


def _quiet_zone(board: Board) -> float:
    """White margin in m that the detectors want around a board."""
    if board.kind == "charuco":
        return 0.3 * (board.square or 0.0)
    return 0.6 * (board.square or 0.0) if board.kind == "chessboard" else 0.5 * (board.spacing or 0.0)


def _words(board: Board) -> str:
    sizes = [(n, getattr(board, n)) for n in ("square", "marker", "spacing", "diameter")]
    message = ", ".join(f"{name} {1000 * value:g} mm" for name, value in sizes if value is not None)
    return (
        f"{board.kind} {board.columns} x {board.rows}, {message}{', ' + board.dictionary if board.dictionary else ''}"
    )


def _fitting(entry: SheetEntry, title: str, config: Path, needed: Array, what: str) -> Sheet:
    """A sheet on which ``needed`` (2,) mm fit, upright or across."""
    for page in (entry.page, entry.page[::-1]):
        sheet = Sheet((page[0], page[1]), entry.margin_mm, title)
        if np.all(needed <= np.array(sheet.room) + 1e-6):
            return sheet
    raise InvalidInput(
        f"{config}: {what} takes {needed[0]:.0f} x {needed[1]:.0f} mm with its margin, the page has room for "
        f"{sheet.room[1]:.0f} x {sheet.room[0]:.0f} mm: choose a larger 'page' (A3, or [width, height] in mm), "
        "or smaller targets"
    )


def _ring_sheet(entry: SheetEntry, title: str, config: Path, line: int) -> tuple[Sheet, dict[str, Any]]:
    targets, layout = entry.targets, entry.layout
    if targets is None:
        raise InvalidInput(f"{config}: no targets")
    ids: list[int | None] = list(chosen_ids(targets, f"{config}, line {line}"))
    if not ids and not targets.plain:
        raise InvalidInput(f"{config}, line {line}: no targets: state ids, count or plain")
    if isinstance(layout, PlateLayout):
        return _plate(entry, targets, layout, ids, title, config)
    items = ids + [None] * targets.plain
    sheet = Sheet(entry.page, entry.margin_mm, title)
    size = _DISC * targets.diameter_mm
    cell = np.array([size + 2.0, size + _LABEL])
    columns, rows = (np.array(sheet.room) // cell).astype(int)
    if columns < 1 or rows < 1:
        _fitting(entry, title, config, cell, "one target")
    for k, number in enumerate(items):
        i, j = k % columns, (k // columns) % rows
        if k and i == 0 and j == 0:
            sheet.end_page()
        centre = sheet.margin + cell[0] * (i + 0.5), sheet.margin + cell[1] * j + 0.5 * size
        _target(sheet, centre, targets, number, "" if number is None else str(number))
    sheet.end_page()
    places = None
    if isinstance(layout, SphereLayout):
        places = sphere_places(len(items), layout.radius_mm / 1000, np.radians(min(layout.cap_deg, 180.0)))
        items = _mixed(ids, targets.plain)
    body = _body(items, targets, places)
    if isinstance(layout, SphereLayout):
        body["shape"] = FlowMapping(kind="sphere", radius_mm=layout.radius_mm)
    return sheet, body


def _mixed(ids: list[int | None], plain: int) -> list[int | None]:
    """Coded and plain targets evenly mixed."""
    coded = iter(ids)
    return [next(coded) if code else None for code in spread_codes(len(ids), len(ids) + plain)]


def _plate(
    entry: SheetEntry, targets: RingTargets, layout: PlateLayout, ids: list[int | None], title: str, config: Path
) -> tuple[Sheet, dict[str, Any]]:
    total = layout.columns * layout.rows
    size = (_DISC if targets.ground == "dark" else _RING[1]) * targets.diameter_mm
    if layout.columns < 1 or layout.rows < 1:
        raise InvalidInput(f"{config}: a plate of {layout.columns} x {layout.rows} targets: both are at least 1")
    if layout.pitch_mm < size + _LABEL:
        raise InvalidInput(
            f"{config}: targets of diameter_mm {targets.diameter_mm:g} with their rings and ids need a pitch_mm of "
            f"{size + _LABEL:g} or more, not {layout.pitch_mm:g}"
        )
    if len(ids) + targets.plain != total:
        raise InvalidInput(
            f"{config}: {len(ids)} coded and {targets.plain} plain for {layout.columns} x {layout.rows} places: "
            f"state 'ids' or 'count', and 'plain', that add up to {total}"
        )
    items = _mixed(ids, targets.plain)
    places = plate_places(layout.columns, layout.rows, layout.pitch_mm / 1000)
    needed = 1000 * places[:, :2].max(axis=0) + [size, size + _LABEL]
    sheet = _fitting(entry, title, config, needed, "the plate")
    shift = np.array([sheet.margin, sheet.margin]) + (np.array(sheet.room) - needed) / 2 + size / 2
    for k, number in enumerate(items):
        x, y = 1000 * places[k, :2] + shift
        _target(sheet, (float(x), float(y)), targets, number, str(FIRST_PLAIN + k if number is None else number))
    sheet.end_page()
    return sheet, _body(items, targets, places)


def _target(sheet: Sheet, centre: tuple[float, float], targets: RingTargets, number: int | None, label: str) -> None:
    """A dot with its ring on its ground, and its id below."""
    radius = 0.5 * targets.diameter_mm
    bright, dark = (1.0, 0.0) if targets.ground == "dark" else (0.0, 1.0)
    if targets.ground == "dark":
        extent = _DISC if number is not None else _PLAIN_DISC
        sheet.discs(np.array([[*centre, extent * radius]]), dark)
    sheet.discs(np.array([[*centre, radius]]), bright)
    if number is not None:
        for angles in ring_sectors(number):
            sheet.sector(centre, (_RING[0] * radius, _RING[1] * radius), angles, bright)
    if label:
        sheet.text(centre[0], centre[1] + _DISC * radius + 2.8, label, centred=True)


def _body(items: list[int | None], targets: RingTargets, places: Array | None) -> dict[str, Any]:
    rows = []
    for k, number in enumerate(items):
        plain = None if places is None else FIRST_PLAIN + k
        row: dict[str, Any] = FlowMapping(id=plain if number is None else number)
        row["code"] = None if number is None else targets.code
        row["diameter_mm"] = targets.diameter_mm
        row["xyz_mm"] = None if places is None else [round(1000 * float(v), 6) for v in places[k]]
        rows.append(row)
    body: dict[str, Any] = {"format": "robcal/body-1"}
    if targets.ground == "bright":
        body["polarity"] = "dark"
    return body | {"targets": rows}
