"""Reading of ring codes: segments of a ring around a dot (ring12: 12 of 30 degrees between two and three radii).

The dot's ellipse gives the affine map from the target's plane to the image up to a turn; the turn (phase) and the
segments' brightness are fitted to samples on circles of the target's plane. Blur is part of the model. A reading
counts only if every segment is clearly bright or clearly dark and the whole ring looks as the code predicts; a ring
that is partly covered or cut yields no code.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from robcal.columns import Columns
from robcal.errors import InvalidInput
from robcal.imaging.edge_model import tail

Array = NDArray[np.float64]

SEGMENTS = 12
FEWEST_SEGMENTS, MOST_SEGMENTS = 8, 20
_PER_SEGMENT = 8
_IN_RING = np.array([0.2, 0.4, 0.6, 0.8])  # samples by the width of the ring, of the gap
_IN_GAP = np.array([0.4, 0.5, 0.6])
_INTERPOLATION_VARIANCE = 0.15  # px^2, blur of bilinear interpolation, mean over the positions within a pixel

_EVIDENCE = 0.35  # of the dot's contrast, somewhere on the ring: below it there is no ring
_MARGIN = 0.25  # a segment's brightness must keep this distance from the half
_RMS_MAX = 0.14  # of the ring's brightness, readings minus prediction over the ring
_PATCH_MAX = 0.42  # the same, mean over any patch of 1/4 segment by half the ring's width
_GAP_MAX = 0.22
_MINOR_AXIS_MIN = 1.4  # px; below it neither gap nor segments are resolved
_MINOR_BY_BLUR_MIN = 1.5
_NOISE_MAX = 0.12  # of one pixel, by the contrast
_BRIGHT_MIN, _DARK_MIN = 3, 2  # bright, dark segments of a code that is not known beforehand


@dataclass(frozen=True)
class RingPattern:
    """How codes are printed.

    Attributes
    ----------
    segments : of the ring, 8 to 20 bits. inner, outer : radii of the ring by that of the dot.
    clockwise : direction in which segments are read, seen from the front.
    """

    segments: int = SEGMENTS
    inner: float = 2.0
    outer: float = 3.0
    clockwise: bool = True

    def __post_init__(self) -> None:
        if not FEWEST_SEGMENTS <= self.segments <= MOST_SEGMENTS:
            raise InvalidInput(
                f"a ring code of {self.segments} segments: {FEWEST_SEGMENTS} to {MOST_SEGMENTS} can be read"
            )
        if not 1.2 <= self.inner < self.outer <= 6.0 or self.outer - self.inner < 0.3:
            raise InvalidInput(
                f"a code ring from {self.inner:g} to {self.outer:g} radii of the dot: give 1.2 <= inner < outer <= 6, "
                "at least 0.3 apart"
            )

    @property
    def angles(self) -> Array:
        """(m,) rad at which rings are sampled."""
        count = self.segments * _PER_SEGMENT
        return np.asarray((np.arange(count) + 0.5) * 2.0 * np.pi / count)

    @property
    def step(self) -> float:
        """Angle of a segment, rad."""
        return 2.0 * np.pi / self.segments

    @property
    def in_ring(self) -> Array:
        """Radii of samples in the ring, in dot radii."""
        return np.asarray(self.inner + (self.outer - self.inner) * _IN_RING)

    @property
    def in_gap(self) -> Array:
        """Radii of samples between dot and ring."""
        return np.asarray(1.0 + (self.inner - 1.0) * _IN_GAP)


RING12 = RingPattern()


def ring_segments(code: str | None) -> int | None:
    """Segments of a target's code ("ring12": 12), None where it is no ring code."""
    if code is None or not code.startswith("ring") or not code[4:].isascii() or not code[4:].isdigit():
        return None
    return int(code[4:])


def canonical_id(bits: int, segments: int = SEGMENTS) -> int:
    """The smallest of the cyclic readings of so many bits.

    Raises
    ------
    InvalidInput : bits that so many segments do not give.
    """
    if not 0 <= bits < 1 << segments:
        raise InvalidInput(f"a ring{segments} reading has {segments} bits: {bits} is not in 0..{(1 << segments) - 1}")
    mask = (1 << segments) - 1
    return min(((bits << k) | (bits >> (segments - k))) & mask for k in range(segments))


