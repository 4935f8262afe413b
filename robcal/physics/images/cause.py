"""Causes of image residuals."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from robcal.cause import Cause, Kind, describe
from robcal.physics.cause import Array, Report

ECCENTRICITY = Kind(
    "ellipse_eccentricity",
    "image",
    "ellipse eccentricity",
    "Dots seen obliquely by {where} show off their centres as dots of {diameter_mm:.1f} mm do",
    displaces_marks=True,
)
CENTROID_BIAS = Kind("centroid_bias", "image", "bias of the dots' centres", displaces_marks=True)
UNKNOWN_FIELD = Kind(
    "unknown",
    "camera",
    "unknown, described by an empirical term",
    "The images of {where} are bent in a manner that no lens model of the library describes",
    named=False,
)


@dataclass(frozen=True)
class ImageCause(Cause):
    """A candidate: where it acts, its columns, the typical size of its parameters, and how they are reported.

    `columns` (m, 2, q) px per unit of the parameters; `plausible` refuses estimates that physics forbids; `least_gain`
    is the share by which the prediction of marks must improve for the cause to be worth a name; `twins` are (kind,
    where) of others with the very same columns; `pose` the first image of a moved camera; `bends`: told from a smooth
    field over the image only by its form; `once`: the other candidates of that kind and place are the same cause with
    other constants; `places`: what it is reported of, one by one, where it acts in several (`where` is then a name for
    all of them).
    """

    columns: Array
    sizes: Array
    report: Report
    sentence: str = ""
    weight: float = 1.0
    plausible: Callable[[Array], bool] = lambda values: True
    least_gain: float = 0.0
    twins: tuple[tuple[Kind, str], ...] = ()
    pose: int | None = None
    bends: bool = False
    once: bool = True
    places: tuple[str, ...] = ()

    @property
    def locations(self) -> tuple[str, ...]:
        """All places."""
        return self.places or (self.where,)

    def describe(self, where: str, reported: Mapping[str, object]) -> str:
        """The sentence for one of its places."""
        return describe(self.sentence or self.kind.sentence, where, self.direction, reported)


def only(rows: Array, values: Array) -> Array:
    """Displacements (m, 2, q) of some marks, zero elsewhere."""
    return np.where(rows[:, None, None], values, 0.0)
