"""Compiled Levenberg-Marquardt loop of :mod:`robcal.imaging.ellipse_fit`: one dot after the other, no copies.

Pixels are taken in blocks that stay in the processor's nearest cache; model and derivatives of a block are in single
precision (formulas of :mod:`robcal.imaging.edge_model`), sums over blocks, parameters and equations in double.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from robcal.jit import compiled, inner

Array = NDArray[np.float64]

_BLOCK = 64  # pixels; a constant in the row offsets of `table` lets the compiler see that rows do not overlap
_N = 12  # parameters
# rows of the table beyond the derivatives by the parameters
_RESIDUAL, _WEIGHTED, _ROWS = 12, 13, 14
# rows of a dot's pixels
_X, _Y, _U, _V, _VALUE, _PRECISION, _SATURATED, _NEW, _BEST = 0, 1, 2, 3, 4, 5, 6, 7, 8
_PIXEL_ROWS = 9

_0, _1, _2, _HALF = np.float32(0.0), np.float32(1.0), np.float32(2.0), np.float32(0.5)
_LOG2E = np.float32(1.4426950408889634)
_INV_SQRT_2PI = np.float32(0.3989422804014327)
_T2_MAX = np.float32(40.0)  # beyond nine sigma nothing is left
_TINY, _SMALL = np.float32(1e-18), np.float32(1e-9)
# 2^f on [-1/2, 1/2], Taylor's series in f ln 2: error below 2e-7
_E1, _E2, _E3 = np.float32(0.6931471806), np.float32(0.2402265070), np.float32(0.0555041087)
_E4, _E5, _E6 = np.float32(0.0096181291), np.float32(0.0013333558), np.float32(0.0001540353)
# normal tail: Abramowitz and Stegun (1964), 26.2.17
_P = np.float32(0.2316419)
_A1, _A2, _A3 = np.float32(0.319381530), np.float32(-0.356563782), np.float32(1.781477937)
_A4, _A5 = np.float32(-1.821255978), np.float32(1.330274429)
_BIAS, _SHIFT = np.int32(127), np.int32(23)


class Dots(NamedTuple):
    """What n dots are fitted to, p pixels each.

    `x`, `y`, `u`, `v`, `value` (n, p) places and grey values as in :class:`robcal.imaging.windows.Windows`; `used`,
    `saturated` (n, p) bool, of which the first `counts` (n,) pixels of a row are looked at; `is_spot` (n,); `priors`
    (n, 5) ln s, its precision, sigma of the shading by the contrast, radius, number of pixels used.
    """

    x: NDArray
    y: NDArray
    u: NDArray
    v: NDArray
    value: NDArray
    used: NDArray[np.bool_]
    saturated: NDArray[np.bool_]
    counts: NDArray[np.int64]
    is_spot: NDArray[np.bool_]
    priors: Array


class Fits(NamedTuple):
    """The fits as in :class:`robcal.imaging.ellipse_fit.EllipseFits`."""

    parameters: Array
    normal: Array
    cost: Array
    converged: NDArray[np.bool_]
    weight: NDArray
    residual: NDArray


@inner
def _exp(z):  # type: ignore[no-untyped-def]
    """exp(z) of single precision for -80 < z <= 0, without a call, so that loops over it use vector instructions."""
    y = z * _LOG2E
    whole = np.floor(y + _HALF)
    f = y - whole
    power = _1 + f * (_E1 + f * (_E2 + f * (_E3 + f * (_E4 + f * (_E5 + f * _E6)))))
    scale = np.int32((np.int32(whole) + _BIAS) << _SHIFT).view(np.float32)
    return power * scale


@inner
def _edge_columns(q, pixels, begin, m, table):  # type: ignore[no-untyped-def]
    """Derivatives by the shape into rows 0 to 5 of the table, profile into row 9, residual into row 12."""
    cx, cy, b11, b12, b22, by_s = q[0], q[1], q[2], q[3], q[4], q[5]
    b0, b1, b2, g0, g1, g2 = q[6], q[7], q[8], q[9], q[10], q[11]
    k = b11 * b22 - b12 * b12
    by_k_inverse = _1 / k
    for i in range(m):
        u, v = pixels[_U, begin + i], pixels[_V, begin + i]
        dx, dy = pixels[_X, begin + i] - cx, pixels[_Y, begin + i] - cy
        u1, u2 = b11 * dx + b12 * dy, b12 * dx + b22 * dy
        v1, v2 = b11 * u1 + b12 * u2, b12 * u1 + b22 * u2
        z1, z2 = b11 * v1 + b12 * v2, b12 * v1 + b22 * v2
        r2 = u1 * u1 + u2 * u2
        w = max(np.sqrt(v1 * v1 + v2 * v2), _SMALL)
        inside = _1 if r2 < _1 else _0
        outside = _1 - inside
        root = np.sqrt(inside * max(w * w + k * (_1 - r2), _TINY) + outside * r2)
        d = (inside * w + outside * r2 - root) / (inside * k + outside * w)
        by_root, by_w = _1 / root, _1 / w
        within, beyond = inside * by_k_inverse, outside * by_w
        by_q = inside * by_root + beyond * (_2 - by_root)
        by_w2 = within * (by_w - by_root) - beyond * by_w * d
        by_k = -within * (_HALF * (_1 - r2) * by_root + d)
        along1, along2 = by_q * u1 + by_w2 * z1, by_q * u2 + by_w2 * z2
        t = d * by_s
        density = _INV_SQRT_2PI * _exp(-_HALF * min(t * t, _T2_MAX))
        h = _1 / (_1 + _P * abs(t))
        tail = density * h * (_A1 + h * (_A2 + h * (_A3 + h * (_A4 + h * _A5))))
        profile = tail if t > _0 else _1 - tail
        gain = g0 + g1 * u + g2 * v
        slope = -gain * density * by_s
        table[i] = -slope * (b11 * along1 + b12 * along2)
        table[_BLOCK + i] = -slope * (b12 * along1 + b22 * along2)
        table[2 * _BLOCK + i] = slope * (along1 * dx + by_w2 * (v1 * u1) + by_k * b22)
        table[3 * _BLOCK + i] = slope * (along1 * dy + along2 * dx + by_w2 * (v1 * u2 + v2 * u1) - _2 * by_k * b12)
        table[4 * _BLOCK + i] = slope * (along2 * dy + by_w2 * (v2 * u2) + by_k * b11)
        table[5 * _BLOCK + i] = gain * density * t
        table[9 * _BLOCK + i] = profile
        table[_RESIDUAL * _BLOCK + i] = pixels[_VALUE, begin + i] - (b0 + b1 * u + b2 * v + gain * profile)


@inner
def _spot_columns(q, pixels, begin, m, table):  # type: ignore[no-untyped-def]
    """The same for a Gaussian spot."""
    cx, cy, b11, b12, b22 = q[0], q[1], q[2], q[3], q[4]
    b0, b1, b2, g0, g1, g2 = q[6], q[7], q[8], q[9], q[10], q[11]
    for i in range(m):
        u, v = pixels[_U, begin + i], pixels[_V, begin + i]
        dx, dy = pixels[_X, begin + i] - cx, pixels[_Y, begin + i] - cy
        u1, u2 = b11 * dx + b12 * dy, b12 * dx + b22 * dy
        profile = _exp(-_HALF * min(u1 * u1 + u2 * u2, _T2_MAX))
        gain = g0 + g1 * u + g2 * v
        slope = gain * profile
        table[i] = slope * (b11 * u1 + b12 * u2)
        table[_BLOCK + i] = slope * (b12 * u1 + b22 * u2)
        table[2 * _BLOCK + i] = -slope * u1 * dx
        table[3 * _BLOCK + i] = -slope * (u1 * dy + u2 * dx)
        table[4 * _BLOCK + i] = -slope * u2 * dy
        table[5 * _BLOCK + i] = _0
        table[9 * _BLOCK + i] = profile
        table[_RESIDUAL * _BLOCK + i] = pixels[_VALUE, begin + i] - (b0 + b1 * u + b2 * v + gain * profile)


@inner
def _block(parameters, spot, pixels, begin, m, table):  # type: ignore[no-untyped-def]
    """Model and derivatives of the pixels begin to begin + m into the table."""
    q = np.empty(_N, np.float32)
    for k in range(_N):
        q[k] = np.float32(parameters[k])
    q[5] = np.float32(np.exp(-parameters[5]))
    if spot:
        _spot_columns(q, pixels, begin, m, table)
    else:
        _edge_columns(q, pixels, begin, m, table)
    for i in range(m):
        profile, u, v = table[9 * _BLOCK + i], pixels[_U, begin + i], pixels[_V, begin + i]
        table[6 * _BLOCK + i] = _1
        table[7 * _BLOCK + i] = u
        table[8 * _BLOCK + i] = v
        table[10 * _BLOCK + i] = profile * u
        table[11 * _BLOCK + i] = profile * v


@inner
def _system(parameters, spot, pixels, count, first, noise, priors, table, system):  # type: ignore[no-untyped-def]  # noqa: PLR0913
    """Normal equations with priors in the lower triangle of `system` (13, 13), its last entry the cost.

    With `first` the precision of the used pixels (those with any) is set to what the noise model says of their model.
    """
    system[:, :] = 0.0
    for begin in range(0, count, _BLOCK):
        m = min(_BLOCK, count - begin)
        _block(parameters, spot, pixels, begin, m, table)
        if first:
            for i in range(begin, begin + m):
                model = pixels[_VALUE, i] - table[_RESIDUAL * _BLOCK + i - begin]
                inverse = 1.0 / max(noise[0] + noise[1] * (np.float64(model) - noise[2]), noise[3])
                pixels[_PRECISION, i] = np.float32(inverse) if pixels[_PRECISION, i] > _0 else _0
        for i in range(m):
            pixels[_NEW, begin + i] = table[_RESIDUAL * _BLOCK + i]
        for a in range(_N + 1):
            for i in range(m):
                # a saturated pixel above whose level the model is fits
                fits = pixels[_SATURATED, begin + i] > _0 and pixels[_NEW, begin + i] < _0
                weight = _0 if fits else pixels[_PRECISION, begin + i]
                table[_WEIGHTED * _BLOCK + i] = weight * table[a * _BLOCK + i]
            for b in range(a + 1):
                total = _0
                for i in range(m):
                    total += table[_WEIGHTED * _BLOCK + i] * table[b * _BLOCK + i]
                system[a, b] += total
    offset, precision = priors[0] - parameters[5], priors[1]
    system[5, 5] += precision
    system[_N, 5] += precision * offset
    system[_N, _N] += precision * offset**2
    contrast = abs(parameters[9])
    sigma = priors[2] * max(contrast, 1e-3)
    for k in range(10, 12):
        system[k, k] += 1.0 / sigma**2
        system[_N, k] -= parameters[k] / sigma**2
        system[_N, _N] += (parameters[k] / sigma) ** 2
    # a contrast that only censored pixels know stays finite
    system[9, 9] += 1e-4 / max(contrast, 1.0) ** 2


@inner
def _solve(system, damping, factor, step):  # type: ignore[no-untyped-def]
    """Step of the damped equations scaled to unit diagonal, by L D L' factors; row 12 of `factor` holds the scales."""
    for a in range(_N):
        factor[_N, a] = 1.0 / np.sqrt(max(system[a, a], 1e-300))
    for a in range(_N):
        total = system[_N, a] * factor[_N, a]
        for b in range(a):
            entry = system[a, b] * factor[_N, a] * factor[_N, b]
            for k in range(b):
                entry -= factor[a, k] * factor[b, k] * factor[k, k]
            factor[a, b] = entry / factor[b, b]
            total -= factor[a, b] * step[b]
        pivot = 1.0 + max(damping, 1e-10)
        for k in range(a):
            pivot -= factor[a, k] ** 2 * factor[k, k]
        factor[a, a], step[a] = pivot, total
    for a in range(_N - 1, -1, -1):
        total = step[a] / factor[a, a]
        for k in range(a + 1, _N):
            total -= factor[k, a] * step[k]
        step[a] = total
    for a in range(_N):
        step[a] *= factor[_N, a]


