"""Dots of an image that are not numbered yet, and matching them with where targets are expected."""

from dataclasses import dataclass

import numpy as np
from scipy.optimize import linear_sum_assignment

from robcal.columns import Columns
from robcal.imaging.detections import Detections
from robcal.photogrammetry.core.bodies import IntArray
from robcal.transforms import Array


@dataclass(frozen=True)
class Dots(Columns):
    """Centres (m, 2) px with covariance (m, 2, 2), semi-axes (m, 2) px, the major one first, and contrast (m,)."""

    xy: Array
    covariance: Array
    semi_axes: Array
    contrast: Array

    def __len__(self) -> int:
        return len(self.xy)

    @classmethod
    def of(cls, detections: Detections, rows: IntArray) -> "Dots":
        """Some of the targets of an image."""
        return cls(detections.xy, detections.covariance, detections.semi_axes, detections.contrast).select(rows)

    @property
    def size(self) -> Array:
        """(m,) radius of the circle of the same area, px."""
        return np.sqrt(self.semi_axes.prod(axis=1))


def match_dots(
    predicted: Array, gate: Array, xy: Array, usable: Array | None = None, *, unique: bool = True
) -> tuple[IntArray, IntArray]:
    """One-to-one matches of predicted (n, 2) and measured (m, 2) dots within a radius ``gate`` (n,) px.

    Parameters
    ----------
    usable : (n, m) mask of admissible matches. unique : leave a target out when a second dot lies in its gate, and a
        dot when two targets claim it.

    Returns
    -------
    Rows of the targets and of the dots.
    """
    d = np.linalg.norm(predicted[:, None] - xy[None], axis=-1)
    inside = (d <= gate[:, None]) & np.isfinite(d)
    if usable is not None:
        inside &= usable
    if unique:
        good = inside & (inside.sum(axis=1) == 1)[:, None] & (inside.sum(axis=0) == 1)[None]
        rows, columns = np.nonzero(good)
        return rows, columns
    cost = np.where(inside, d / gate[:, None], 10.0)
    rows, columns = linear_sum_assignment(cost)
    keep = inside[rows, columns]
    return rows[keep], columns[keep]
