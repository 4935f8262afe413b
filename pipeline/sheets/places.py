"""Where the targets of a plate or sphere lie, and which of them are coded."""

import numpy as np

from pipeline.sheets.schema import RingTargets
from robcal.errors import InvalidInput
from robcal.imaging.ring_code import SEGMENTS, canonical_id, is_id
from robcal.transforms import Array

FIRST_PLAIN = 4096
"""Ids of plain dots begin above all ring12 ids."""
_BRIGHT = (4, 8)
"""Bright segments of the ids that are chosen: neither a dot with a speck nor a nearly closed ring."""


def chosen_ids(targets: RingTargets, where: str) -> list[int]:
    """Ids to print: those listed, or the first so many.

    Raises
    ------
    InvalidInput : no ring12 id, an id twice, more than there are.
    """
    if targets.ids is not None:
        for number in targets.ids:
            if not 0 <= number < 1 << SEGMENTS or not is_id(number):
                shown = f": the smallest of its cyclic readings is {canonical_id(number)}" if 0 <= number < 4096 else ""
                raise InvalidInput(f"{where}: {number} is no ring12 id{shown}")
            if targets.ids.count(number) > 1:
                raise InvalidInput(f"{where}: target {number} is listed twice: each id is printed once")
        return list(targets.ids)
    ids = [n for n in range(1 << SEGMENTS) if _BRIGHT[0] <= n.bit_count() <= _BRIGHT[1] and is_id(n)]
    if not 0 <= targets.count <= len(ids):
        raise InvalidInput(f"{where}: count {targets.count}: there are {len(ids)} ring12 ids of moderate brightness")
    return ids[: targets.count]


def plate_places(columns: int, rows: int, pitch_m: float) -> Array:
    """(n, 3) m of a grid, row by row, origin in its upper left, x right, y down, z into the sheet."""
    j, i = np.divmod(np.arange(columns * rows), columns)
    return np.column_stack([i * pitch_m, j * pitch_m, np.zeros(len(i))])


def sphere_places(count: int, radius: float, cap: float) -> Array:
    """(n, 3) m evenly over a sphere's cap around +z, ``cap`` rad from the pole, by the golden angle (Vogel 1979)."""
    k = np.arange(count)
    z = 1.0 - (1.0 - np.cos(cap)) * (k + 0.5) / count
    around = k * np.pi * (3.0 - np.sqrt(5.0))
    flat = np.sqrt(1.0 - z**2)
    return radius * np.column_stack([flat * np.cos(around), flat * np.sin(around), z])


def spread_codes(coded: int, total: int) -> list[bool]:
    """Which of ``total`` places carry a code, evenly spread."""
    return [int((k + 1) * coded / total) > int(k * coded / total) for k in range(total)]
