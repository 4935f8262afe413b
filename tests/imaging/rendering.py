"""The tests' renderer: ellipses and ring codes by supersampling, Gaussian blur, noise. Independent of robcal."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Dot:
    """A dot: centre (x, y), semi-axes, angle of the first, and the segments of its ring as a reading (or None)."""

    x: float
    y: float
    a: float
    b: float
    angle: float = 0.0
    bits: int | None = None
    phase: float = 0.0
    amplitude: float = 1.0


def render(
    width: int,
    height: int,
    dots: list[Dot],
    blur: float = 0.7,
    sub: int = 8,
    gradient: tuple[float, float] = (0.0, 0.0),
) -> Array:
    """Light in 0..1, (height, width); `gradient` is the relative change of each dot's brightness per pixel."""
    light = np.zeros((height, width))
    for dot in dots:
        reach = (3.2 if dot.bits is not None else 1.0) * max(dot.a, dot.b) + 6 * blur + 2
        x0, x1 = max(0, int(dot.x - reach)), min(width, int(dot.x + reach) + 1)
        y0, y1 = max(0, int(dot.y - reach)), min(height, int(dot.y + reach) + 1)
        if x1 <= x0 or y1 <= y0:
            continue
        pad = int(np.ceil(4 * blur))
        gx = (np.arange((x1 - x0 + 2 * pad) * sub) + 0.5) / sub - 0.5 + x0 - pad - dot.x
        gy = (np.arange((y1 - y0 + 2 * pad) * sub) + 0.5) / sub - 0.5 + y0 - pad - dot.y
        c, s = np.cos(dot.angle), np.sin(dot.angle)
        u = (c * gx[None, :] + s * gy[:, None]) / dot.a
        v = (-s * gx[None, :] + c * gy[:, None]) / dot.b
        rho = np.hypot(u, v)
        shape = np.clip(0.5 - (rho - 1) * min(dot.a, dot.b) * sub, 0, 1)
        if dot.bits is not None:
            # image y is down: the angle from x to y is clockwise as seen
            segment = np.floor(((np.arctan2(v, u) - dot.phase) % (2 * np.pi)) / (np.pi / 6)).astype(int) % 12
            bright = ((dot.bits >> (11 - segment)) & 1).astype(bool)
            shape = np.where((rho > 2) & (rho < 3) & bright, 1.0, shape)
        shape *= dot.amplitude * (1 + gradient[0] * gx[None, :] + gradient[1] * gy[:, None])
        if blur > 0:
            shape = gaussian_filter(shape, blur * sub, mode="nearest")
        small = shape.reshape(y1 - y0 + 2 * pad, sub, x1 - x0 + 2 * pad, sub).mean(axis=(1, 3))
        light[y0:y1, x0:x1] += small[pad : small.shape[0] - pad, pad : small.shape[1] - pad]
    return light


def expose(
    light: Array,
    rng: np.random.Generator,
    contrast: float = 180.0,
    background: float = 15.0,
    read_noise: float = 1.0,
    gain: float = 0.05,
    bits: int = 8,
) -> NDArray:
    """Grey values with read noise (grey values) and shot noise (variance = gain * value), quantised and clipped."""
    value = background + contrast * light
    value = value + rng.normal(size=value.shape) * np.sqrt(read_noise**2 + gain * value)
    top = 255 if bits == 8 else 65535
    return np.clip(np.rint(value), 0, top).astype(np.uint8 if bits == 8 else np.uint16)


def scene(
    rng: np.random.Generator,
    width: int,
    height: int,
    count: int,
    size: tuple[float, float],
    codes: list[int],
    spacing: float,
) -> list[Dot]:
    """Dots at random places with random size, tilt and turn, at least `spacing` major axes apart."""
    dots: list[Dot] = []
    for _ in range(50 * count):
        if len(dots) == count:
            break
        a = rng.uniform(*size)
        b = a * rng.uniform(0.5, 1.0)
        bits = codes[len(dots)] if len(dots) < len(codes) else None
        reach = 3.3 * a if bits is not None else 1.5 * a
        x, y = rng.uniform(reach + 4, width - reach - 4), rng.uniform(reach + 4, height - reach - 4)
        if all(np.hypot(x - d.x, y - d.y) > spacing * (a + d.a) for d in dots):
            dots.append(Dot(x, y, a, b, rng.uniform(0, np.pi), bits, rng.uniform(0, 2 * np.pi)))
    return dots
