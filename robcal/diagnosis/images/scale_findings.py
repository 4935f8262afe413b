"""A survey whose check lengths contradict its scale: a scale bar is not as long as its certificate says.

The errors of all check lengths are estimated as one scale, with the covariance that they share through the network. A
single contradicting check length, or several that no scale explains, are left to the report: then it is they that are
in doubt.
"""

import numpy as np
from scipy import stats

from robcal.diagnosis.images.diagnosis import ImageFinding
from robcal.photogrammetry.bundle.lengths import distances
from robcal.photogrammetry.core.network import CameraNetwork
from robcal.physics.measuring import SCALE_ERROR
from robcal.transforms import Array

LEVEL = 1e-4
"""Significance of a scale, two-sided."""
ADEQUATE = 1e-3
"""Significance of what is left of the check lengths from which one scale does not explain them."""
FEWEST = 2


def scale_findings(network: CameraNetwork, body: str) -> tuple[ImageFinding, ...]:
    """The scale of a survey against its check lengths.

    Weakness: whether the scale bars or the check lengths are wrong, these measurements cannot tell; nothing is
    corrected.
    """
    checks = [check for check in network.check_lengths if check.sigma > 0]
    if len(checks) < FEWEST:
        return ()
    rows = network.index_of([target for check in checks for target in check.ids]).reshape(-1, 2)
    J = distances(network.points, rows)[1]
    covariance = J @ network.points_covariance @ J.T
    # the certificates' own variances stand on the diagonal only
    own = np.array([check.sigma**2 for check in checks])
    covariance[np.diag_indices(len(checks))] = np.maximum(own, np.diag(covariance))
    error = np.array([check.error for check in checks])
    length = np.array([check.expected for check in checks])
    scale, sigma, left = _common_scale(error, length, covariance)
    p_value = float(2.0 * stats.norm.sf(abs(scale) / sigma))
    if p_value > LEVEL or float(stats.chi2.sf(left, len(checks) - 1)) < ADEQUATE:
        return ()
    ppm = 1e6 * scale
    way = "long" if ppm > 0 else "short"
    text = (
        f"Body {body} was surveyed {abs(ppm):.0f} ppm too {way} by its {len(checks)} check lengths: "
        "a scale bar is not as long as stated, or the check lengths are not"
    )
    nothing = (float("nan"), float("nan"))
    reported: dict[str, object] = {"ppm": ppm}
    found = ImageFinding(SCALE_ERROR, "station", None, reported, {"ppm": 1e6 * sigma}, p_value, (), nothing, text)
    return (found,)


def _common_scale(error: Array, length: Array, covariance: Array) -> tuple[float, float, float]:
    """Scale (1) that explains errors (k,) of lengths (k,), its sigma, and the chi-square of what it leaves."""
    weighted = np.linalg.solve(covariance, np.stack([length, error], axis=1))
    precision = float(length @ weighted[:, 0])
    scale = float(length @ weighted[:, 1]) / precision
    rest = error - scale * length
    return scale, precision**-0.5, float(rest @ np.linalg.solve(covariance, rest))
