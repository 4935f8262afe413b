"""Bodies (format robcal/body-1): targets with codes, diameters and coordinates, as given or as surveyed."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from robcal.errors import InvalidInput
from robcal.files.schemas import Entry, NotNegative, Positive, Text, Triple, Whole, read_entry
from robcal.files.storage import write_text
from robcal.files.yaml_io import FlowMapping, YamlDocument, yaml_text
from robcal.imaging.ring_code import (
    FEWEST_SEGMENTS,
    MOST_SEGMENTS,
    RING12,
    RingPattern,
    canonical_id,
    is_id,
    ring_segments,
)
from robcal.photogrammetry.boards.layout import Board, BoardKind
from robcal.photogrammetry.core.bodies import Body

FORMAT = "robcal/body-1"
CODES = ("ring12", "corner", "circle")


class TargetEntry(Entry):
    """One target."""

    id: Whole | None = None
    code: Text | None = None
    diameter_mm: Positive | None = None
    xyz_mm: Triple | None = None
    sigma_mm: NotNegative | Triple | None = None
    polarity: Literal["bright", "dark"] | None = None
    normal: Triple | None = None


class ShapeEntry(Entry):
    """The surface that carries the targets."""

    kind: Literal["sphere"]
    radius_mm: Positive


class BoardEntry(Entry):
    """A printed board in place of a list of targets."""

    kind: BoardKind
    columns: Whole
    rows: Whole
    square_mm: Positive | None = None
    marker_mm: Positive | None = None
    dictionary: Text | None = None
    spacing_mm: Positive | None = None
    diameter_mm: Positive | None = None


class RingEntry(Entry):
    """How ring codes are printed: radii by that of the dot, direction as seen from the front."""

    inner: Positive = 2.0
    outer: Positive = 3.0
    direction: Literal["clockwise", "counterclockwise"] = "clockwise"


class BodyEntry(Entry):
    """The whole file."""

    format: Literal["robcal/body-1"]
    targets: list[TargetEntry] | None = None
    board: BoardEntry | None = None
    ring: RingEntry | None = None
    shape: ShapeEntry | None = None
    polarity: Literal["bright", "dark"] | None = None


@dataclass(frozen=True)
class BodyTargetRow:
    """A target of a body file in SI units; coordinates and sigma None where unknown."""

    id: int | None
    code: str | None
    diameter: float | None
    xyz: tuple[float, float, float] | None
    sigma: tuple[float, float, float] | None
    polarity: str
    normal: tuple[float, float, float] | None = None


@dataclass(frozen=True)
class BodyFile:
    """Content of a body file.

    ``board`` where it is a printed one, whose targets are those of its layout; ``radius`` (m) of a sphere; ``ring``:
    how ring codes are printed.
    """

    path: Path
    targets: tuple[BodyTargetRow, ...]
    polarity: str
    board: Board | None = None
    radius: float | None = None
    ring: RingPattern = RING12

    def known(self) -> tuple[BodyTargetRow, ...]:
        """Targets with id and coordinates."""
        return tuple(t for t in self.targets if t.id is not None and t.xyz is not None)


def read_body(path: Path | str) -> BodyFile:
    """Read a body file.

    Raises
    ------
    InvalidInput : contradicts the format: duplicate ids, two targets in one place, a board that cannot be.
    """
    entry, document = read_entry(Path(path), BodyEntry, FORMAT)
    faults = list(_faults(entry, document))
    if faults:
        raise InvalidInput(faults[0], faults)
    rows = [_row(target, entry.polarity or "bright") for target in entry.targets or ()]
    if entry.board is not None:
        return _with_board(entry, entry.board, document, rows)
    if not rows:
        raise InvalidInput(f"{document.path}: lists no targets: a body needs at least three, or a 'board'")
    radius = None if entry.shape is None else entry.shape.radius_mm / 1000
    ring = _ring(entry, document)
    return BodyFile(document.path, tuple(rows), entry.polarity or "bright", radius=radius, ring=ring)


def _ring(entry: BodyEntry, document: YamlDocument) -> RingPattern:
    """The pattern of a body's ring codes, of one number of segments."""
    kinds = sorted({n for t in entry.targets or () if (n := ring_segments(t.code)) is not None})
    if len(kinds) > 1:
        message = ", ".join(f"ring{n}" for n in kinds)
        raise InvalidInput(f"{document.path}: ring codes of several kinds on one body ({message}): use one")
    use = entry.ring or RingEntry()
    try:
        segments = kinds[0] if kinds else RING12.segments
        return RingPattern(segments, use.inner, use.outer, use.direction == "clockwise")
    except InvalidInput as error:
        raise InvalidInput(f"{document.path}, line {document.line(('ring',))}: {error}") from None