def is_id(number: int, segments: int = SEGMENTS) -> bool:
    """True for the ids of a ring code: 151 is one of ring12, 302 is not."""
    return 0 <= number < 1 << segments and canonical_id(number, segments) == number


@dataclass(frozen=True)
class RingReadings(Columns):
    """Readings of n rings.

    Attributes
    ----------
    code : (n,) id or -1. evidence : (n,) bool, something bright stands where the ring would be.
    phase : (n,) angle in the target's plane (of the dot's unit circle) where the first segment begins, rad.
    bits : (n, segments) bool in the order of increasing angle from the phase. level : (n,) the ring's brightness by the
    dot's contrast.
    """

    code: NDArray[np.int64]
    evidence: NDArray[np.bool_]
    phase: Array
    bits: NDArray[np.bool_]
    level: Array
    pattern: RingPattern = RING12


def _matrices(b: Array) -> Array:
    """(n, 2, 2) B from (n, 3)."""
    return np.stack([b[:, [0, 1]], b[:, [1, 2]]], axis=1)


def _grey_values(image: NDArray, xy: Array, b: Array, rho: Array, phi: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Grey values (n, r, m) on circles of the radii rho of the dots' unit planes; whether all lie in the image."""
    from robcal.imaging import ring_loop  # compiled: imported where it runs

    grey = np.empty((len(xy), len(rho), len(phi)))
    circle = np.stack([np.cos(phi), np.sin(phi)], axis=-1)
    pixels = np.ascontiguousarray(image)
    return grey, ring_loop.sample_rings(pixels, np.asarray(xy, float), np.linalg.inv(_matrices(b)), rho, circle, grey)


def _profile_widths(b: Array, s: Array, phi: Array) -> tuple[Array, Array]:
    """Blur along the radius and along the angle (times rho) in the dot's unit plane, (n, k), at angles phi (k,)."""
    matrix = _matrices(b)
    normal = np.stack([np.cos(phi), np.sin(phi)], axis=-1)
    tangent = np.stack([-np.sin(phi), np.cos(phi)], axis=-1)
    radial = np.linalg.norm(np.einsum("nij,kj->nki", matrix, normal), axis=-1)
    angular = np.linalg.norm(np.einsum("nij,kj->nki", matrix, tangent), axis=-1)
    return s[:, None] * radial, s[:, None] * angular


def _segments(phi: Array, phase: Array, sigma: Array, segments: int) -> tuple[Array, Array]:
    """Brightness (n, m, k) of k segments at the angles phi (m,), blurred by sigma (n, m) rad, and its derivative."""
    from robcal.imaging import ring_loop  # compiled: imported where it runs

    brightness, density = np.empty((2, *sigma.shape, segments))
    ring_loop.blur_segments(phi, phase, np.ascontiguousarray(sigma), brightness, density)
    return brightness, density


def read_rings(  # noqa: PLR0913 - columns of many dots
    image: NDArray,
    xy: Array,
    b: Array,
    blur: Array,
    background: Array,
    contrast: Array,
    noise_sigma: Array,
    saturation: float,
    known_codes: frozenset[int] | None = None,
    pattern: RingPattern = RING12,
) -> RingReadings:
    """Reads the codes around n fitted dots.

    Parameters
    ----------
    image : (h, w), bright dots. xy : (n, 2). b : (n, 3) ellipse matrix B11, B12, B22 (pixels to unit circle).
    blur : (n,) s of the edge profile, px. background, contrast : (n,) grey values. noise_sigma : (n,) of one pixel.
    saturation : grey value above which nothing is known. known_codes : only these are codes. pattern : of the codes.
    """
    n = len(xy)
    segments, phi = pattern.segments, pattern.angles
    empty = RingReadings(
        np.full(n, -1, np.int64), np.zeros(n, bool), np.zeros(n), np.zeros((n, segments), bool), np.zeros(n), pattern
    )
    if n == 0:
        return empty
    # a censored dot is brighter than what the ring can show
    contrast = np.minimum(contrast, saturation - background)
    s = np.sqrt(blur**2 + _INTERPOLATION_VARIANCE)
    rho = np.concatenate([pattern.in_gap, pattern.in_ring])
    grey, complete = _grey_values(image, xy, b, rho, phi)
    radial, angular = _profile_widths(b, s, phi)
    # in units of the dot's contrast, without the dot's own glare
    y = (grey - background[:, None, None]) / np.maximum(contrast, 1e-6)[:, None, None]
    y -= ndtr(-(rho[None, :, None] - 1.0) / radial[:, None, :])
    gap, ring = y[:, : len(_IN_GAP)], y[:, len(_IN_GAP) :]
    in_ring = pattern.in_ring[None, :, None]
    factor = ndtr((in_ring - pattern.inner) / radial[:, None]) - ndtr((in_ring - pattern.outer) / radial[:, None])
    profile = (factor * ring).sum(axis=1) / (factor**2).sum(axis=1)
    sigma_angle = angular * 2.0 / (pattern.inner + pattern.outer)
    evidence = np.sort(profile, axis=1)[:, -3] > _EVIDENCE
    minor = 1.0 / np.linalg.eigvalsh(_matrices(b))[:, 1]
    resolved = (noise_sigma < _NOISE_MAX * contrast) & (minor > _MINOR_AXIS_MIN) & (minor > _MINOR_BY_BLUR_MIN * blur)
    readable = np.flatnonzero(evidence & complete & resolved & (contrast > 0))
    if readable.size == 0:
        return RingReadings(empty.code, evidence, empty.phase, empty.bits, empty.level, pattern)
    fit = _fit(profile[readable], sigma_angle[readable], pattern)
    noise = noise_sigma[readable] / np.maximum(contrast[readable], 1e-6)
    sure = _is_certain(fit, ring[readable], gap[readable], factor[readable], sigma_angle[readable], noise, pattern)
    bits, phase, level = empty.bits.copy(), empty.phase.copy(), empty.level.copy()
    bits[readable], phase[readable], level[readable] = fit.bits, fit.phase, fit.level
    code = empty.code.copy()
    for row, good in zip(readable, sure, strict=True):
        in_order = bits[row] if pattern.clockwise else bits[row][::-1]
        number = canonical_id(int("".join("1" if bit else "0" for bit in in_order), 2), segments)
        allowed = _allowed(number, known_codes, segments)
        if good and allowed:
            code[row] = number
    return RingReadings(code, evidence, phase, bits, level, pattern)


def _allowed(number: int, known_codes: frozenset[int] | None, segments: int) -> bool:
    if known_codes is not None:
        return number in known_codes
    # one or two bright segments or a single dark one can be anything: dust beside a dot, a scratch across a ring
    return _BRIGHT_MIN <= number.bit_count() <= segments - _DARK_MIN


@dataclass(frozen=True)
class _Fit:
    phase: Array
    amplitude: Array  # (n, segments)
    sigma: Array  # (n, segments) for unit noise of the profile
    bits: NDArray[np.bool_]
    level: Array


def _fit(profile: Array, sigma_angle: Array, pattern: RingPattern) -> _Fit:
    """Phase and segment brightnesses from (n, m) profiles at the pattern's angles."""
    n, segments, phi = len(profile), pattern.segments, pattern.angles
    # coarse phase: the shift by whole samples whose sector means leave least
    step = 2.0 * np.pi / len(phi)
    best, phase = np.full(n, np.inf), np.zeros(n)
    for shift in range(_PER_SEGMENT):
        blocks = np.roll(profile, -shift, axis=1).reshape(n, segments, _PER_SEGMENT)
        spread = ((blocks - blocks.mean(axis=2, keepdims=True)) ** 2).sum(axis=(1, 2))
        better = spread < best
        best[better], phase[better] = spread[better], shift * step
    amplitude = np.zeros((n, segments))
    inverse = np.zeros((n, segments, segments))
    ridge = 1e-6 * np.eye(segments)
    for _ in range(4):
        templates, density = _segments(phi, phase, sigma_angle, segments)
        inverse = np.linalg.inv(np.matmul(templates.transpose(0, 2, 1), templates) + ridge)
        amplitude = np.einsum("nkl,npl,np->nk", inverse, templates, profile)
        residual = profile - np.einsum("npk,nk->np", templates, amplitude)
        slope = -np.einsum("npk,nk->np", density, amplitude)
        turn = (slope * residual).sum(axis=1) / np.maximum((slope**2).sum(axis=1), 1e-9)
        phase = phase + np.clip(turn, -0.1, 0.1)
    bright = amplitude > 0.5 * np.sort(amplitude, axis=1)[:, -1:]
    level = np.where(bright, amplitude, 0.0).sum(axis=1) / np.maximum(bright.sum(axis=1), 1)
    bits = amplitude > 0.5 * level[:, None]
    return _Fit(phase, amplitude, np.sqrt(np.diagonal(inverse, axis1=1, axis2=2)), bits, level)


def _is_certain(
    fit: _Fit, ring: Array, gap: Array, factor: Array, sigma_angle: Array, noise: Array, pattern: RingPattern
) -> NDArray:
    """(n,) True where nothing speaks against the reading."""
    level = fit.level
    good = (level > 0.45) & (level < 1.6)
    scale = 1.0 / np.maximum(level, 1e-6)
    # samples of one pixel are not independent: the profile's noise is about that of one pixel
    sigma = fit.sigma * noise[:, None] * scale[:, None]
    distance = np.abs(fit.amplitude * scale[:, None] - 0.5)
    good &= (distance > np.maximum(_MARGIN, 4.0 * sigma)).all(axis=1)
    # too blurred to be distinguished
    good &= (factor.max(axis=1) > 0.35).all(axis=1) & (sigma_angle.max(axis=1) < 0.45 * pattern.step)
    templates, _ = _segments(pattern.angles, fit.phase, sigma_angle, pattern.segments)
    predicted = np.einsum("npk,nk->np", templates, fit.bits.astype(float))
    misfit = ring * scale[:, None, None] - factor * predicted[:, None, :]
    # a slow change of brightness around the ring is shading, not a wrong code
    relative = noise * scale
    rms = np.sqrt((misfit**2).mean(axis=(1, 2)))
    good &= rms < np.hypot(_RMS_MAX, relative)
    patch = 0.5 * (misfit[:, 0::2] + misfit[:, 1::2])
    patch = 0.5 * (patch + np.roll(patch, 1, axis=2))
    good &= np.abs(patch).max(axis=(1, 2)) < np.hypot(_PATCH_MAX, 3.0 * relative)
    smooth_gap = gap.mean(axis=1)
    smooth_gap = (smooth_gap + np.roll(smooth_gap, 1, axis=1) + np.roll(smooth_gap, -1, axis=1)) / 3.0
    # light that the ring's own blur brings into the gap
    leak = (1.0 - factor[:, 0]) * predicted * level[:, None] * 0.5
    good &= (np.abs(smooth_gap) < np.hypot(_GAP_MAX, 3.0 * noise)[:, None] + leak).all(axis=1)
    return good


def ring_glare(xy: Array, b: Array, s: Array, reading: RingReadings, row: Array, x: Array, y: Array) -> Array:
    """Predicted brightness of the ring by the dot's contrast, (n, p), at pixels (n, p), for readings `row`."""
    matrix, pattern = _matrices(b), reading.pattern
    phi, count = pattern.angles, len(pattern.angles)
    # around the ring the brightness depends on the angle alone; its blur is that at the ring's inner edge, from where
    # the glare comes
    tangent = np.stack([-np.sin(phi), np.cos(phi)], axis=-1)
    angular = s[:, None] * np.linalg.norm(np.einsum("nij,aj->nai", matrix, tangent), axis=-1) / pattern.in_ring[0]
    segments, _ = _segments(phi, reading.phase[row], angular, pattern.segments)
    lit = reading.level[row][:, None] * reading.bits[row]
    around = np.einsum("npk,nk->np", segments, lit).astype(x.dtype)
    cx, cy, b11, b12, b22, blur = (column.astype(x.dtype)[:, None] for column in (*xy.T, *b.T, s))
    dx, dy = x - cx, y - cy
    u, v = b11 * dx + b12 * dy, b12 * dx + b22 * dy
    rho = np.maximum(np.sqrt(u * u + v * v), 1e-6)
    n1, n2 = u / rho, v / rho
    radial = blur * np.sqrt((b11 * n1 + b12 * n2) ** 2 + (b12 * n1 + b22 * n2) ** 2)
    place = np.arctan2(v, u) % (2.0 * np.pi) * (count / (2.0 * np.pi)) - 0.5
    lower = np.floor(place)
    part, lower = place - lower, lower.astype(np.int64)
    rows = np.arange(len(xy))[:, None]
    total = around[rows, lower % count] * (1.0 - part) + around[rows, (lower + 1) % count] * part
    across = tail((pattern.inner - rho) / radial) - tail((pattern.outer - rho) / radial)
    return np.asarray(total * across)