@inner
def _limit(step, parameters, radius):  # type: ignore[no-untyped-def]
    """Makes the step no larger than a part of the dot."""
    part = min(1.0, 0.3 * (radius + 1.0) / max(np.sqrt(step[0] ** 2 + step[1] ** 2), 1e-12))
    part = min(part, 0.7 / max(abs(step[5]), 1e-12))
    size = abs(parameters[2]) + abs(parameters[4])
    part = min(part, 0.4 * size / max(abs(step[2]) + abs(step[3]) + abs(step[4]), 1e-12))
    for k in range(_N):
        step[k] *= part


@inner
def _minimise(parameters, spot, pixels, count, noise, priors, rule, table, best):  # type: ignore[no-untyped-def]  # noqa: PLR0913
    """One dot: parameters, the system `best` and the residuals change in place; returns convergence.

    `priors`: ln s, its precision, shading, radius, number of pixels used. `rule` as in :func:`minimise_all`.
    """
    system, factor = np.empty((_N + 1, _N + 1)), np.empty((_N + 1, _N + 1))
    step, trial = np.empty(_N), np.empty(_N)
    radius, used = priors[3], priors[4]
    _system(parameters, spot, pixels, count, True, noise, priors, table, best)
    for i in range(count):
        pixels[_BEST, i] = pixels[_NEW, i]
    damping = 1e-4
    for _ in range(int(rule[0])):
        _solve(best, damping, factor, step)
        if spot:
            step[5] = 0.0
        _limit(step, parameters, radius)
        possible, move = True, 0.0
        for a in range(_N):
            trial[a] = parameters[a] + step[a]
            possible = possible and np.isfinite(trial[a])
            for b in range(a):
                move += 2.0 * step[a] * best[a, b] * step[b]
            move += step[a] * best[a, a] * step[a]
        # of misfit as large as k sigma the minimum need not be known better than k sigma
        move /= max(1.0, best[_N, _N] / used)
        trial[5] = min(max(trial[5], rule[3]), np.log(max(radius, 1.0) * 2.0))
        better = False
        if possible and trial[2] * trial[4] > trial[3] ** 2 and trial[2] > 0.0:
            _system(trial, spot, pixels, count, False, noise, priors, table, system)
            better = system[_N, _N] <= best[_N, _N] * (1.0 + rule[2]) + 1e-9
        if better:
            for a in range(_N + 1):
                for b in range(a + 1):
                    best[a, b] = system[a, b]
            for a in range(_N):
                parameters[a] = trial[a]
            for i in range(count):
                pixels[_BEST, i] = pixels[_NEW, i]
        damping = damping * 0.1 if better else max(damping * 20.0, 1e-3)
        if move < rule[1] ** 2 or (not better and damping > 1e4):
            return True
    return False


