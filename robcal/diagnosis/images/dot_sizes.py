"""Dots whose size no file states: found in the images of the station, put into its body, so that it is taken back.

The centre of a dot's image is not the image of its centre; what that does to the station goes with the square of the
diameter. Where the diagnosis of the images finds it, the body gets the diameter that explains it, and the station is
oriented (and everything measured) with it.
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from robcal.diagnosis.images.diagnosis import ImageFinding, diagnose_images
from robcal.photogrammetry.core.bodies import Body
from robcal.physics.images.cause import ECCENTRICITY
from robcal.physics.images.data import ImageData

PRECISE = 3.0
"""Diameters below this multiple of their standard deviation are reported, but not taken over."""


def with_dot_sizes(body: Body, view: Callable[[], ImageData]) -> tuple[Body, tuple[ImageFinding, ...]]:
    """The body with the diameter that its images show, and what was found: one finding for each camera.

    The body as it is, and nothing, where it states any diameter, has no dots, or the images show none.

    Parameters
    ----------
    view : the diagnosis' view of the station oriented with the body as it is; called only where dots have no size.

    Weakness: one diameter for all dots.
    """
    if np.any(np.isfinite(body.diameters)) or all(code == "corner" for code in body.codes):
        return body, ()
    found = tuple(f for f in diagnose_images(view()).findings if f.kind == ECCENTRICITY)
    if not found:
        return body, ()
    value, sigma = (float(str(table["diameter_mm"])) for table in (found[0].parameters, found[0].sigma))
    if not value > PRECISE * sigma:
        return body, ()
    taken = tuple(replace(f, statement=f"{f.statement}; taken back with that diameter") for f in found)
    return replace(body, diameters=np.full(len(body), value / 1000.0)), taken
