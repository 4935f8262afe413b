import numpy as np
import pytest

from fixtures.reseau import Tile, TrueReseau, draw_tile, grid_image
from robcal.errors import DegenerateGeometry
from robcal.imaging.grid_crosses import CrossSize, cross_values, find_crosses
from robcal.photogrammetry.tiles.transformation import Reseau, TileOrientation, orient_tile
from robcal.transforms import Array

TRUE = TrueReseau(columns=12, rows=12, tile_px=360)


def reseau(true: TrueReseau = TRUE) -> Reseau:
    y, x = np.mgrid[: true.rows, : true.columns] * true.pitch_mm / 1000.0
    size = CrossSize(true.line_um / true.pixel_um, true.arm_um / true.pixel_um)
    return Reseau(np.stack([x, y], axis=-1), true.glass_um * 1e-6, 1e-3, 1e-5, size)


def on_glass(tile: Tile, xy: Array) -> Array:
    q = np.column_stack([xy, np.ones(len(xy))]) @ np.linalg.inv(tile.glass_to_px).T
    return np.asarray(q[:, :2] / q[:, 2:])


def test_derivatives_of_a_cross() -> None:
    rng = np.random.default_rng(0)
    p = np.array([[0.3, -0.2, 0.02, 1.55, -0.1, 1.3, 180.0, 3.0, -2.0, -120.0]])
    x, y = rng.uniform(-15, 15, (2, 40))
    _, J = cross_values(p, x, y, 17.0)
    for k in range(10):
        step = 1e-6 * np.eye(10)[k]
        change = (cross_values(p + step, x, y, 17.0)[0] - cross_values(p - step, x, y, 17.0)[0]) / 2e-6
        np.testing.assert_allclose(J[0, :, k], change[0], rtol=1e-5, atol=1e-5)


def test_crosses_lie_within_their_covariance() -> None:
    squares, found = [], 0
    for seed in range(4):
        rng = np.random.default_rng(seed)
        tile = draw_tile(TRUE, np.array([5.5, 5.5]), rng)
        crosses = find_crosses(grid_image(TRUE, tile, rng), reseau().size)
        true = tile.pixels(TRUE.crosses().reshape(-1, 2))
        e = crosses.xy - true[np.linalg.norm(crosses.xy[:, None] - true, axis=2).argmin(axis=1)]
        assert np.abs(e).max() < 0.03
        squares.append(np.einsum("ni,nij,nj->n", e, np.linalg.inv(crosses.covariance), e))
        found += len(crosses)
    assert found >= 4 * 9
    assert 0.4 < np.mean(np.concatenate(squares)) / 2.0 < 1.5


@pytest.mark.parametrize("lost", [0.0, 0.3])
def test_a_tile_is_placed_within_its_covariance(lost: float) -> None:
    squares = []
    for seed in range(4):
        rng = np.random.default_rng([seed, 7])
        stop = np.array([5.5, 4.5])
        tile = draw_tile(TRUE, stop, rng)
        grid = grid_image(TRUE, tile, rng, lost)
        try:
            found = orient_tile(find_crosses(grid, reseau().size), reseau(), stop / 1000.0, grid.shape)
        except DegenerateGeometry:
            assert lost
            continue
        xy = rng.uniform(40, 320, (50, 2))
        mosaic, _, by_parameters = found.to_mosaic(xy)
        e = mosaic - reseau().mosaic(on_glass(tile, xy) / 1000.0)
        C = by_parameters @ found.covariance @ np.swapaxes(by_parameters, 1, 2)
        squares.append(np.mean(np.einsum("ni,nij,nj->n", e, np.linalg.inv(C), e)) / 2.0)
        assert np.abs(e).max() < 0.05
    assert len(squares) >= 2
    assert np.mean(squares) < 3.0


def test_derivatives_of_a_tile_against_differences() -> None:
    h = np.array([1.01, 0.02, 200.0, -0.015, 0.99, 180.0, 3e-5, -2e-5])
    tile = TileOrientation(h, np.zeros((8, 8)), np.array([500.0, 700.0]), "projective", 9, 0, 0.0)
    xy = np.random.default_rng(1).uniform(0, 400, (10, 2))
    _, by_xy, by_h = tile.to_mosaic(xy)
    for k in range(2):
        step = 1e-4 * np.eye(2)[k]
        change = (tile.to_mosaic(xy + step)[0] - tile.to_mosaic(xy - step)[0]) / 2e-4
        np.testing.assert_allclose(by_xy[:, :, k], change, rtol=1e-6, atol=1e-8)
    for k in range(8):
        step = 1e-7 * np.eye(8)[k]
        ends = [
            TileOrientation(h + s, tile.covariance, tile.origin, "", 9, 0, 0.0).to_mosaic(xy)[0] for s in (step, -step)
        ]
        np.testing.assert_allclose(by_h[:, :, k], (ends[0] - ends[1]) / 2e-7, rtol=1e-4, atol=1e-3)


def test_a_wrong_cross_is_left_out_and_too_few_are_refused() -> None:
    rng = np.random.default_rng(3)
    stop = np.array([5.5, 5.5])
    tile = draw_tile(TRUE, stop, rng)
    crosses = find_crosses(grid_image(TRUE, tile, rng), reseau().size)
    moved = crosses.xy.copy()
    moved[4] += [1.5, -0.8]
    wrong = type(crosses)(moved, crosses.covariance, crosses.contrast, crosses.misfit)
    found = orient_tile(wrong, reseau(), stop / 1000.0, (360, 360))
    assert found.crosses == len(crosses) - 1
    assert found.lost >= 1
    with pytest.raises(DegenerateGeometry, match="4 crosses of the grid found"):
        orient_tile(crosses.select(np.arange(4)), reseau(), stop / 1000.0, (360, 360))