@inner
def _take_pixels(dots, k, pixels):  # type: ignore[no-untyped-def]
    """Places and grey values of one dot into the rows of `pixels`."""
    for i in range(dots.counts[k]):
        pixels[_X, i], pixels[_Y, i], pixels[_VALUE, i] = dots.x[k, i], dots.y[k, i], dots.value[k, i]
        pixels[_U, i], pixels[_V, i] = dots.u[k, i], dots.v[k, i]


@compiled
def minimise_all(dots, noise, rule, fits):  # type: ignore[no-untyped-def]
    """Fits all dots of a group; `fits` is changed in place.

    Parameters
    ----------
    noise : (4,) variance, gain, level, least variance. rule : (4,) steps, tolerance, relative accuracy of a cost,
        least ln s.
    """
    pixels = np.zeros((_PIXEL_ROWS, dots.used.shape[1]), np.float32)
    table, best = np.zeros(_ROWS * _BLOCK, np.float32), np.empty((_N + 1, _N + 1))
    for k in range(len(dots.counts)):
        count = dots.counts[k]
        _take_pixels(dots, k, pixels)
        for i in range(count):
            pixels[_PRECISION, i] = _1 if dots.used[k, i] else _0
            pixels[_SATURATED, i] = _1 if dots.saturated[k, i] else _0
        fits.converged[k] = _minimise(
            fits.parameters[k], dots.is_spot[k], pixels, count, noise, dots.priors[k], rule, table, best
        )
        fits.cost[k] = best[_N, _N]
        for a in range(_N):
            for b in range(a + 1):
                fits.normal[k, a, b] = fits.normal[k, b, a] = best[a, b]
        for i in range(count):
            fits.residual[k, i] = pixels[_BEST, i]
            above = dots.saturated[k, i] and pixels[_BEST, i] < _0
            fits.weight[k, i] = _0 if above else pixels[_PRECISION, i]


