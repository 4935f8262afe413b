"""Targets of one image: find blobs, fit ellipses, read codes, refuse the rest with a reason."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from robcal.errors import InvalidInput
from robcal.imaging.aruco_markers import find_markers
from robcal.imaging.blobs import Candidates, step_all_around
from robcal.imaging.coarse_dots import with_coarse_dots
from robcal.imaging.detections import CodeState, Detections, Reason, RejectionLog, TargetKind, empty_columns
from robcal.imaging.dot_fitting import FittedDots, blur_without_pixel, fit_dots, refit_ringed
from robcal.imaging.noise import NoiseModel, estimate_noise
from robcal.imaging.other_centroids import contour_centres
from robcal.imaging.ring_code import RingReadings, read_rings
from robcal.imaging.segmentation import find_candidates
from robcal.imaging.selection import accept, may_be_ring_parts, without_duplicates, without_ring_parts
from robcal.imaging.settings import DetectionSettings

Array = NDArray[np.float64]

_DOUBTFUL = 0.2
"""Share of the largest misfit of an accepted dot (clean ones stay below) above which its contour is examined."""
_DEFAULT = DetectionSettings()
_ODD = (Reason.SHAPE, Reason.STRUCTURE, Reason.NO_CONVERGENCE, Reason.OVER_CAP)
_CODED_MISFIT_MAX = 0.1
_BASE_WRONG = 2.0  # step across the outline by the contrast against the coarse background
_STEP_BY_CONTRAST = 0.4  # least step across the outline by the least contrast; small dots are all edge


def detect_targets(image: NDArray, settings: DetectionSettings = _DEFAULT) -> Detections:
    """Finds the targets of a grey image.

    Parameters
    ----------
    image : (h, w) uint8 or uint16; not changed. settings : of the detection.

    Returns
    -------
    Detections; empty with a message where there is nothing to see (black or evenly saturated image).

    Raises
    ------
    InvalidInput : not a two-dimensional image of 8 or 16 bit, or an unknown marker dictionary.

    Notes
    -----
    Weakness: a lamp or reflection that is a clean ellipse within the size limits is reported as an uncoded dot; only
    geometry can decide later. Covariances hold for the centre of the dot's image ellipse, not for its eccentricity.
    """
    check_image(image)
    noise = estimate_noise(image)
    log = RejectionLog()
    message = _nothing_to_see(image, noise, settings)
    if message:
        return _detections(image, empty_columns(), noise, log, message)
    bright, bright_noise = _bright(image, noise, settings)
    saturation = _saturation(bright, settings)
    candidates = find_candidates(bright, bright_noise, settings, log)
    candidates = _standing_out(bright, candidates, bright_noise, settings, log)
    late = may_be_ring_parts(candidates) if settings.ring12 else np.zeros(len(candidates), bool)
    dots, bright_noise, _ = fit_dots(bright, candidates.select(~late), bright_noise, saturation, settings.max_misfit)
    log.count(Reason.SHAPE, int((~late).sum()) - len(dots))
    dots = accept(dots, bright, bright_noise, settings, log)
    readings, dots = _read(bright, dots, bright_noise, saturation, settings)
    waiting = without_ring_parts(candidates.select(late), dots, readings, log)
    if len(waiting):
        more, _, _ = fit_dots(bright, waiting, bright_noise, saturation, settings.max_misfit)
        more = accept(more, bright, bright_noise, settings, log)
        dots, readings = _merged(bright, dots, readings, more, bright_noise, saturation, settings)
    dots, readings = without_duplicates(dots, readings, log)
    columns = _columns(bright, dots, readings, settings)
    if settings.aruco is not None:
        markers = find_markers(image, settings.aruco, noise)
        columns = {name: np.concatenate([columns[name], markers[name]]) for name in columns}
    found = replace(
        noise, gain=abs(bright_noise.gain), variance=bright_noise.variance, correlation=bright_noise.correlation
    )
    result = _detections(image, columns, found, log, "" if len(columns["xy"]) else _no_target(log))
    if settings.coarse and sum(log.result().counts.get(reason, 0) for reason in _ODD) > len(result):
        return with_coarse_dots(image, result, polarity=settings.polarity)
    return result


def check_image(image: NDArray) -> None:
    """Raise an error for what is no grey image of 8 or 16 bit, or too small."""
    if not isinstance(image, np.ndarray) or image.ndim != 2:
        raise InvalidInput("the image must be a two-dimensional grey array; convert colour to grey first")
    if image.dtype not in (np.uint8, np.uint16):
        raise InvalidInput(f"the image has type {image.dtype}; give 8 or 16 bit unsigned grey values")
    if min(image.shape) < 8:
        raise InvalidInput(f"the image has {image.shape[1]} x {image.shape[0]} pixels; at least 8 x 8 are needed")


def _nothing_to_see(image: NDArray, noise: NoiseModel, settings: DetectionSettings) -> str:
    low, high = int(image.min()), int(image.max())
    if high - low < max(settings.min_contrast_sigma * noise.sigma, 2.0 * noise.step):
        where = "black" if high < 0.05 * np.iinfo(image.dtype).max else "evenly grey"
        if low >= np.iinfo(image.dtype).max * 0.98:
            where = "saturated everywhere"
        return f"the image is {where} (grey values {low} to {high}): check exposure and lamp"
    return ""


def _no_target(log: RejectionLog) -> str:
    counts = log.result().counts
    if not counts:
        return "nothing stands out from the background"
    worst = sorted(counts, key=lambda reason: -counts[reason])[:3]
    return "no dot among the candidates: " + ", ".join(f"{counts[reason]} {reason.value}" for reason in worst)


def _bright(image: NDArray, noise: NoiseModel, settings: DetectionSettings) -> tuple[NDArray, NoiseModel]:
    """The image with bright dots and its noise model; dark dots are turned over."""
    if settings.polarity == "bright":
        return image, noise
    top = np.iinfo(image.dtype).max
    # variance grows with the original brightness, so it falls in the turned one
    return top - image, replace(noise, gain=-noise.gain, level=float(top) - noise.level)


def _saturation(bright: NDArray, settings: DetectionSettings) -> float:
    top = float(np.iinfo(bright.dtype).max)
    if settings.polarity == "dark":
        # dark dots are cut off at black only
        return top
    return saturation_level(bright) if settings.saturation_level is None else settings.saturation_level


def _standing_out(
    bright: NDArray, candidates: Candidates, noise: NoiseModel, settings: DetectionSettings, log: RejectionLog
) -> Candidates:
    """The candidates whose outline shows a step all around, large enough for the contrast asked for."""
    step, around = step_all_around(bright, candidates)
    # noise on a brighter patch of texture stands high above the coarse background, but not above its surroundings
    high = step > _STEP_BY_CONTRAST * settings.min_contrast_sigma * np.sqrt(noise.at(candidates.base))
    for bad, reason in ((~around, Reason.SHAPE), (around & ~high, Reason.CONTRAST)):
        log.add_rows(candidates.xy[bad], candidates.semi_axes[bad, 0], reason)
    # beside something bright the coarse background is far too high a start for the fit
    wrong = step > _BASE_WRONG * (candidates.peak - candidates.base)
    candidates = replace(candidates, base=np.where(wrong, candidates.peak - step, candidates.base))
    return candidates.select(around & high)


def saturation_level(image: NDArray) -> float:
    """Grey value at which the image is cut off, infinity if none: the top of the range, or a plateau below it."""
    top, high = int(np.iinfo(image.dtype).max), int(image.max())
    if high == top:
        return float(top)
    plateau = int(np.count_nonzero(image == high))
    below = int(np.count_nonzero(image >= high - max(1, high >> 6))) - plateau
    # free grey values thin out towards their maximum; a pile at the very maximum is a cut
    return float(high) if plateau >= 30 and plateau > 2 * below else float("inf")


def _read(
    image: NDArray, dots: FittedDots, noise: NoiseModel, saturation: float, settings: DetectionSettings
) -> tuple[RingReadings, FittedDots]:
    """Readings of all dots; those with a ring, read or not, are fitted again without its glare."""
    readings = _readings(image, dots, noise, saturation, settings)
    ringed = np.flatnonzero((readings.code >= 0) | (readings.evidence & readings.bits.any(axis=1)))
    if ringed.size:
        again = refit_ringed(image, dots, readings, ringed, noise, saturation)
        good = again.converged & (np.linalg.norm(again.xy - dots.xy[ringed], axis=1) < 0.5) & ~again.is_spot
        dots = dots.replaced(ringed[good], again.select(good))
    return readings, dots


def _readings(
    image: NDArray, dots: FittedDots, noise: NoiseModel, saturation: float, settings: DetectionSettings
) -> RingReadings:
    n = len(dots)
    if not settings.ring12 or n == 0:
        none = np.zeros(n, bool)
        bits = np.zeros((n, settings.ring.segments), bool)
        return RingReadings(np.full(n, -1, np.int64), none, np.zeros(n), bits, np.zeros(n), settings.ring)
    sigma = np.sqrt(noise.at(dots.background + 0.5 * dots.contrast))
    sigma = np.where(dots.misfit < _CODED_MISFIT_MAX, sigma, np.inf)  # not clean enough to carry a code
    return read_rings(
        image,
        dots.xy,
        dots.b,
        dots.s,
        dots.background,
        dots.contrast,
        sigma,
        saturation,
        settings.known_codes,
        settings.ring,
    )


def _merged(
    image: NDArray,
    dots: FittedDots,
    readings: RingReadings,
    more: FittedDots,
    noise: NoiseModel,
    saturation: float,
    settings: DetectionSettings,
) -> tuple[FittedDots, RingReadings]:
    new = _readings(image, more, noise, saturation, settings)
    # what waited because it may be part of a ring carries no code of its own
    new = replace(new, code=np.full(len(more), -1, np.int64))
    return dots.joined(more), readings.joined(new)


def _columns(
    bright: NDArray, dots: FittedDots, readings: RingReadings, settings: DetectionSettings
) -> dict[str, NDArray]:
    dark, top = settings.polarity == "dark", np.iinfo(bright.dtype).max
    state = np.where(
        readings.code >= 0, CodeState.READ, np.where(readings.evidence, CodeState.UNREADABLE, CodeState.NONE)
    )
    return {
        "xy": dots.xy,
        "covariance": dots.covariance,
        "semi_axes": dots.semi_axes,
        "angle": dots.angle,
        "contrast": -dots.contrast if dark else dots.contrast,
        "background": top - dots.background if dark else dots.background,
        "saturated": dots.saturated,
        "code": readings.code.astype(np.int64),
        "kind": np.where(readings.code >= 0, int(TargetKind.RING12), int(TargetKind.DOT)).astype(np.int8),
        "code_state": np.asarray(state, dtype=np.int8),
        "blur": blur_without_pixel(dots.s),
        "residual": dots.residual,
        "chi2": dots.chi2,
        "gain_gradient": dots.gain_gradient,
        "contour_offset": _contour_offset(bright, dots, settings),
    }


def _contour_offset(bright: NDArray, dots: FittedDots, settings: DetectionSettings) -> Array:
    """(n,) px between the fitted centre of doubtful dots and that of their contour; NaN for the others."""
    offset = np.full(len(dots), np.nan)
    rows = np.flatnonzero(dots.misfit > _DOUBTFUL * settings.max_misfit)
    if rows.size:
        some = dots.select(rows)
        centre = contour_centres(bright, some.xy, some.semi_axes, some.background, some.contrast)
        offset[rows] = np.linalg.norm(centre - some.xy, axis=1)
    return offset


def _detections(
    image: NDArray, columns: dict[str, NDArray], noise: NoiseModel, log: RejectionLog, message: str
) -> Detections:
    return Detections(
        shape=(int(image.shape[0]), int(image.shape[1])), noise=noise, rejected=log.result(), message=message, **columns
    )
