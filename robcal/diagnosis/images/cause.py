"""A candidate cause of image residuals."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from robcal.physics.cause import Array


@dataclass(frozen=True)
class ImageCause:
    """A candidate: where it acts, its columns, the typical size of its parameters, and how they are told.

    `plausible` refuses estimates that physics forbids; `least_gain` is the share by which the prediction of marks must
    improve for the cause to be worth a name; `twins` are (cause, where) of others with the very same columns; `pose`
    the first image of a moved camera; `bends`: told from a smooth field over the image only by its form; `once`: the
    other candidates of that name and place are the same cause with other constants; `places`: what it is told of, one
    by one, where it acts in several (`where` is then a name for all of them).
    """

    cause: str
    stage: str
    where: str
    direction: str | None
    columns: Array
    sizes: Array
    report: Callable[[Array], dict[str, object]]
    sentence: str
    weight: float = 1.0
    plausible: Callable[[Array], bool] = lambda values: True
    least_gain: float = 0.0
    twins: tuple[tuple[str, str], ...] = ()
    pose: int | None = None
    bends: bool = False
    once: bool = True
    places: tuple[str, ...] = ()

    @property
    def told_of(self) -> tuple[str, ...]:
        """All places."""
        return self.places or (self.where,)


def only(rows: Array, values: Array) -> Array:
    """Displacements (m, 2, q) of some marks, zero elsewhere."""
    return np.where(rows[:, None, None], values, 0.0)