@compiled
def sum_bright(dots, parameters, weight, covariance, sums):  # type: ignore[no-untyped-def]
    """Redundancy, sum of squares, and sum of redundancy times grey value (n, 3) of the bright pixels of dots.

    Parameters
    ----------
    weight : (n, p) of the fits, covariance : (n, 12, 12) of the parameters (n, 12). Bright: above 0.6 of the contrast.
    """
    pixels, table = np.zeros((_PIXEL_ROWS, dots.used.shape[1]), np.float32), np.zeros(_ROWS * _BLOCK, np.float32)
    for k in range(len(dots.counts)):
        count, half = dots.counts[k], parameters[k, 6] + 0.6 * parameters[k, 9]
        _take_pixels(dots, k, pixels)
        for begin in range(0, count, _BLOCK):
            m = min(_BLOCK, count - begin)
            _block(parameters[k], dots.is_spot[k], pixels, begin, m, table)
            for i in range(m):
                residual = table[_RESIDUAL * _BLOCK + i]
                model = pixels[_VALUE, begin + i] - residual
                if weight[k, begin + i] <= _0 or model <= half:
                    continue
                leverage = 0.0
                for a in range(_N):
                    total = 0.5 * covariance[k, a, a] * table[a * _BLOCK + i]
                    for b in range(a):
                        total += covariance[k, a, b] * table[b * _BLOCK + i]
                    leverage += 2.0 * total * table[a * _BLOCK + i]
                free = min(max(1.0 - leverage * weight[k, begin + i], 0.0), 1.0)
                sums[k, 0] += free
                sums[k, 1] += residual * residual
                sums[k, 2] += free * model
