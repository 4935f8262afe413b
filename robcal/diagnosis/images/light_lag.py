"""Centres that lag behind their light: found in the images of the station, taken back from its marks.

Charge that stays behind on read-out drags bright dots along the rows, the more the brighter they are. Light falls with
distance and tilt, so that poses and single targets are displaced, and nothing else tells it.

Dots whose size no file states: found in the images of the station, put into its body, so that it is taken back.

The centre of a dot's image is not the image of its centre; what that does to the station goes with the square of the
diameter. Where the diagnosis of the images finds it, the body gets the diameter that explains it, and the station is
oriented (and everything measured) with it.
"""

from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np
from scipy import stats

from robcal.diagnosis.images.diagnosis import ImageFinding, diagnose_images
from robcal.photogrammetry.core.bodies import Body
from robcal.photogrammetry.station.network import StationMarks
from robcal.photogrammetry.station.seen_normals import Ellipses
from robcal.physics.images.cause import CENTROID_BIAS, ECCENTRICITY
from robcal.physics.images.data import ImageData

BY_LIGHT = "by_light_px"
SUSPECT = 1e-4
"""Significance of light alone from which it is looked at beside all other causes."""


def without_lag(
    marks: Mapping[str, StationMarks], shapes: Mapping[str, Ellipses], view: Callable[[], ImageData]
) -> tuple[dict[str, StationMarks], tuple[ImageFinding, ...]]:
    """The marks with what lags behind their light taken back, and what was found; as they are where nothing was.

    Parameters
    ----------
    view : the diagnosis' view of the station oriented with the marks as they are.
    """
    as_they_are = dict(marks)
    if not shapes:
        return as_they_are, ()
    data = view()
    if not _suspect(data):
        return as_they_are, ()
    found = [f for f in diagnose_images(data).findings if f.kind == CENTROID_BIAS and BY_LIGHT in f.parameters]
    corrected = as_they_are
    for finding in found:
        name = finding.where
        lag = np.nan_to_num(shapes[name].light)[:, None] * np.asarray(finding.parameters[BY_LIGHT], dtype=float)
        corrected[name] = replace(corrected[name], xy=corrected[name].xy - lag)
    return corrected, tuple(replace(f, statement=f"{f.statement}; taken back") for f in found)


def _suspect(data: ImageData) -> bool:
    """Whether the light of the dots explains residuals of any camera by itself."""
    if data.light is None:
        return False
    variance = float(data.residual @ data.residual) / max(data.freedom, 1)
    for c in range(len(data.names)):
        light = np.where(data.camera == c, np.nan_to_num(data.light), 0.0)
        columns = data.remove(data.whiten(light[:, None, None] * np.eye(2)))
        U, s, _ = np.linalg.svd(columns, full_matrices=False)
        U = U[:, s > 1e-9 * max(float(s[0]), 1e-300)]
        if stats.chi2.sf(float(np.sum((U.T @ data.residual) ** 2)) / variance, max(U.shape[1], 1)) < SUSPECT:
            return True
    return False


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
