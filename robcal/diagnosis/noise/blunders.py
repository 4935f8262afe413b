"""Isolated gross errors: one pose or one point whose residuals do not fit, reported apart from physics by evidence."""

from dataclasses import dataclass

import numpy as np

from robcal.diagnosis.scan.statistics import log_f_probability
from robcal.physics.cause import Array

BLUNDER_SIGNAL = 30.0
"""Prior size of a gross error in units of sigma."""


@dataclass(frozen=True)
class Suspect:
    """The group of rows that fits worst: its label, log-evidence (all groups weighed in) and log-probability, and the
    observations that it stands for."""

    label: int
    log_evidence: float
    log_p: float
    observations: tuple[int, ...] = ()


def worst_group(residual: Array, fitted: Array, group: Array, shapes: Array | None = None) -> Suspect:
    """Test of a free shift for each group of rows (a pose, or a point in a pose).

    The shift of a group of rows g is tested by `r_g' (I - Q_g Q_g')^-1 r_g` (Baarda's test for several gross errors).
    `residual` (m,) whitened and projected; `fitted` (m, p) orthonormal; `group` (m,) labels; `shapes` (m, k): the ways
    in which the rows of a group may be wrong together, each row by itself if not given.
    """
    redundancy = len(residual) - fitted.shape[1]
    total = float(residual @ residual)
    labels, inverse, counts = np.unique(group, return_inverse=True, return_counts=True)
    order = np.argsort(inverse, kind="stable")
    bounds = np.concatenate([[0], np.cumsum(counts)])
    variance = total / max(redundancy, 1)
    gain = BLUNDER_SIGNAL**2
    raw = np.zeros(len(labels))
    used = np.zeros(len(labels), dtype=int)
    kept: list[Array] = []
    for k in range(len(labels)):
        rows = order[bounds[k] : bounds[k + 1]]
        near, left = fitted[rows], residual[rows]
        if shapes is not None:
            ways = np.linalg.qr(shapes[rows])[0]
            near, left = ways.T @ near, ways.T @ left
        cofactor = np.eye(len(left)) - near @ near.T
        values, vectors = np.linalg.eigh(cofactor)
        seen = values > 0.02
        z = (vectors[:, seen].T @ left) / np.sqrt(values[seen])
        raw[k], used[k] = float(z @ z), int(seen.sum())
        kept.append(values[seen])
    log_p = log_f_probability(raw, used, total, redundancy)
    k = int(np.argmin(log_p))
    variance = max((total - raw[k]) / max(redundancy - used[k], 1), 1e-300)
    signal = gain * kept[k]
    evidence = 0.5 * raw[k] / variance * gain / (1 + gain) - 0.5 * float(np.sum(np.log1p(signal)))
    return Suspect(int(labels[k]), evidence - float(np.log(len(labels))), float(log_p[k]))
