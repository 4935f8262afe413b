"""Measuring bodies: targets with ids, coordinates and their covariance, as carried by the flange or surveyed."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import combinations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from robcal.errors import InvalidInput
from robcal.transforms import Array

IntArray = NDArray[np.int64]

_PLANE_RATIO = 0.02
"""A body whose thickness is below this share of its width is treated as a plane (two-fold resection)."""
_ON_SPHERE = 0.02
"""Radii of a sphere's targets may differ by this share of it."""


@dataclass(frozen=True)
class Body:
    """Targets that move together.

    Attributes
    ----------
    name : for messages.
    ids : (t,) int, unique.
    points : (t, 3) m in the body frame; NaN where a coordinate is not known.
    covariance : (3t, 3t) m^2 of the coordinates, None where nothing is known about their accuracy (taken as exact).
    codes : (t,) 'ring12', 'aruco:<dictionary>', 'corner' or None for an uncoded dot.
    diameters : (t,) m of the (inner) dot, NaN where unknown.
    polarity : 'bright' or 'dark' dots.
    normals : (t, 3) outward unit normals of the dots, None: estimated from the geometry where that is possible.
    """

    name: str
    ids: IntArray
    points: Array
    covariance: Array | None = None
    codes: tuple[str | None, ...] = ()
    diameters: Array = field(default_factory=lambda: np.empty(0))
    polarity: str = "bright"
    normals: Array | None = None

    def __post_init__(self) -> None:
        ids = np.asarray(self.ids, dtype=np.int64)
        points = np.asarray(self.points, dtype=float)
        t = len(ids)
        if points.shape != (t, 3):
            raise InvalidInput(f"body {self.name}: {t} ids but coordinates of shape {points.shape}")
        values, counts = np.unique(ids, return_counts=True)
        if np.any(counts > 1):
            raise InvalidInput(f"body {self.name}: target id {values[counts > 1][0]} is listed more than once")
        if np.any(np.isinf(points)):
            raise InvalidInput(f"body {self.name}: infinite coordinates of target {ids[np.isinf(points).any(1)][0]}")
        diameters = np.asarray(self.diameters, dtype=float)
        if diameters.size == 0:
            diameters = np.full(t, np.nan)
        codes = tuple(self.codes) if self.codes else (None,) * t
        if len(codes) != t or diameters.shape != (t,):
            raise InvalidInput(f"body {self.name}: codes and diameters must have one entry per target")
        if self.covariance is not None and np.shape(self.covariance) != (3 * t, 3 * t):
            raise InvalidInput(f"body {self.name}: covariance of shape {np.shape(self.covariance)} for {t} targets")
        if self.polarity not in ("bright", "dark"):
            raise InvalidInput(f"body {self.name}: polarity is bright or dark, not {self.polarity!r}")
        for name, value in (("ids", ids), ("points", points), ("codes", codes), ("diameters", diameters)):
            object.__setattr__(self, name, value)
        for value in (ids, points, diameters):
            value.setflags(write=False)

    def __len__(self) -> int:
        return len(self.ids)

    @property
    def known(self) -> NDArray[np.bool_]:
        """(t,) true where all three coordinates are known."""
        return np.asarray(np.isfinite(self.points).all(axis=1))

    def index(self, ids: ArrayLike) -> IntArray:
        """Positions of ids in this body, -1 where the body has no such target."""
        wanted = np.asarray(ids, dtype=np.int64)
        if len(self) == 0:
            return np.full(wanted.shape, -1, dtype=np.int64)
        order = np.argsort(self.ids)
        at = np.clip(np.searchsorted(self.ids[order], wanted), 0, len(self) - 1)
        found = order[at]
        return np.where(self.ids[found] == wanted, found, -1)

    def select(self, rows: Sequence[int] | IntArray | NDArray[np.bool_]) -> "Body":
        """The body reduced to some of its targets (indices or mask), covariance marginalised accordingly."""
        at = np.arange(len(self))[np.asarray(rows)]
        columns = (3 * at[:, None] + np.arange(3)).ravel()
        return Body(
            self.name,
            self.ids[at].copy(),
            self.points[at].copy(),
            None if self.covariance is None else self.covariance[np.ix_(columns, columns)],
            tuple(self.codes[i] for i in at),
            self.diameters[at].copy(),
            self.polarity,
            None if self.normals is None else self.normals[at],
        )

    def is_plane(self) -> bool:
        """True when the known targets are (nearly) in one plane, so that one camera sees two possible poses."""
        return thickness_ratio(self.points[self.known]) < _PLANE_RATIO

    def estimated_normals(self) -> Array:
        """Outward normals (t, 3): given ones, the plane's normal (sign open) or those of a fitted sphere; else NaN.

        The sign does not matter for the eccentricity of a circle's image. Weakness: a body of several planes gets NaN
        (no eccentricity correction) unless its normals are given.
        """
        if self.normals is not None:
            return np.asarray(self.normals, dtype=float)
        out = np.full((len(self), 3), np.nan)
        known = self.known
        p = self.points[known]
        if len(p) < 3:
            return out
        centred = p - p.mean(axis=0)
        if self.is_plane():
            out[:] = np.linalg.svd(centred)[2][2]
        elif len(p) >= 8:
            rays = centred - _sphere_centre(centred)
            radii = np.linalg.norm(rays, axis=1)
            width = float(np.median(np.linalg.norm(p - np.median(p, axis=0), axis=1)))
            if np.std(radii) < 0.02 * min(float(np.mean(radii)), width):
                out[known] = rays / radii[:, None]
        return out

    def marginal(self, row: int) -> Array:
        """(3, 3) covariance of one target, zeros where the coordinates are taken as exact."""
        if self.covariance is None:
            return np.zeros((3, 3))
        return self.covariance[3 * row : 3 * row + 3, 3 * row : 3 * row + 3]


