"""Noise of one image, estimated from the image itself: variance = read variance + gain * (grey value - black).

High-pass estimate of Immerkaer (1996), "Fast noise variance estimation", Computer Vision and Image Understanding
64(2): the mask (1 -2 1; -2 4 -2; 1 -2 1) answers nothing to planes and little to smooth structure. It is taken on
tiles spread over the image; the median of the quieter ones at each grey level is kept.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_TILE = 12  # px; three by three blocks of four
_TILES_MAX = 3000


@dataclass(frozen=True)
class NoiseModel:
    """variance(I) = variance + gain * max(I - level, 0), in squared grey values.

    Attributes
    ----------
    variance : at the grey value `level` (read noise, quantisation, and shot noise there).
    gain : shot noise, grey values per electron; 0 where the image does not determine it.
    level : grey value of the dark ground of the image.
    correlation : variance of sums over neighbouring pixels by that of white noise, >= 1 (JPEG, demosaicing).
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
    """(k, 12, 12) tiles spread evenly over the image."""
    height, width = image.shape
    rows, columns = height // _TILE, width // _TILE
    step = max(1, int(np.ceil(np.sqrt(rows * columns / _TILES_MAX))))
    cut = image[: rows * _TILE, : columns * _TILE].reshape(rows, _TILE, columns, _TILE)[::step, :, ::step]
    return cut.transpose(0, 2, 1, 3).reshape(-1, _TILE, _TILE).astype(float)


def _high_pass_variance(tiles: Array) -> Array:
    """(k,) variance by Immerkaer's mask: mean square of its answers by the sum of its squared weights, 36."""
    second = tiles[:, :, 2:] - 2.0 * tiles[:, :, 1:-1] + tiles[:, :, :-2]
    answer = second[:, 2:] - 2.0 * second[:, 1:-1] + second[:, :-2]
    return np.asarray((answer**2).mean(axis=(1, 2)) / 36.0)


def _block_variance(tiles: Array) -> Array:
    """(k,) variance of the means of 4x4 blocks around the tile's plane, times 16: that of a pixel for white noise."""
    means = tiles.reshape(len(tiles), 3, 4, 3, 4).mean(axis=(2, 4))
    means = means - means.mean(axis=(1, 2), keepdims=True)
    by_row = 0.5 * (means[:, 2] - means[:, 0]).mean(axis=1)
    by_column = 0.5 * (means[:, :, 2] - means[:, :, 0]).mean(axis=1)
    ramp = np.array([-1.0, 0.0, 1.0])
    means = means - by_row[:, None, None] * ramp[:, None] - by_column[:, None, None] * ramp
    return np.asarray((means**2).sum(axis=(1, 2)) * 16.0 / _BLOCK_DOF)


_BLOCK_DOF = 6  # nine means, three parameters of the plane
_CHI2_THIRD = 4.1973 / 6.0  # 35 % quantile of chi-square with six degrees of freedom, by six


