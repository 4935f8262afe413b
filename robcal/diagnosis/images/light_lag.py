"""Centres that lag behind their light: found in the images of the station, taken back from its marks.

Charge that stays behind on read-out drags bright dots along the rows, the more the brighter they are. Light falls with
distance and tilt, so that poses and single targets are displaced, and nothing else tells it.
"""

from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np
from scipy import stats

from robcal.diagnosis.images.diagnosis import ImageFinding, diagnose_images
from robcal.photogrammetry.station.network import StationMarks
from robcal.photogrammetry.station.seen_normals import Ellipses
from robcal.physics.images.cause import CENTROID_BIAS
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