def board_of(use: BoardEntry, where: str) -> Board:
    """The board that an entry states; ``where`` it stands, for messages."""
    mm = {name: getattr(use, f"{name}_mm") for name in ("square", "marker", "spacing", "diameter")}
    lengths = {name: None if value is None else value / 1000 for name, value in mm.items()}
    try:
        return Board(use.kind, use.columns, use.rows, dictionary=use.dictionary, **lengths)
    except InvalidInput as error:
        raise InvalidInput(f"{where}: {error}") from None


def _with_board(entry: BodyEntry, use: BoardEntry, document: YamlDocument, measured: list[BodyTargetRow]) -> BodyFile:
    """The targets of a board's layout, those with measured coordinates there."""
    board = board_of(use, f"{document.path}, line {document.line(('board',))}")
    polarity = entry.polarity or "dark"
    body = board.body()
    rows = [
        BodyTargetRow(i, body.codes[0], board.diameter, (x, y, z), None, polarity, (0.0, 0.0, -1.0))
        for i, (x, y, z) in enumerate(body.points.tolist())
    ]
    for i, target in enumerate(measured):
        if target.id is None or target.id >= len(rows) or target.xyz is None:
            raise InvalidInput(
                f"{document.path}, line {document.line(('targets', i))}: targets beside a 'board' are measured "
                f"coordinates of its own ones: give an id from 0 to {len(rows) - 1} and xyz_mm"
            )
        own = rows[target.id]
        rows[target.id] = replace(own, xyz=target.xyz, sigma=target.sigma, normal=target.normal or own.normal)
    return BodyFile(document.path, tuple(rows), polarity, board)


def _faults(entry: BodyEntry, document: YamlDocument) -> Iterator[str]:
    """A sentence for each contradiction among the targets."""
    first: dict[int, int] = {}
    places: dict[tuple[float, float, float], int] = {}
    listed = entry.targets or []
    lines = [document.line(("targets", i)) or 0 for i in range(len(listed))]
    for i, target in enumerate(listed):
        where = f"{document.path}, line {lines[i]}"
        if target.id is not None:
            if target.id < 0:
                yield f"{where}: target id {target.id} is negative: ids count from 0"
            if first.setdefault(target.id, i) != i:
                yield (
                    f"{where}: target {target.id} stands twice (first in line {lines[first[target.id]]}): remove one "
                    "or give it its own id"
                )
        segments = ring_segments(target.code)
        ringed = segments is not None and FEWEST_SEGMENTS <= segments <= MOST_SEGMENTS
        known = target.code is None or target.code in CODES or target.code.startswith("aruco:")
        if not known and not ringed:
            yield (
                f"{where}: unknown code '{target.code}': use ring12 (or ring{FEWEST_SEGMENTS} to "
                f"ring{MOST_SEGMENTS}), aruco:<dictionary>, corner, circle or null (none)"
            )
        if ringed and target.id is None:
            yield f"{where}: a {target.code} target needs its id (the number that its ring shows)"
        if target.xyz_mm is not None:
            if places.setdefault(target.xyz_mm, i) != i:
                yield (
                    f"{where}: lies in the same place as the target of line {lines[places[target.xyz_mm]]}: "
                    "check the coordinates"
                )
            if max(map(abs, target.xyz_mm)) > 1e6:
                yield f"{where}: coordinates beyond a kilometre: they are in mm"
        length = 1.0 if target.normal is None else float(np.linalg.norm(target.normal))
        if not 0.5 < length < 2.0:
            yield f"{where}: normal has the length {length:g}: it is a direction of length 1"


def _row(target: TargetEntry, polarity: str) -> BodyTargetRow:
    sigma = target.sigma_mm
    return BodyTargetRow(
        id=target.id,
        code=target.code,
        diameter=None if target.diameter_mm is None else target.diameter_mm / 1000,
        xyz=None if target.xyz_mm is None else _metres(target.xyz_mm),
        sigma=None if sigma is None else _metres(sigma if isinstance(sigma, tuple) else (sigma,) * 3),
        polarity=target.polarity or polarity,
        normal=None if target.normal is None else _unit(target.normal),
    )


def _metres(values: Sequence[float]) -> tuple[float, float, float]:
    x, y, z = (v / 1000.0 for v in values)
    return (x, y, z)


