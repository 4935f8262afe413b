"""Whether what gives the scale of a survey agrees with everything else that has a length: units go wrong first."""

import numpy as np

from robcal.errors import InvalidInput
from robcal.photogrammetry.bundle.body_frame import fit_similarity
from robcal.photogrammetry.bundle.datum import spans_triangle
from robcal.photogrammetry.core.network import CameraNetwork, Lengths
from robcal.transforms import Array

COORDINATES = 2.0
"""Given coordinates or check lengths off the scale by more than this factor are in another unit."""
DIAMETERS = 10.0
"""Dots that look this much larger or smaller than stated are; a ring's diameter in place of its dot's is within."""
_NOTE = 0.01
"""Relative deviation of given coordinates from which on it is mentioned."""
_UNIT = "check the unit of length_mm, xyz_mm and diameter_mm, all are in millimetres"


def rough_scale(network: CameraNetwork, bars: Lengths) -> float:
    """Factor that brings a network in any scale to the lengths of its scale bars."""
    return float(np.median(1.0 / _relative(network, bars, 1.0)))


def _relative(network: CameraNetwork, lengths: Lengths, scale: float) -> Array:
    """Measured by stated lengths (k,), NaN where an end is not measured."""
    place = {int(i): row for row, i in enumerate(network.ids)}
    ratios = np.full(len(lengths), np.nan)
    for k, (a, b) in enumerate(lengths.ids.tolist()):
        if a in place and b in place:
            ratios[k] = scale * np.linalg.norm(network.points[place[a]] - network.points[place[b]]) / lengths.length[k]
    return ratios


def scale_notes(
    network: CameraNetwork, given: Array, bars: Lengths, checks: Lengths, scale: float, size_ratio: float | None
) -> list[str]:
    """What does not agree with the scale, in sentences.

    Parameters
    ----------
    network : in a scale of its own; ``scale`` brings it to metres by the bars (without bars by ``given``).
    given : (t, 3) given coordinates, NaN where unknown.
    size_ratio : dots' diameters in the network's own scale by stated ones, None where nothing can be compared.

    Raises
    ------
    InvalidInput : something is off by so much that it must be in another unit.
    """
    notes: list[str] = []
    source = "scale bars" if len(bars) else "given coordinates"
    for (a, b), ratio in zip(checks.ids.tolist(), _relative(network, checks, scale), strict=True):
        if ratio >= COORDINATES or ratio <= 1.0 / COORDINATES:
            raise InvalidInput(f"check length {a}-{b} is measured {ratio:.2g} times as long as stated: {_UNIT}")
    known = np.isfinite(given).all(axis=1)
    if len(bars) and np.count_nonzero(known) >= 3 and spans_triangle(given[known]):
        ratio = scale / fit_similarity(given[known], network.points[known], with_scale=True).scale
        if not 1.0 / COORDINATES < ratio < COORDINATES:
            raise InvalidInput(f"the {source} make the body {ratio:.2g} times as large as its coordinates: {_UNIT}")
        if abs(ratio - 1.0) > _NOTE:
            notes.append(f"the {source} make the body {100 * (ratio - 1):+.2g} % larger than its given coordinates")
    if size_ratio is not None:
        ratio = scale * size_ratio
        if not 1.0 / DIAMETERS < ratio < DIAMETERS:
            raise InvalidInput(f"by the {source} dots are {ratio:.2g} times as large as their diameters: {_UNIT}")
        if not 0.8 < ratio < 1.25:
            notes.append(
                f"dots are {ratio:.2f} times as large as stated: diameter_mm is that of the inner dot; the measured "
                "diameters are used"
            )
    return notes
