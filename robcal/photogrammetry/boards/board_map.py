"""Smooth map from a board's plane to the image, from marks: a homography and a cubic for what the lens adds to it.

No camera is needed; the map tells where further marks are, how squares lean, how lines bend, which marks do not fit.
"""

from dataclasses import dataclass

import cv2
import numpy as np

from robcal.transforms import Array

_CUBIC_FROM, _SQUARE_FROM = 20, 12
"""Marks from which a cubic, a quadratic part is estimated."""
_ROUNDS = 4
_CUT = 4.0
"""Robust weights fall beyond this many standard deviations of the marks."""


@dataclass(frozen=True)
class BoardMap:
    """Homography and polynomial of centred and scaled board coordinates.

    Attributes
    ----------
    centre : (2,) m. scale : m. homography : (3, 3). bend : (k, 2) px of the monomials up to the third degree.
    sigma : px of a coordinate of the marks around the map.
    """

    centre: Array
    scale: float
    homography: Array
    bend: Array
    sigma: float

    def __call__(self, xy: Array) -> Array:
        """Pixels (..., 2) of places (..., 2) m on the board."""
        p = (np.asarray(xy, dtype=float) - self.centre) / self.scale
        h = np.concatenate([p, np.ones_like(p[..., :1])], axis=-1) @ self.homography.T
        return h[..., :2] / h[..., 2:] + _monomials(p, len(self.bend)) @ self.bend

    def derivatives(self, xy: Array) -> tuple[Array, Array]:
        """First (n, 2, 2) px/m and second (n, 2, 2) px/m^2 derivatives along both axes; last index: the axis."""
        xy = np.asarray(xy, dtype=float)
        step = 1e-3 * self.scale
        first, second = np.empty((len(xy), 2, 2)), np.empty((len(xy), 2, 2))
        here = self(xy)
        for axis in range(2):
            along = step * np.eye(2)[axis]
            ahead, behind = self(xy + along), self(xy - along)
            first[:, :, axis] = (ahead - behind) / (2 * step)
            second[:, :, axis] = (ahead - 2 * here + behind) / step**2
        return first, second


def fit_map(board_xy: Array, image_xy: Array) -> BoardMap | None:
    """Robust map through marks: places (n, 2) m and pixels (n, 2); None for fewer than four or marks in a line."""
    if len(board_xy) < 4:
        return None
    centre = board_xy.mean(axis=0)
    scale = float(np.abs(board_xy - centre).max())
    if scale <= 0 or np.linalg.matrix_rank(board_xy - centre, tol=1e-6 * scale) < 2:
        return None
    p = (board_xy - centre) / scale
    terms = 10 if len(p) >= _CUBIC_FROM else 6 if len(p) >= _SQUARE_FROM else 0
    weight = np.ones(len(p))
    homography: Array = np.eye(3)
    bend: Array = np.zeros((terms, 2))
    sigma = 0.0
    for _ in range(_ROUNDS):
        good = weight > 0.05
        if good.sum() < max(4, terms + 2):
            return None
        found, _ = cv2.findHomography(p[good], (image_xy - _monomials(p, terms) @ bend)[good], 0)
        if found is None:
            return None
        homography = np.asarray(found, dtype=float)
        flat = BoardMap(centre, scale, homography, np.zeros((0, 2)), 0.0)(board_xy)
        if terms:
            design = _monomials(p, terms)
            bend = np.asarray(
                np.linalg.lstsq(design * weight[:, None], (image_xy - flat) * weight[:, None], rcond=None)[0],
                dtype=float,
            )
        away = np.linalg.norm(image_xy - flat - _monomials(p, terms) @ bend, axis=1)
        # median of a Rayleigh distribution
        sigma = max(float(np.median(away)) / 1.1774, 1e-3)
        weight = np.minimum(1.0, (_CUT * sigma / np.maximum(away, 1e-12)) ** 2)
    return BoardMap(centre, scale, homography, bend, sigma)


def _monomials(p: Array, count: int) -> Array:
    x, y = p[..., 0], p[..., 1]
    one = np.ones_like(x)
    columns = [one, x, y, x * x, x * y, y * y, x**3, x * x * y, x * y * y, y**3]
    return np.stack(columns[:count], axis=-1) if count else np.zeros((*x.shape, 0))
