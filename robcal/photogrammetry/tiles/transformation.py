"""Orientation of a tile in the grid: its own affine or projective transformation onto the known crosses.

Reseau scanning (Wester-Ebbinghaus 1984; Riechmann 1990): a sensor is driven behind a glass plate with a grid ten times
its size; the crosses that it sees say where it was, so that nothing is asked of the drives.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from robcal.errors import DegenerateGeometry
from robcal.estimation.covariance import cofactor
from robcal.estimation.gauss_newton import gauss_newton
from robcal.estimation.grouping import whitener
from robcal.imaging.grid_crosses import Crosses, CrossSize
from robcal.transforms import Array

IntArray = NDArray[np.int64]

LEAST_CROSSES = 5
"""Three fix an affine transformation; two more let a wrong one be seen and left out."""
CRITICAL = 3.5
LEVEL = 0.01
MOST_MISSED = 1.0
"""px that crosses may be off the grid, root mean square."""
LARGEST_SCALE = 0.1
"""By which the scale of a tile may differ from that of the grid's file."""
AFFINE, PROJECTIVE = 6, 8


@dataclass(frozen=True)
class Reseau:
    """A glass plate with a grid of crosses.

    Attributes
    ----------
    places : (rows, columns, 2) of the crosses on the plate, m; x along the columns of the grid, y down.
    sigma : m, standard deviation of these. pitch : m.
    pixel : m, size of a pixel of the sensor, and of the mosaic.
    size : of the crosses in the image, px.
    """

    places: Array
    sigma: float
    pitch: float
    pixel: float
    size: CrossSize

    @property
    def shape(self) -> tuple[int, int]:
        """(height, width) of the mosaic: the grid and one pitch around it, px."""
        rows, columns = self.places.shape[:2]
        return round((rows + 1) * self.pitch / self.pixel), round((columns + 1) * self.pitch / self.pixel)

    def mosaic(self, place: Array) -> Array:
        """Pixels (..., 2) of the mosaic of places on the plate, m."""
        return (np.asarray(place) + self.pitch) / self.pixel


@dataclass(frozen=True)
class TileOrientation:
    """A tile in the mosaic.

    Attributes
    ----------
    parameters : (8,) of ``tile px = (h0 h1 h2; h3 h4 h5) (X, Y, 1)' / (1 + h6 X + h7 Y)``, (X, Y) in px of the mosaic
        from ``origin``; covariance : (8, 8), zero for what is held.
    origin : (2,) px of the mosaic. kind : 'affine' or 'projective'.
    crosses : used; lost : that should be in the tile and were not found or not used; rms : px, of the residuals.
    """

    parameters: Array
    covariance: Array
    origin: Array
    kind: str
    crosses: int
    lost: int
    rms: float

    def to_mosaic(self, xy: Array) -> tuple[Array, Array, Array]:
        """Pixels (n, 2) of the mosaic of those (n, 2) of the tile; derivatives by these and by the parameters.

        The equations are linear in the place; derivatives from the implicit function: ``dX = A^-1 (dxy - dh)``.
        """
        h = self.parameters
        matrix = np.empty((len(xy), 2, 2))
        matrix[:, 0, 0], matrix[:, 0, 1] = h[0] - xy[:, 0] * h[6], h[1] - xy[:, 0] * h[7]
        matrix[:, 1, 0], matrix[:, 1, 1] = h[3] - xy[:, 1] * h[6], h[4] - xy[:, 1] * h[7]
        X = np.asarray(np.linalg.solve(matrix, (xy - h[[2, 5]])[..., None])[..., 0], dtype=float)
        _, by_place, by_h = _project(h, X)
        by_xy = np.asarray(np.linalg.inv(by_place), dtype=float)
        return X + self.origin, by_xy, -by_xy @ by_h


def _project(h: Array, X: Array) -> tuple[Array, Array, Array]:
    """Pixels (n, 2) of the tile, derivatives by the place (n, 2, 2) and by the parameters (n, 2, 8)."""
    w = 1.0 / (1.0 + X @ h[6:])
    q = np.concatenate([X, np.ones((len(X), 1))], axis=1)
    xy = np.stack([q @ h[:3], q @ h[3:6]], axis=1) * w[:, None]
    by_h = np.zeros((len(X), 2, 8))
    by_h[:, 0, :3] = by_h[:, 1, 3:6] = q * w[:, None]
    by_h[:, :, 6:] = -xy[:, :, None] * X[:, None, :] * w[:, None, None]
    by_place = (h[[0, 1, 3, 4]].reshape(2, 2) - xy[:, :, None] * h[6:]) * w[:, None, None]
    return xy, by_place, by_h


