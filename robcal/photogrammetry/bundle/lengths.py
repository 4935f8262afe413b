"""Known lengths in a network: scale from scale bars, contradictions among them, and check lengths.

Check lengths in the manner of VDI/VDE 2634 part 1: length measurement error = measured minus calibrated length.
"""

import numpy as np
from scipy import linalg

from robcal.errors import InvalidInput
from robcal.photogrammetry.core.network import IntArray, LengthKind, LengthResult, Lengths
from robcal.transforms import Array

_NOTE = 3.3
"""Standardised error of a scale bar from which on it is mentioned."""


def rows_of(lengths: Lengths, ids: IntArray) -> IntArray:
    """(k, 2) rows of the end points among ids.

    Raises
    ------
    InvalidInput : an end point is not among them.
    """
    rows = {int(v): i for i, v in enumerate(ids)}
    missing = sorted({int(v) for v in lengths.ids.ravel() if int(v) not in rows})
    if missing:
        raise InvalidInput(f"targets {missing} of a known length are not measured in two images: check the ids")
    return np.array([[rows[int(a)], rows[int(b)]] for a, b in lengths.ids], dtype=np.int64).reshape(-1, 2)


def distances(points: Array, rows: IntArray) -> tuple[Array, Array]:
    """Distances (k,) and their derivatives (k, 3t) by the coordinates."""
    difference = points[rows[:, 0]] - points[rows[:, 1]]
    distance = np.linalg.norm(difference, axis=1)
    unit = difference / distance[:, None]
    J = np.zeros((len(rows), len(points), 3))
    at = np.arange(len(rows))
    J[at, rows[:, 0]] += unit
    J[at, rows[:, 1]] -= unit
    return distance, J.reshape(len(rows), -1)


def bars_scale(
    lengths: Lengths, ids: IntArray, points: Array, Q: Array, *, scale_free: bool, limit: float
) -> tuple[float, str]:
    """Scale factor that brings a network adjusted without its bars to their lengths, and a note ('' if none).

    Parameters
    ----------
    Q : (3t, 3t) covariance of the coordinates. scale_free : false if a fixed datum gives the scale (factor 1).

    Raises
    ------
    InvalidInput : the bars contradict each other (or the fixed datum) by more than ``limit`` sigmas; names them.
    """
    rows = rows_of(lengths, ids)
    distance, J = distances(points, rows)
    if np.any(distance <= 0):
        raise InvalidInput("two targets of a scale bar have the same place in the images: check their ids")
    factor = float(np.median(lengths.length / distance)) if scale_free else 1.0
    C = factor**2 * J @ Q @ J.T + np.diag(lengths.sigma**2)
    root = linalg.cholesky(C, lower=True)
    design = linalg.solve_triangular(root, distance, lower=True)
    if scale_free:
        factor = float(design @ linalg.solve_triangular(root, lengths.length, lower=True) / (design @ design))
    if len(lengths) < 2 and scale_free:
        return factor, ""
    error = factor * distance - lengths.length
    # w-test for correlated observations (Baarda): the culprit has the largest one also where lengths are correlated
    P = linalg.cho_solve((root, True), np.eye(len(lengths)))
    if scale_free:
        P = P - np.outer(P @ distance, P @ distance) / (design @ design)
    w = P @ error / np.sqrt(np.maximum(np.diag(P), 1e-300))
    worst = int(np.argmax(np.abs(w)))
    names = [f"{a}-{b}" for a, b in lengths.ids.tolist()]
    ratio = lengths.length / distance
    if abs(w[worst]) > _NOTE:
        others = "the fixed targets" if not scale_free else "each other"
        table = ", ".join(
            f"{name}: {length * 1e3:.4f} mm stated, {r / ratio.mean() * 1e6 - 1e6:+.0f} ppm"
            for name, length, r in zip(names, lengths.length, ratio, strict=True)
        )
        size = np.ptp(ratio / ratio.mean()) * lengths.length[worst] if scale_free else abs(error[worst])
        text = (
            f"scale bars contradict {others} by {size * 1e3:.4f} mm ({abs(w[worst]):.1f} sigma), worst {names[worst]}; "
            f"{table}"
        )
        if abs(w[worst]) > limit:
            raise InvalidInput(f"{text}: check length_mm and targets of these bars, or leave the wrong one out")
        return factor, text
    return factor, ""


def length_results(
    lengths: Lengths, ids: IntArray, points: Array, Q: Array, kind: LengthKind, bars_sigma0: float = 1.0
) -> tuple[LengthResult, ...]:
    """Measured against expected lengths; check lengths with unmeasured end points are left out.

    The sigma of a scale bar is that of its residual (bar minus network, both correlated), of a check length the root of
    both variances.
    """
    known = set(ids.tolist())
    lengths = lengths.select(np.array([all(v in known for v in pair) for pair in lengths.ids.tolist()], dtype=bool))
    if len(lengths) == 0:
        return ()
    rows = rows_of(lengths, ids)
    distance, J = distances(points, rows)
    variance = np.einsum("ka,ab,kb->k", J, Q, J)
    out = []
    for (a, b), d, expected, v, s in zip(
        lengths.ids.tolist(), distance, lengths.length, variance, lengths.sigma, strict=True
    ):
        if kind == "scale_bar":
            sigma = float(np.sqrt(max((s * bars_sigma0) ** 2 - v, 0.0)))
        else:
            sigma = float(np.sqrt(v + np.nan_to_num(s) ** 2))
        error = float(d - expected)
        # a bar that alone gives the scale has no redundancy: its residual is zero by construction
        checked = kind == "check" or sigma > 1e-3 * s
        w = error / sigma if checked and sigma > 0 else 0.0
        out.append(LengthResult((a, b), float(d), float(expected), error, sigma if checked else 0.0, w, kind))
    return tuple(out)
