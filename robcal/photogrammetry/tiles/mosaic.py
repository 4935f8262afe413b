"""Targets of a mosaic: those of its tiles in the coordinates of the grid, each once."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from robcal.errors import DegenerateGeometry
from robcal.imaging.detections import Detections, RejectionLog, empty_columns
from robcal.imaging.grid_crosses import find_crosses
from robcal.imaging.noise import NoiseModel
from robcal.photogrammetry.tiles.transformation import Reseau, TileOrientation, orient_tile
from robcal.transforms import Array

SAME_SIGMA, SAME_LEAST = 8.0, 0.5
"""Two marks of neighbouring tiles nearer than so many standard deviations, or px, are one target."""


@dataclass(frozen=True)
class OrientedTile:
    """A tile's targets, and where the tile is."""

    found: Detections
    orientation: TileOrientation


def orient_by_image(image: NDArray, reseau: Reseau, centre: Array) -> TileOrientation:
    """Orient a tile by the image of its crosses (h, w); ``centre`` (2,) of its middle on the plate as driven, m.

    Raises
    ------
    DegenerateGeometry : too few crosses.
    """
    return orient_tile(find_crosses(image, reseau.size), reseau, centre, (image.shape[0], image.shape[1]))


def join_tiles(tiles: Sequence[OrientedTile], reseau: Reseau) -> Detections:
    """The targets of all tiles in px of the mosaic.

    The covariance of a mark is that of its tile's fit and of the tile's orientation; weakness: marks of one tile share
    the latter, but count as independent. A target that several tiles show is taken from the tile that has it best.

    Raises
    ------
    DegenerateGeometry : there are no tiles.
    """
    if not tiles:
        raise DegenerateGeometry("no tile could be oriented in the grid")
    columns = [_in_mosaic(tile) for tile in tiles]
    joined = {name: np.concatenate([c[name] for c in columns]) for name in empty_columns()}
    tile = np.repeat(np.arange(len(tiles)), [len(t.found) for t in tiles])
    keep = _once(joined["xy"], joined["covariance"], joined["code"], tile)
    noise = [t.found.noise for t in tiles]
    log = RejectionLog()
    return Detections(
        shape=reseau.shape,
        **{name: column[keep] for name, column in joined.items()},
        noise=_usual(noise),
        rejected=log.result(),
        message="" if keep.any() else "no targets in any tile",
    )


def _usual(noise: Sequence[NoiseModel]) -> NoiseModel:
    middle = {name: float(np.median([getattr(n, name) for n in noise])) for name in ("variance", "gain", "level")}
    return replace(noise[0], **middle)


def _in_mosaic(tile: OrientedTile) -> dict[str, NDArray]:
    """Columns of a tile's targets, geometry in px of the mosaic."""
    columns = dict(tile.found.columns())
    if not len(tile.found):
        return columns
    xy, by_xy, by_parameters = tile.orientation.to_mosaic(columns["xy"])
    turned, shared = np.swapaxes(by_xy, 1, 2), np.swapaxes(by_parameters, 1, 2)
    covariance = by_xy @ columns["covariance"] @ turned + by_parameters @ tile.orientation.covariance @ shared
    c, s = np.cos(columns["angle"]), np.sin(columns["angle"])
    axes = np.stack([np.stack([c, -s], axis=-1), np.stack([s, c], axis=-1)], axis=-2)
    shape = axes @ (columns["semi_axes"][:, :, None] ** 2 * np.swapaxes(axes, 1, 2))
    values, vectors = np.linalg.eigh(by_xy @ shape @ turned)
    return columns | {
        "xy": xy,
        "covariance": covariance,
        "semi_axes": np.sqrt(values[:, ::-1]),
        "angle": np.arctan2(vectors[:, 1, 1], vectors[:, 0, 1]),
    }


def _once(xy: Array, covariance: Array, code: NDArray, tile: NDArray) -> NDArray[np.bool_]:
    """Marks to keep, the best of each target: those of two tiles at the same place, or with the same code near it."""
    keep = np.ones(len(xy), dtype=bool)
    if len(xy) < 2:
        return keep
    size = np.trace(covariance, axis1=1, axis2=2)
    reach = np.maximum(SAME_SIGMA * np.sqrt(size), SAME_LEAST)
    for i, j in cKDTree(xy).query_pairs(2.0 * float(reach.max())):
        apart = float(np.linalg.norm(xy[i] - xy[j]))
        if tile[i] != tile[j] and apart < max(reach[i], reach[j]):
            coded = [code[i] >= 0, code[j] >= 0]
            worse = (j if coded[0] else i) if coded[0] != coded[1] else (i if size[i] > size[j] else j)
            keep[worse] = False
    return keep
