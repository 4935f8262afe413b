"""A mosaic of tiles behind a glass grid against one image of the sensor alone, of the same object.

``python -m benchmarks.reseau [--objects 3]``: a grid of 96 x 96 crosses (0.5 mm apart, known to 0.1 um), ten times the
side of a sensor of 480 px of 10 um; a flat object of 400 dots fills the format: in the mosaic, and, through a lens ten
times shorter, on the sensor alone. Both are rendered (blur 0.8 px, noise 1.5 grey values of 8 bit), found by the same
detector, and compared with the truth at the object, where a format is 2 m wide, after the best similarity of each.
``resolution`` is the error by the format. Drives stop within 0.1 mm, turn, scale and tilt of the sensor differ from
stop to stop, and 10 % of the crosses lie under dust.
"""

import argparse
import time

import numpy as np

from fixtures.reseau import TrueReseau, dots_image, draw_tile, grid_image, object_image
from robcal.errors import DegenerateGeometry
from robcal.imaging.detect import detect_targets
from robcal.imaging.detections import Detections
from robcal.imaging.grid_crosses import CrossSize
from robcal.imaging.settings import DetectionSettings
from robcal.photogrammetry.tiles.mosaic import OrientedTile, join_tiles, orient_by_image
from robcal.photogrammetry.tiles.transformation import Reseau
from robcal.transforms import Array

OBJECT_MM = 2000.0
RADIUS_MM = 0.3
"""Of a dot on the glass."""
SETTINGS = DetectionSettings(ring12=False)


def _errors(found: Detections, true: Array, by_format: float) -> tuple[Array, Array]:
    """Errors (n, 2) at the object, mm, after the best similarity, and the squared whitened ones (n,)."""
    nearest = np.linalg.norm(true[:, None] - found.xy, axis=2).argmin(axis=1)
    xy, C = found.xy[nearest], found.covariance[nearest]
    z, w = true @ [1, 1j], xy @ [1, 1j]
    A = np.column_stack([z, np.ones(len(z))])
    left = w - A @ np.linalg.lstsq(A, w, rcond=None)[0]
    e = np.stack([left.real, left.imag], axis=1)
    return e * by_format, np.einsum("ni,nij,nj->n", e, np.linalg.inv(C), e)


def one(seed: int) -> tuple[Array, Array, Array, int]:
    """Errors (mm) by the mosaic and by one tile, whitened squares of the mosaic, tiles left out."""
    rng = np.random.default_rng(seed)
    true = TrueReseau(columns=96, rows=96, pitch_mm=0.5, arm_um=150.0, seed=seed)
    y, x = np.mgrid[1.0:46.0:20j, 1.0:46.0:20j]
    dots = np.stack([x.ravel(), y.ravel()], axis=1) + rng.uniform(-0.5, 0.5, (400, 2))
    y, x = np.mgrid[: true.rows, : true.columns] * true.pitch_mm / 1000.0
    size = CrossSize(true.line_um / true.pixel_um, true.arm_um / true.pixel_um)
    reseau = Reseau(np.stack([x, y], axis=-1), true.glass_um * 1e-6, true.pitch_mm / 1000.0, 1e-5, size)
    tiles, lost = [], 0
    for stop in true.stops(overlap_px=80):
        tile = draw_tile(true, stop, rng)
        seen = detect_targets(object_image(true, tile, dots, RADIUS_MM, rng), SETTINGS)
        try:
            place = orient_by_image(grid_image(true, tile, rng, lost=0.1), reseau, stop / 1000.0)
        except DegenerateGeometry:
            lost += 1
            continue
        tiles.append(OrientedTile(seen, place))
    whole = join_tiles(tiles, reseau)
    side = 10.0 * true.tile_px
    mosaic, squares = _errors(whole, reseau.mosaic(dots / 1000.0), OBJECT_MM / side)
    small = 0.1 * (dots * 1000.0 / true.pixel_um) + 0.5
    image = dots_image(small, 0.1 * RADIUS_MM * 1000.0 / true.pixel_um, true.tile_px, true.noise, rng)
    alone, _ = _errors(detect_targets(image, SETTINGS), small, OBJECT_MM / true.tile_px)
    return mosaic, alone, squares, lost


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--objects", type=int, default=3)
    count = parser.parse_args().objects
    print("object  one tile mm  mosaic mm  ratio  resolution one tile, mosaic  NEES  tiles lost  seconds")
    for seed in range(count):
        begin = time.perf_counter()
        mosaic, alone, squares, lost = one(seed)
        a, b = (float(np.sqrt(np.mean(e**2))) for e in (alone, mosaic))
        print(
            f"{seed:6d}  {a:11.4f}  {b:9.5f}  {b / a:5.3f}  1 in {OBJECT_MM / a:9.0f}, 1 in {OBJECT_MM / b:9.0f}"
            f"  {np.mean(squares) / 2.0:5.2f}  {lost:10d}  {time.perf_counter() - begin:7.0f}"
        )


if __name__ == "__main__":
    main()
