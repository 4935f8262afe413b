"""Which candidates are dots: what may be part of a code ring, what no dot can be, and what was found twice."""

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from robcal.imaging.blobs import Candidates
from robcal.imaging.detections import Reason, RejectionLog
from robcal.imaging.dot_fitting import FittedDots
from robcal.imaging.noise import NoiseModel
from robcal.imaging.ring_code import RingReadings
from robcal.imaging.settings import DetectionSettings

Array = NDArray[np.float64]


def may_be_ring_parts(candidates: Candidates) -> NDArray[np.bool_]:
    """Blobs that lie wholly between 1.7 and 3.4 radii of a larger blob: fitted only if that is no coded dot."""
    n = len(candidates)
    result = np.zeros(n, bool)
    if n < 2:
        return result
    area = np.prod(candidates.semi_axes, axis=1)
    tree = cKDTree(candidates.xy)
    radius = 3.0 * candidates.semi_axes[:, 0]
    for host, around in enumerate(tree.query_ball_point(candidates.xy, radius)):
        others = np.array([k for k in around if k != host], dtype=int)
        if others.size == 0:
            continue
        rho = _relative_radius(
            candidates.xy[others], candidates.xy[host], candidates.semi_axes[host], candidates.angle[host]
        )
        parts = (rho > 1.8) & (rho < 3.0) & (area[others] < 1.15 * area[host])
        parts &= candidates.semi_axes[others, 1] < 0.85 * candidates.semi_axes[host, 0]
        result[others[parts]] = True
    return result


def _relative_radius(xy: Array, centre: Array, semi_axes: Array, angle: float) -> Array:
    """Distance from the centre of an ellipse in units of its radius."""
    c, s = np.cos(angle), np.sin(angle)
    d = xy - centre
    return np.hypot((c * d[:, 0] + s * d[:, 1]) / semi_axes[0], (-s * d[:, 0] + c * d[:, 1]) / semi_axes[1])


def accept(
    dots: FittedDots, image: NDArray, noise: NoiseModel, settings: DetectionSettings, log: RejectionLog
) -> FittedDots:
    """The fits that are dots; the others go to the log."""
    n = len(dots)
    if n == 0:
        return dots
    height, width = image.shape
    sigma = np.sqrt(noise.at(dots.background))
    reach = dots.semi_axes[:, 0] + 1.0
    x, y = dots.xy.T
    tests = (
        (Reason.NO_CONVERGENCE, ~dots.converged | ~np.isfinite(dots.covariance).all(axis=(1, 2))),
        (Reason.BORDER, (x < reach) | (y < reach) | (x > width - 1 - reach) | (y > height - 1 - reach)),
        (Reason.CONTRAST, dots.contrast < settings.min_contrast_sigma * sigma),
        (Reason.TOO_SMALL, ~dots.is_spot & (dots.semi_axes[:, 1] < settings.min_axis_px)),
        (Reason.TOO_LARGE, dots.semi_axes[:, 0] > settings.max_axis_px),
        (Reason.ELONGATED, dots.semi_axes[:, 1] < settings.min_axis_ratio * dots.semi_axes[:, 0]),
        (Reason.STRUCTURE, dots.misfit > settings.max_misfit),
        # an edge as soft as the dot is large: glare, a reflection out of focus
        (Reason.STRUCTURE, ~dots.is_spot & (dots.s > 0.8 * dots.semi_axes[:, 1] + 0.5)),
    )
    good = np.ones(n, bool)
    for reason, bad in tests:
        refused = good & bad
        log.add_rows(dots.xy[refused], dots.semi_axes[refused, 0], reason)
        good &= ~bad
    return dots.select(good)


def without_ring_parts(
    candidates: Candidates, dots: FittedDots, readings: RingReadings, log: RejectionLog
) -> Candidates:
    """The late candidates that are not part of a ring around an accepted dot, read or not."""
    keep = np.ones(len(candidates), bool)
    for host in np.flatnonzero(readings.evidence):
        rho = _relative_radius(candidates.xy, dots.xy[host], dots.semi_axes[host], float(dots.angle[host]))
        # a segment lies in the ring; an uncoded dot of the same size would reach out of that band
        keep &= ~((rho > readings.pattern.inner - 0.2) & (rho < readings.pattern.outer + 0.2))
    log.add_rows(candidates.xy[~keep], candidates.semi_axes[~keep, 0], Reason.RING_PART)
    return candidates.select(keep)


def without_duplicates(dots: FittedDots, readings: RingReadings, log: RejectionLog) -> tuple[FittedDots, RingReadings]:
    """One dot per place: of overlapping ones the coded, then the better fitting one; no dot inside a read ring."""
    n = len(dots)
    if n < 2:
        return dots, readings
    order = np.lexsort((dots.misfit + dots.residual, readings.code < 0))
    rank = np.empty(n, int)
    rank[order] = np.arange(n)
    tree = cKDTree(dots.xy)
    keep = np.ones(n, bool)
    reach = np.where(readings.code >= 0, readings.pattern.outer + 0.1, 0.9) * dots.semi_axes[:, 0]
    for row in order:
        if not keep[row]:
            continue
        for other in tree.query_ball_point(dots.xy[row], reach[row]):
            if other == row or not keep[other]:
                continue
            if rank[other] < rank[row]:
                # a better dot stands inside this one's outline: this is its glare or the plate that carries it
                inside = np.hypot(*(dots.xy[other] - dots.xy[row])) + dots.semi_axes[other, 0] < dots.semi_axes[row, 0]
                if inside and readings.code[row] < 0:
                    keep[row] = False
                    log.add(dots.xy[row, 0], dots.xy[row, 1], dots.semi_axes[row, 0], Reason.TOO_LARGE)
                    break
                continue
            rho = _relative_radius(
                dots.xy[other : other + 1], dots.xy[row], dots.semi_axes[row], float(dots.angle[row])
            )[0]
            ring = readings.code[row] >= 0 and rho < readings.pattern.outer + 0.05
            if rho < 0.9 or (ring and readings.code[other] < 0):
                keep[other] = False
                reason = Reason.RING_PART if ring else Reason.DUPLICATE
                log.add(dots.xy[other, 0], dots.xy[other, 1], dots.semi_axes[other, 0], reason)
    kept = readings.select(keep)
    return dots.select(keep), kept