def estimate_noise(image: NDArray) -> NoiseModel:
    """Noise model of a grey image of shape (h, w), 8 or 16 bit.

    Tiles are chosen by the flatness of their block means, which for white noise is independent of the high-pass
    variance that is then averaged over them: choosing does not bias.

    Weakness: texture that fills the whole image counts as noise; the gain needs smooth areas of different grey
    values and is 0 otherwise (see :func:`with_gain`).
    """
    step = float(quantisation_step(image))
    floor = step**2 / 12.0
    if min(image.shape) < _TILE:
        return NoiseModel(max(float(np.var(image)) / 2.0, floor), 0.0, float(np.median(image)), 1.0, step)
    tiles = _tiles(image)
    level = tiles.mean(axis=(1, 2))
    variance = _high_pass_variance(tiles)
    # tiles at 0 or at the top of the range are clipped: no noise to be seen there
    top = float(np.iinfo(image.dtype).max)
    usable = (level > 0.5 * step) & (level < 0.98 * top) & (variance > 0)
    if usable.sum() < 4:
        return NoiseModel(floor, 0.0, float(np.median(level)), 1.0, step)
    tiles, level, variance = tiles[usable], level[usable], variance[usable]
    structure = _block_variance(tiles)
    classes = np.array_split(np.argsort(level), min(12, max(1, len(level) // 40)))
    flat = [chosen[np.argsort(structure[chosen])[: max(2, int(np.ceil(0.35 * len(chosen))))]] for chosen in classes]
    bin_level = np.array([level[chosen].mean() for chosen in flat])
    bin_variance = np.array([_trimmed_mean(variance[chosen]) for chosen in flat])
    # a class in which even the flattest tiles have structure is not used
    even = np.array(
        [
            np.median(structure[chosen]) < 4.0 * _CHI2_THIRD * max(float(np.median(variance[chosen])), floor)
            for chosen in flat
        ]
    )
    if even.any():
        bin_level, bin_variance = bin_level[even], bin_variance[even]
    dark = float(np.median(level))
    gain = 0.0
    if len(bin_level) >= 4 and np.ptp(bin_level) > 0.1 * top:
        # Theil-Sen slope: robust to single classes with texture
        i, j = np.triu_indices(len(bin_level), 1)
        apart = (bin_level[j] - bin_level[i]) > 0.02 * top
        slopes = (bin_variance[j] - bin_variance[i])[apart] / (bin_level[j] - bin_level[i])[apart]
        gain = max(0.0, float(np.median(slopes))) if len(slopes) else 0.0
    at_dark = max(float(np.median(bin_variance - gain * (bin_level - dark))), floor)
    return NoiseModel(at_dark, gain, dark, 1.0, step)


def _trimmed_mean(values: Array) -> float:
    """Mean without the highest and the lowest tenth."""
    ordered = np.sort(values)
    cut = len(ordered) // 10
    return float(ordered[cut : len(ordered) - cut].mean())


def with_gain(noise: NoiseModel, grey: Array, variance: Array, weight: Array) -> NoiseModel:
    """The model with the gain from variances seen inside bright dots.

    Parameters
    ----------
    grey, variance, weight : (k,) mean grey value and residual variance of the bright pixels of each dot, and the
        number of free residuals behind it.
    """
    signal = np.asarray(grey, dtype=float) - noise.level
    use = (np.abs(signal) > 8.0 * noise.sigma) & (weight > 0)
    if weight[use].sum() < 30.0:
        return noise
    grey_signal, found, count = _pooled(signal[use], np.asarray(variance)[use], np.asarray(weight)[use])
    # weighted median: single dots with dirt do not count. The median of a mean of k squares lies below its
    # expectation by the factor 1 - 2 / (9 k) cubed (Wilson and Hilferty)
    gain = (found / (1.0 - 2.0 / (9.0 * count)) ** 3 - noise.variance) / grey_signal
    order = np.argsort(gain)
    cumulated = np.cumsum((count * np.abs(grey_signal))[order])
    middle = float(gain[order][np.searchsorted(cumulated, 0.5 * cumulated[-1])])
    positive = middle if noise.gain >= 0 else min(middle, 0.0)
    return NoiseModel(
        noise.variance, max(positive, 0.0) if noise.gain >= 0 else positive, noise.level, noise.correlation, noise.step
    )


def _pooled(signal: Array, variance: Array, weight: Array) -> tuple[Array, Array, Array]:
    """Neighbours in brightness put together until each has at least four free residuals behind it."""
    order = np.argsort(signal)
    group = np.floor(np.cumsum(weight[order]) / 4.0).astype(int)
    group = np.unique(group, return_inverse=True)[1]
    total = np.bincount(group, weight[order])
    return (
        np.bincount(group, (weight * signal)[order]) / total,
        np.bincount(group, (weight * variance)[order]) / total,
        total.astype(np.float64),
    )


def correlation_factor(lag_one: float) -> float:
    """Variance of sums over neighbouring pixels by that of white noise, from the correlation of direct neighbours.

    Noise is taken as a separable first-order process, whose spectrum at long waves is ((1 + r) / (1 - r))^2 of white;
    above r = 0.5 the residuals are texture, not noise.
    """
    r = min(lag_one, 0.5)
    return ((1.0 + r) / (1.0 - r)) ** 2 if r > 0.05 else 1.0