def orient_tile(crosses: Crosses, reseau: Reseau, centre: Array, shape: tuple[int, int]) -> TileOrientation:
    """Orient a tile by its crosses.

    Parameters
    ----------
    centre : (2,) place of the tile's middle on the plate as it was driven, m, to less than half a pitch.
    shape : (height, width) of the tile, px.

    Raises
    ------
    DegenerateGeometry : too few crosses.
    """
    near = np.asarray(reseau.mosaic(centre))
    middle = 0.5 * (np.array(shape[::-1]) - 1.0)
    row, column = _assign(crosses.xy - middle, reseau, near)
    known = row >= 0
    if np.count_nonzero(known) < LEAST_CROSSES:
        raise DegenerateGeometry(f"{np.count_nonzero(known)} crosses of the grid found, {LEAST_CROSSES} are needed")
    place = reseau.mosaic(reseau.places[row, column]) - near
    covariance = crosses.covariance + (reseau.sigma / reseau.pixel) ** 2 * np.eye(2)
    used = _agreeing(place, crosses.xy, covariance, known)
    affine = _adjust(place, crosses.xy, covariance, used, AFFINE)
    kind, best = "affine", affine
    if np.count_nonzero(used) > LEAST_CROSSES:
        projective = _adjust(place, crosses.xy, covariance, used, PROJECTIVE)
        redundancy = 2 * int(np.count_nonzero(used)) - PROJECTIVE
        gain = (affine[2] - projective[2]) / 2.0 / max(projective[2] / redundancy, 1e-300)
        if stats.f.sf(gain, 2, redundancy) < LEVEL:
            kind, best = "projective", projective
    h, C, cost = best
    size = np.linalg.svd(h[[0, 1, 3, 4]].reshape(2, 2), compute_uv=False)
    if size[0] > 1.0 + LARGEST_SCALE or size[1] < 1.0 - LARGEST_SCALE:
        raise DegenerateGeometry(
            f"its crosses are {np.sqrt(size[0] * size[1]):.3g} times as far apart as pitch and pixel of the grid say"
        )
    rms = float(np.sqrt(np.mean((crosses.xy - _project(h, place)[0])[used] ** 2)))
    if rms > MOST_MISSED:
        raise DegenerateGeometry(f"its crosses miss the grid by {rms:.3g} px")
    count = int(np.count_nonzero(used))
    redundancy = max(2 * count - (AFFINE if kind == "affine" else PROJECTIVE), 1)
    factor = max(1.0, cost / redundancy)
    seen = _within(reseau, near, h, shape)
    return TileOrientation(h, factor * C, near, kind, count, max(0, seen - count), rms)


def _assign(offset: Array, reseau: Reseau, near: Array) -> tuple[IntArray, IntArray]:
    """Row and column (n,) in the grid of crosses at ``offset`` (n, 2) px from the tile's middle; -1 beyond the grid.

    The drives' error is the circular mean of what the offsets leave beside whole pitches; a second round follows an
    affine transformation, which takes up the turn of the sensor.
    """
    pitch = reseau.pitch / reseau.pixel
    grid = (offset + near) / pitch - 1.0
    phase = np.exp(2j * np.pi * grid).mean(axis=0) if len(grid) else np.ones(2)
    node = np.round(grid - np.angle(phase) / (2 * np.pi)).astype(np.int64)
    if len(node) >= LEAST_CROSSES:
        q = np.column_stack([offset, np.ones(len(offset))])
        weight = np.ones(len(q))
        for _ in range(10):
            A = np.linalg.lstsq(weight[:, None] * q, weight[:, None] * node, rcond=None)[0]
            weight = 1.0 / np.sqrt(np.maximum(np.linalg.norm(node - q @ A, axis=1), 0.02))
        node = np.round(q @ A).astype(np.int64)
    rows, columns = reseau.places.shape[:2]
    inside = (node >= 0).all(axis=1) & (node[:, 0] < columns) & (node[:, 1] < rows)
    twice = np.zeros(len(node), dtype=bool)
    for key in {tuple(n) for n in node.tolist()}:
        same = (node == key).all(axis=1)
        twice |= same & (same.sum() > 1)
    good = inside & ~twice
    return np.where(good, node[:, 1], -1), np.where(good, node[:, 0], -1)


def _agreeing(place: Array, xy: Array, covariance: Array, known: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Crosses that agree with one transformation: the worst is left out as long as it contradicts all others."""
    used = known.copy()
    while np.count_nonzero(used) > LEAST_CROSSES:
        h, _, _ = _adjust(place, xy, covariance, used, AFFINE if np.count_nonzero(used) < 8 else PROJECTIVE)
        r = np.einsum("nij,nj->ni", whitener(covariance), xy - _project(h, place)[0])
        size = np.where(used, np.linalg.norm(r, axis=1), 0.0)
        scatter = max(1.0, float(np.median(size[used])) / 1.18)
        worst = int(np.argmax(size))
        if size[worst] <= CRITICAL * scatter:
            break
        used[worst] = False
    return used


def _adjust(
    place: Array, xy: Array, covariance: Array, used: NDArray[np.bool_], count: int
) -> tuple[Array, Array, float]:
    """Parameters (8,), covariance (8, 8) and sum of squares of the affine or projective transformation."""
    W = whitener(covariance[used])
    free = np.arange(count)

    def linearise(h: Array) -> tuple[Array, Array]:
        predicted, _, by_h = _project(h, place[used])
        return (W @ (xy[used] - predicted)[..., None]).ravel(), (W @ by_h[..., free]).reshape(-1, count)

    def moved(h: Array, step: Array) -> Array:
        out = h.copy()
        out[free] += step
        return out

    q = np.column_stack([place[used], np.ones(int(used.sum()))])
    start = np.zeros(8)
    start[:6] = np.linalg.lstsq(q, xy[used], rcond=None)[0].T.ravel()
    h, summary = gauss_newton(linearise, lambda h: linearise(h)[0], moved, start)
    C = np.zeros((8, 8))
    C[:count, :count] = cofactor(linearise(h)[1])
    return h, C, 2.0 * summary.cost


def _within(reseau: Reseau, near: Array, h: Array, shape: tuple[int, int]) -> int:
    """How many crosses lie wholly in the tile."""
    xy, _, _ = _project(h, (reseau.mosaic(reseau.places) - near).reshape(-1, 2))
    margin = reseau.size.arm
    return int(((xy > margin) & (xy < np.array(shape[::-1]) - 1.0 - margin)).all(axis=1).sum())
