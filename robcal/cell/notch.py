"""Mastering by a notch: the joint angle at which the signal of its pin has an extremum."""

from dataclasses import dataclass

import numpy as np

from robcal.errors import DegenerateGeometry
from robcal.transforms import Array

HALF = 0.5
"""The signal is fitted where it has at least this share of the notch's depth."""
DEEP = 5.0
"""A notch is deeper than so many standard deviations of the signal's noise."""
FEWEST = 7


@dataclass(frozen=True)
class NotchExtremum:
    """Place of an extremum and its standard deviation, in the unit of q; degree of the polynomial that was fitted."""

    q: float
    sigma: float
    degree: int


def notch_extremum(q: Array, signal: Array) -> NotchExtremum:
    """The extremum of a notch's signal.

    Polynomials of degree 2 to 5 are fitted to the upper half of the notch, of which the Bayesian information criterion
    chooses one; its extremum's uncertainty follows from the residuals. Weakness: residuals count as independent.

    Raises
    ------
    DegenerateGeometry : no notch in the signal, one at the edge of the record, or too few readings of it.
    """
    order = np.argsort(q, kind="stable")
    q, signal = np.asarray(q, dtype=float)[order], np.asarray(signal, dtype=float)[order]
    base = float(np.median(signal))
    noise = float(np.median(np.abs(np.diff(signal)))) / 0.954  # of differences of two readings, to one reading
    smooth = np.convolve(signal - base, np.ones(3) / 3, mode="valid") if len(q) >= FEWEST else np.zeros(1)
    top = int(np.argmax(np.abs(smooth))) + 1
    depth = float(smooth[top - 1])
    if len(q) < FEWEST or abs(depth) <= DEEP * noise / np.sqrt(3):
        raise DegenerateGeometry("the signal shows no notch: drive through it slowly, with readings on both sides")
    inside = (signal - base) / depth > HALF
    low = high = top
    while low > 0 and inside[low - 1]:
        low -= 1
    while high < len(q) - 1 and inside[high + 1]:
        high += 1
    if low == 0 or high == len(q) - 1:
        raise DegenerateGeometry("the notch lies at the edge of the record: record further beyond it")
    if high - low + 1 < FEWEST:
        raise DegenerateGeometry(
            f"only {high - low + 1} readings in the upper half of the notch: {FEWEST} or more are needed, drive slower"
        )
    return _fitted(q[low : high + 1], signal[low : high + 1] / depth)


def _fitted(q: Array, signal: Array) -> NotchExtremum:
    middle, width = float(q.mean()), float(np.ptp(q)) / 2
    x = (q - middle) / width
    best: tuple[float, NotchExtremum] | None = None
    for degree in range(2, min(5, len(x) - 3) + 1):
        powers = np.vander(x, degree + 1)
        c = np.linalg.lstsq(powers, signal, rcond=None)[0]
        squares = max(float(np.sum((signal - powers @ c) ** 2)), 1e-300)
        first, second = np.polyder(c), np.polyder(c, 2)
        roots = np.roots(first)
        real = roots[np.abs(roots.imag) < 1e-9].real
        real = real[(np.abs(real) < 1) & (np.polyval(second, real) < 0)]
        if not len(real):
            continue
        at = float(real[np.argmax(np.polyval(c, real))])
        # c + dc moves the root of the slope by -slope(dc) / curvature
        gradient = -np.array([k * at ** (k - 1) if k else 0.0 for k in range(degree, -1, -1)]) / np.polyval(second, at)
        variance = squares / (len(x) - degree - 1) * float(gradient @ np.linalg.inv(powers.T @ powers) @ gradient)
        worth = len(x) * np.log(squares) + degree * np.log(len(x))
        if best is None or worth < best[0]:
            best = (worth, NotchExtremum(middle + width * at, width * float(np.sqrt(variance)), degree))
    if best is None:
        raise DegenerateGeometry("the signal has no single extremum inside the notch: record it again, more slowly")
    return best[1]
