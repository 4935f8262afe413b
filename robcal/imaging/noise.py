"""Noise of one image, estimated from the image itself: variance = read variance + gain * (grey value - black).

High-pass estimate of Immerkaer (1996), "Fast noise variance estimation", Computer Vision and Image Understanding
64(2): the mask (1 -2 1; -2 4 -2; 1 -2 1) answers nothing to planes and little to smooth structure. It is taken on
tiles spread over the image; the median of the quieter ones at each grey level is kept.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_TILE = 36  # px; divisible by 3 for the block means
_TILES_MAX = 500


@dataclass(frozen=True)
class NoiseModel:
    """variance(I) = variance + gain * max(I - level, 0), in squared grey values.

    Attributes
    ----------
    variance : at the grey value `level` (read noise, quantisation, and shot noise there).
    gain : shot noise, grey values per electron; 0 where the image does not tell.
    level : grey value of the dark ground of the image.
    correlation : variance of block means by that of white noise, >= 1 (JPEG, demosaicing, sharpening).
    step : quantisation step, grey values (4 for 14-bit data stretched to 16).
    """

    variance: float
    gain: float
    level: float
    correlation: float = 1.0
    step: float = 1.0

    @property
    def sigma(self) -> float:
        """Standard deviation at the dark ground."""
        return float(np.sqrt(self.variance))

    def at(self, grey: Array | float) -> Array:
        """Variance at grey values of any shape; never below the quantisation's."""
        return np.maximum(self.variance + self.gain * (np.asarray(grey) - self.level), self.step**2 / 12.0)


def quantisation_step(image: NDArray) -> int:
    """Largest power of two that divides all grey values (of a sample of the image)."""
    bits = int(np.bitwise_or.reduce(image[:: max(1, image.shape[0] // 256)].ravel()))
    return 1 if bits == 0 else bits & -bits


def _tiles(image: NDArray) -> Array:
    """(k, size, size) tiles spread evenly over the image."""
    height, width = image.shape
    size = min(_TILE, height - height % 3, width - width % 3)
    rows, columns = height // size, width // size
    step = max(1, int(np.ceil(np.sqrt(rows * columns / _TILES_MAX))))
    return np.stack(
        [
            image[r * size : (r + 1) * size, c * size : (c + 1) * size]
            for r in range(0, rows, step)
            for c in range(0, columns, step)
        ]
    ).astype(float)


def _high_pass_variance(tiles: Array) -> Array:
    """(k,) variance by Immerkaer's mask, by the 68 % quantile of the absolute answers (robust to few edges)."""
    second = tiles[:, :, 2:] - 2.0 * tiles[:, :, 1:-1] + tiles[:, :, :-2]
    answer = np.abs(second[:, 2:] - 2.0 * second[:, 1:-1] + second[:, :-2]).reshape(len(tiles), -1)
    # mean of the absolute values below their 80 % quantile: for a normal distribution 0.5569 sigma; unlike a
    # quantile it is not itself quantised when the noise is about one grey value
    answer.sort(axis=1)
    kept = answer[:, : max(1, int(0.8 * answer.shape[1]))]
    return (kept.mean(axis=1) / (6.0 * _TRIMMED_MEAN)) ** 2


# E|z| below the 80 % quantile c = 1.28155 of |z|: 2 (phi(0) - phi(c)) / 0.8
_TRIMMED_MEAN = 2.0 * (0.3989422804 - 0.1754983319) / 0.8


def estimate_noise(image: NDArray) -> NoiseModel:
    """Noise model of a grey image of shape (h, w), 8 or 16 bit.

    Weakness: texture that fills the whole image counts as noise; the gain needs smooth areas of different grey
    values and is 0 otherwise (see :func:`with_gain`).
    """
    step = float(quantisation_step(image))
    if min(image.shape) < 9:
        return NoiseModel(max(float(np.var(image)) / 2.0, step**2 / 12.0), 0.0, float(np.median(image)), 1.0, step)
    tiles = _tiles(image)
    level = tiles.mean(axis=(1, 2))
    variance = _high_pass_variance(tiles)
    # whole tiles at 0 or at the top of the range are clipped: no noise to be seen there
    top = float(np.iinfo(image.dtype).max)
    usable = (level > 0.5 * step) & (level < 0.98 * top) & (variance > 0)
    if usable.sum() < 4:
        return NoiseModel(step**2 / 12.0, 0.0, float(np.median(level)), 1.0, step)
    tiles, level, variance = tiles[usable], level[usable], variance[usable]
    # quieter half within each of up to 12 grey classes: texture only adds
    order = np.argsort(level)
    bins = np.array_split(order, min(12, max(1, len(order) // 12)))
    quiet = [chosen[np.argsort(variance[chosen])[: max(2, int(np.ceil(0.6 * len(chosen))))]] for chosen in bins]
    bin_level = np.array([level[chosen].mean() for chosen in quiet])
    bin_variance = np.array([np.median(variance[chosen]) for chosen in quiet])
    dark = float(np.median(level))
    gain = 0.0
    if len(bins) >= 4 and np.ptp(bin_level) > 0.1 * top:
        # Theil-Sen slope: robust to classes in which every tile is textured
        i, j = np.triu_indices(len(bins), 1)
        apart = (bin_level[j] - bin_level[i]) > 0.02 * top
        if apart.any():
            gain = max(0.0, float(np.median((bin_variance[j] - bin_variance[i])[apart] / (bin_level[j] - bin_level[i])[apart])))
    at_dark = float(np.median(bin_variance - gain * (bin_level - dark)))
    at_dark = max(at_dark, step**2 / 12.0)
    return NoiseModel(at_dark, gain, dark, _correlation(tiles, variance, step), step)


def _correlation(tiles: Array, variance: Array, step: float) -> float:
    """Variance of 3x3 block means times 9 by the pixels' variance, on the quietest tiles; 1 for white noise."""
    blocks = tiles.shape[1] // 3
    if blocks < 6:
        return 1.0
    means = tiles.reshape(len(tiles), blocks, 3, blocks, 3).mean(axis=(2, 4))
    ratio = 9.0 * _high_pass_variance(means) / np.maximum(variance, step**2 / 12.0)
    typical = float(np.quantile(ratio, 0.25))
    # sampling scatter of the quartile stays well below 1.3 for white noise; smooth structure raises it little
    return min(typical, 16.0) if typical > 1.3 else 1.0


def with_gain(noise: NoiseModel, grey: Array, variance: Array) -> NoiseModel:
    """The model with the gain from variances seen inside bright dots.

    Parameters
    ----------
    grey, variance : (k,) mean grey value and residual variance of the inside of each dot.
    """
    lift = np.asarray(grey, dtype=float) - noise.level
    far = np.abs(lift) > 20.0 * noise.sigma
    if far.sum() < 3:
        return noise
    gain = max(0.0, float(np.median((np.asarray(variance)[far] - noise.variance) / np.abs(lift[far]))))
    return NoiseModel(noise.variance, gain, noise.level, noise.correlation, noise.step)
