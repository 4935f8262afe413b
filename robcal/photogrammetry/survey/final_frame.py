"""Last steps of a survey: names of new targets, scale, frame, and the adjustment in the final datum.

Whether what gives the scale of a survey agrees with everything else that has a length: units go wrong first.
"""

from dataclasses import dataclass, replace

import numpy as np

from robcal.errors import InvalidInput, NotIdentifiable
from robcal.photogrammetry.bundle.body_frame import FrameOrigin, Similarity, body_frame, fit_similarity
from robcal.photogrammetry.bundle.datum import DatumSpec, InnerOver, spans_triangle
from robcal.photogrammetry.core.network import CameraNetwork, Lengths
from robcal.photogrammetry.survey.adjusting import Adjusted, Step, readjust
from robcal.photogrammetry.survey.assignments import Assignments, named
from robcal.photogrammetry.survey.identification import first_new_id
from robcal.photogrammetry.survey.types import SurveyInput
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


@dataclass(frozen=True)
class FinalSurvey:
    """A network in its final frame; ``frame`` and ``scale`` describe where these come from."""

    table: Assignments
    adjusted: Adjusted
    frame: str
    scale: str
    notes: tuple[str, ...]


def adjust_in_final_frame(given: SurveyInput, table: Assignments, adjusted: Adjusted, datum: DatumSpec) -> FinalSurvey:
    """Scale, frame and names; the last adjustment gives the covariances in the final datum.

    Raises
    ------
    InvalidInput : targets of scale bars or of a fixed datum are not measured; lengths in another unit.
    NotIdentifiable : nothing gives the scale.
    """
    _check_measured(given, adjusted.network, datum)
    table = table.without_starts()
    names = _names_of_new(given, table, adjusted.network)
    table = named(table, names)
    network = replace(adjusted.network, ids=np.array([names.get(int(i), int(i)) for i in adjusted.network.ids]))
    step = Step(given.adjust_settings, given.settings.free_intrinsics, with_lengths=True)
    scaled_by_bars = len(given.bars) > 0
    notes: list[str] = []
    ratio = adjusted.size_ratio
    if scaled_by_bars:
        # to metres first: sizes of dots must be in the scale of the coordinates
        rough = Similarity(rough_scale(network, given.bars), np.eye(4), FrameOrigin.SCALE_BARS)
        notes += scale_notes(network, given.given_points(network.ids), given.bars, given.checks, rough.scale, ratio)
        table, adjusted = readjust(given, table, network, step, rough)
        network = adjusted.network
    coordinates = given.given_points(network.ids)
    R, t = network.camera_T_body[:, :3, :3], network.camera_T_body[:, :3, 3]
    stations = -np.einsum("nij,ni->nj", R, t)
    frame = body_frame(network.points, network.ids, coordinates, stations, with_scale=not scaled_by_bars)
    known = tuple(int(i) for i in network.ids[np.isfinite(coordinates).all(axis=1)])
    if not scaled_by_bars:
        notes += scale_notes(network, coordinates, given.bars, given.checks, frame.scale, ratio)
        if not isinstance(datum, tuple) and len(known) < 2:
            raise NotIdentifiable(
                "fewer than two targets with given coordinates were found, so nothing gives the scale: photograph a "
                "scale bar or give more coordinates",
                ("scale",),
            )
    step = Step(
        replace(given.adjust_settings, robust=False, snooping=False),
        network.free_intrinsics,
        InnerOver(known) if datum == "free" and frame.origin is FrameOrigin.GIVEN_COORDINATES else datum,
        with_lengths=True,
    )
    table, adjusted = readjust(given, table, network, step, frame)
    return FinalSurvey(
        table,
        adjusted,
        f"targets {sorted(datum)} held at their given coordinates" if isinstance(datum, tuple) else frame.description,
        f"{len(given.bars)} scale bars" if scaled_by_bars else "the given coordinates",
        tuple(notes),
    )


def _check_measured(given: SurveyInput, network: CameraNetwork, datum: DatumSpec) -> None:
    have = {int(i) for i in network.ids}
    unseen = sorted({int(v) for v in given.bars.ids.ravel()} - have)
    if unseen:
        raise InvalidInput(
            f"scale bar targets {unseen} are not measured in two images: photograph them or check the ids"
        )
    if isinstance(datum, tuple) and set(datum) - have:
        raise InvalidInput(f"targets {sorted(set(datum) - have)} of the fixed datum are not measured in two images")


def _names_of_new(given: SurveyInput, table: Assignments, network: CameraNetwork) -> dict[int, int]:
    """Final id of each new target by its provisional one: ids listed without coordinates first, then fresh ones.

    The new targets seen in most images get the listed ids; both groups are numbered in the order of their coordinates.
    """
    identified = set(table.ids[~table.new].tolist())
    listed = [t.id for t in given.blank if t.id is not None and t.id not in identified]
    rays = np.bincount(network.marks.target, minlength=len(network.ids))
    provisional = set(table.ids[table.new].tolist())
    new = [row for row, i in enumerate(network.ids) if int(i) in provisional]
    new.sort(key=lambda row: -rays[row])

    def place(row: int) -> tuple[float, ...]:
        return tuple(network.points[row])

    chosen = sorted(new[: len(listed)], key=place) + sorted(new[len(listed) :], key=place)
    fresh = first_new_id(given, table)
    final = [*listed[: len(chosen)], *range(fresh, fresh + len(chosen) - len(listed))]
    return {int(network.ids[row]): i for row, i in zip(chosen, final, strict=True)}
