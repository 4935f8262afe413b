"""Given coordinates of a body against its survey: targets that contradict it, and mirror images."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from robcal.errors import DegenerateGeometry
from robcal.photogrammetry.bundle.body_frame import fit_similarity
from robcal.photogrammetry.core.bodies import IntArray
from robcal.transforms import Array, transform

FEWEST = 4
CONTRADICTS = 6.0
"""A given coordinate contradicts the survey if it is off by so many of its sigmas and of the usual deviation."""
LEAST = 2e-4
"""Deviation (m) from which a coordinate that states no sigma may contradict."""
MIRRORED = 0.2
"""Miss of the mirrored coordinates by that of the coordinates as given, below which they are called mirrored."""


@dataclass(frozen=True)
class GivenCoordinates:
    """What the survey says about the coordinates that were given.

    Attributes
    ----------
    contradicting : (id, deviation in m, stated sigma in m or NaN) of targets that the survey refutes, largest first.
    mirrored : median deviation (m) as given and of their mirror image where only the latter fits, else None.
    """

    contradicting: tuple[tuple[int, float, float], ...] = ()
    mirrored: tuple[float, float] | None = None

    @property
    def mirrored_mm(self) -> list[float] | None:
        """The same in mm."""
        return None if self.mirrored is None else [1e3 * value for value in self.mirrored]

    @property
    def mirror_words(self) -> str:
        """The mirror image with its proof."""
        typical, other = self.mirrored_mm or (np.nan, np.nan)
        return (
            f"survey and given coordinates are mirror images of each other (they differ by {typical:.3g} mm, mirrored "
            f"by {other:.2g} mm)"
        )

    def sentences(self, body: str) -> list[str]:
        """One sentence for each contradiction."""
        out = []
        for number, deviation, sigma in self.contradicting:
            stated = f" (sigma {1e3 * sigma:.2g} mm)" if np.isfinite(sigma) else ""
            out.append(
                f"the given coordinates of target {number} of '{body}' contradict the survey by "
                f"{1e3 * deviation:.3g} mm{stated}: correct the body file"
            )
        return out


def compare_given(ids: IntArray, surveyed: Array, given: Array, sigma: Array) -> GivenCoordinates:
    """Compare surveyed (t, 3) with given coordinates (t, 3), NaN where unknown; sigma (t,) of the given ones, m.

    A plane body cannot tell a mirror image.
    """
    known = np.isfinite(given).all(axis=1)
    if np.count_nonzero(known) < FEWEST:
        return GivenCoordinates()
    straight = _deviations(given[known], surveyed[known])
    mirror = _deviations(given[known], surveyed[known] * [1.0, 1.0, -1.0])
    noise = np.where(np.isfinite(sigma[known]), sigma[known], LEAST)
    typical, other = float(np.median(straight)), float(np.median(mirror))
    if other < MIRRORED * typical and typical > CONTRADICTS * float(np.median(noise)):
        return GivenCoordinates(mirrored=(typical, other))
    off = (straight > CONTRADICTS * noise) & (straight > CONTRADICTS * typical)
    rows: Sequence[int] = np.flatnonzero(off)[np.argsort(-straight[off])].tolist()
    names, stated = ids[known], sigma[known]
    return GivenCoordinates(tuple((int(names[i]), float(straight[i]), float(stated[i])) for i in rows))


def _deviations(given: Array, surveyed: Array) -> Array:
    """Distances (t,) after a robust fit."""
    try:
        fit = fit_similarity(given, surveyed, with_scale=False, rounds=20)
    except DegenerateGeometry:
        return np.full(len(given), np.inf)
    return np.asarray(np.linalg.norm(given - transform(fit.new_T_old, surveyed), axis=1))