def fit_sphere(points: ArrayLike, name: str = "") -> tuple[Array, float]:
    """Centre (3,) and radius (m) of the sphere through points (n, 3), by algebraic least squares.

    Raises
    ------
    InvalidInput : fewer than four points, points in a plane, or points that are on no sphere.
    """
    p = np.asarray(points, dtype=float)
    message = f"body '{name}'" if name else "the body"
    if len(p) < 4 or thickness_ratio(p) < _PLANE_RATIO:
        raise InvalidInput(f"{message} is no sphere: at least four targets with coordinates that are not in a plane")
    middle = p.mean(axis=0)
    centre = middle + _sphere_centre(p - middle)
    radii = np.linalg.norm(p - centre, axis=1)
    radius = float(radii.mean())
    if np.ptp(radii) > _ON_SPHERE * radius:
        worst = int(np.argmax(np.abs(radii - radius)))
        raise InvalidInput(
            f"{message} is no sphere: its targets are {1e3 * radii.min():.2f} to {1e3 * radii.max():.2f} mm from one "
            f"centre (row {worst + 1} of its targets is farthest off): check the coordinates"
        )
    return centre, radius


def _sphere_centre(p: Array) -> Array:
    """Centre of the algebraic sphere ``|p|^2 = 2 p.c + (r^2 - c^2)`` through points (n, 3)."""
    design = np.column_stack([2.0 * p, np.ones(len(p))])
    return np.asarray(np.linalg.lstsq(design, np.sum(p**2, axis=1), rcond=None)[0][:3])


def thickness_ratio(points: ArrayLike) -> float:
    """Smallest by second singular value of centred points (n, 3); 0 for a perfect plane or fewer than four points."""
    p = np.asarray(points, dtype=float)
    if len(p) < 4:
        return 0.0
    s = np.linalg.svd(p - p.mean(axis=0), compute_uv=False)
    return float(s[2] / s[1]) if s[1] > 0 else 0.0


def line_ratio(points: ArrayLike) -> float:
    """Second by first singular value of centred points (n, 3): 0 when all lie in one line (or fewer than three)."""
    p = np.asarray(points, dtype=float)
    if len(p) < 3:
        return 0.0
    s = np.linalg.svd(p - p.mean(axis=0), compute_uv=False)
    return float(s[1] / s[0]) if s[0] > 0 else 0.0


_ACROSS = 0.02
"""Targets whose spread across their line is below this share of that along it carry no frame."""


def spans_plane(points: ArrayLike) -> bool:
    """True if points (n, 3) carry a frame: at least three, and not (nearly) in one line."""
    return line_ratio(points) >= _ACROSS


def pairs(n: int) -> IntArray:
    """All index pairs (k, 2) with i < j of n items."""
    return np.array(list(combinations(range(n), 2)), dtype=np.int64).reshape(-1, 2)
