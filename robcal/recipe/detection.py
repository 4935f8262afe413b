"""Which targets to look for in the images of a body."""

from collections.abc import Collection

from robcal.errors import InvalidInput
from robcal.files.body_file import BodyFile
from robcal.imaging.ring_code import ring_segments
from robcal.imaging.settings import DetectionSettings

_MANY = 12
"""Uncoded dots from which on a body is found by their arrangement."""


def detection_settings(body: BodyFile, ends: Collection[int] | None) -> DetectionSettings:
    """What to look for in images of a body.

    Parameters
    ----------
    ends : in a survey the targets of known lengths, which may lie beside the body; None where its targets move with it.

    Raises
    ------
    InvalidInput : two dictionaries of markers on one body.
    """
    codes = [t.code for t in body.targets]
    dictionaries = sorted({c.removeprefix("aruco:") for c in codes if c is not None and c.startswith("aruco:")})
    if len(dictionaries) > 1:
        raise InvalidInput(f"{body.path}: markers of several dictionaries ({', '.join(dictionaries)}): use one")
    ring = {t.id for t in body.targets if ring_segments(t.code) is not None and t.id is not None}
    known = ring | set(ends or ())
    polarities = {t.polarity for t in body.targets}
    if len(polarities) > 1:
        raise InvalidInput(f"{body.path}: bright and dark targets on one body: one polarity is needed")
    return DetectionSettings(
        polarity="dark" if polarities == {"dark"} else "bright",
        ring12=bool(known) or not any(codes),
        ring=body.ring,
        known_codes=frozenset(known) if ring else None,
        aruco=dictionaries[0] if dictionaries else None,
        # many uncoded dots are found by their arrangement: then a rough centre is better than none
        coarse=ends is None and not any(codes) and len(codes) >= _MANY,
    )