def _unit(values: Sequence[float]) -> tuple[float, float, float]:
    length = float(np.linalg.norm(values))
    x, y, z = (v / length for v in values)
    return (x, y, z)


def check_ring_codes(body: BodyFile) -> None:
    """Refuse ids that no ring can show; matters where rings are read, not where targets come identified.

    Raises
    ------
    InvalidInput : an id is not the smallest of its cyclic readings.
    """
    faults = []
    for target in body.targets:
        code = target.id
        segments = ring_segments(target.code)
        if segments is None or code is None:
            continue
        if not 0 <= code < 1 << segments:
            faults.append(f"{body.path}: {code} is no {target.code} id: its segments give 0 to {(1 << segments) - 1}")
        elif not is_id(code, segments):
            faults.append(
                f"{body.path}: {code} is no {target.code} id: the id is the smallest of its cyclic readings, here "
                f"{canonical_id(code, segments)}"
            )
    if faults:
        raise InvalidInput(faults[0], faults)


def write_body(
    path: Path | str, body: Body, comment: str = "", board: Board | None = None, ring: RingPattern = RING12
) -> None:
    """Write a body with its coordinates atomically.

    ``sigma_mm`` is written for x, y and z apart; the full covariance has its place in the stage's cache. Coordinates of
    a ``board`` stand beside its layout; ``ring``: how its ring codes are printed.
    """
    sigma = None
    if body.covariance is not None:
        sigma = np.sqrt(np.clip(np.diag(body.covariance), 0, None)).reshape(-1, 3) * 1000
    targets = []
    for i, number in enumerate(body.ids):
        row: dict[str, Any] = FlowMapping(id=int(number), code=body.codes[i] if board is None else None)
        diameter = body.diameters[i]
        row["diameter_mm"] = round(float(diameter) * 1000, 9) if np.isfinite(diameter) else None
        row["xyz_mm"] = [round(float(v), 9) for v in body.points[i] * 1000]
        row["sigma_mm"] = None if sigma is None else [float(f"{v:.4g}") for v in sigma[i]]
        if body.normals is not None and np.isfinite(body.normals[i]).all():
            row["normal"] = [round(float(v), 6) for v in body.normals[i]]
        targets.append(row)
    data: dict[str, Any] = {"format": FORMAT}
    if board is not None:
        data["board"] = board_entry(board)
    if body.polarity != ("bright" if board is None else "dark"):
        data["polarity"] = body.polarity
    if (ring.inner, ring.outer, ring.clockwise) != (RING12.inner, RING12.outer, RING12.clockwise):
        direction = "clockwise" if ring.clockwise else "counterclockwise"
        data["ring"] = FlowMapping(inner=ring.inner, outer=ring.outer, direction=direction)
    data["targets"] = targets
    write_text(Path(path), yaml_text(data, comment))


def board_entry(board: Board) -> dict[str, Any]:
    """A board as it stands in a body file."""
    entry: dict[str, Any] = FlowMapping(kind=board.kind, columns=board.columns, rows=board.rows)
    for name in ("square", "marker", "spacing", "diameter"):
        length = getattr(board, name)
        if length is not None:
            entry[f"{name}_mm"] = round(length * 1000, 9)
    if board.dictionary is not None:
        entry["dictionary"] = board.dictionary
    return entry


def body_from_file(name: str, file: BodyFile) -> Body:
    """The targets that have an id; coordinates NaN where the file gives none.

    The covariance is that of the stated sigmas; targets without sigma count as exact, all of them if none has one.
    """
    rows = [t for t in file.targets if t.id is not None]
    if not rows:
        raise InvalidInput(f"{file.path}: no target has an id: give ids, or survey the body from images")
    points = np.array([t.xyz if t.xyz is not None else (np.nan,) * 3 for t in rows], dtype=float)
    covariance = None
    if any(t.sigma is not None for t in rows):
        sigma = np.array([t.sigma if t.sigma is not None else (0.0,) * 3 for t in rows], dtype=float)
        covariance = np.diag(sigma.ravel() ** 2)
    normals = None
    if any(t.normal is not None for t in rows):
        normals = np.array([t.normal if t.normal is not None else (np.nan,) * 3 for t in rows], dtype=float)
    return Body(
        name=name,
        ids=np.array([t.id for t in rows], dtype=np.int64),
        points=points,
        covariance=covariance,
        codes=tuple(t.code for t in rows),
        diameters=np.array([np.nan if t.diameter is None else t.diameter for t in rows], dtype=float),
        polarity=rows[0].polarity,
        normals=normals,
    )
