"""Targets of an image that was taken in tiles behind a glass grid."""

from dataclasses import replace
from pathlib import Path

from robcal.errors import DegenerateGeometry, InvalidInput
from robcal.files.images import read_image
from robcal.files.reseau_file import TileFile, read_tiles
from robcal.imaging.detect import detect_targets
from robcal.imaging.detections import Detections
from robcal.imaging.settings import DetectionSettings
from robcal.photogrammetry.boards.detect import find_board
from robcal.photogrammetry.boards.layout import Board
from robcal.photogrammetry.tiles.mosaic import OrientedTile, join_tiles, orient_by_image
from robcal.photogrammetry.tiles.transformation import Reseau

MOST_LOST = 0.25
"""Share of the tiles that may fail."""


def detect_tiled(path: Path, reseau: Reseau, settings: DetectionSettings, board: Board | None) -> Detections:
    """The targets of all tiles of a list in px of the mosaic; its message names the tiles that were left out.

    Raises
    ------
    InvalidInput : too many tiles without crosses.
    """
    tiles, notes = [], []
    listed = read_tiles(path)
    for tile in listed:
        try:
            tiles.append(_one(tile, reseau, settings, board))
        except DegenerateGeometry as error:
            notes.append(f"{path}, row {tile.row}: tile {tile.image.name} is left out: {error}")
    if len(notes) > MOST_LOST * len(listed):
        raise InvalidInput(
            f"{notes[0]} ({len(notes)} of {len(listed)} tiles): check line_um, arm_um and pixel_um of the grid, and "
            "that x_mm, y_mm are the tile's middle on the plate to less than half a pitch"
        )
    joined = join_tiles(tiles, reseau)
    return replace(joined, message="; ".join(notes) or joined.message)


def _one(tile: TileFile, reseau: Reseau, settings: DetectionSettings, board: Board | None) -> OrientedTile:
    image = read_image(tile.image)
    grid = image if tile.grid == tile.image else read_image(tile.grid)
    if grid.shape != image.shape:
        raise InvalidInput(
            f"{tile.grid}: {grid.shape[1]} x {grid.shape[0]} px, but its tile {tile.image.name} has "
            f"{image.shape[1]} x {image.shape[0]}: both are taken at one stop of one sensor"
        )
    orientation = orient_by_image(grid, reseau, tile.centre)
    found = detect_targets(image, settings) if board is None else find_board(image, board, settings.polarity)
    return OrientedTile(found, orientation)


def tile_files(path: Path) -> list[Path]:
    """All image files of a list of tiles, each once."""
    return list(dict.fromkeys(file for tile in read_tiles(path) for file in (tile.image, tile.grid)))
