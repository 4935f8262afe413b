"""The scan: every candidate's tangent columns, projected out of the fitted Jacobian, tested against the residuals.

All quantities are whitened. With `Q` an orthonormal basis of the fitted Jacobian, a candidate with columns `C` (scaled
by the prior amplitudes) is seen through `C - Q Q' C = U S V'`; its test statistic is `|U' r|^2` (an F test with the
estimated variance factor), its evidence against "nothing is missing" is the Bayes factor of a linear Gaussian model
whose amplitudes have the prior as standard deviation, averaged over six sizes of prior. Source: Kass and Raftery
(1995) for Bayes factors; Baarda (1968), Teunissen (2006) for detection, identification, adaptation.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import special, stats

from robcal.physics.cause import Array

PRIOR_SCALES = (0.03, 0.1, 0.3, 1.0, 3.0, 10.0)
"""Sizes of the prior amplitude over which the evidence is averaged."""
LEAST_SIGNAL = 0.05
"""Directions whose signal stays below this many sigma at the typical amplitude cannot be seen and are left out."""


@dataclass(frozen=True)
class Entry:
    """One candidate with fixed constants: index of its cause, of its grid point, its whitened columns (m, c), and, for
    a single column, the prior probability that its amplitude is positive."""

    cause: int
    grid: int
    columns: Array
    positive: float = 0.5


@dataclass(frozen=True)
class Stack:
    """All entries with the same number of columns, orthonormalised after projection.

    Attributes
    ----------
    cause, grid : (e,) indices.
    basis : (e, m, c) orthonormal columns U (zero where a direction cannot be seen).
    singular : (e, c) projected signal per prior amplitude, in sigma.
    right : (e, c, c) V'.
    count : (e,) directions that can be seen.
    positive : (e,) prior probability of a positive amplitude.
    """

    cause: Array
    grid: Array
    basis: Array
    singular: Array
    right: Array
    count: Array
    positive: Array


@dataclass(frozen=True)
class ScanResult:
    """Statistics of all entries, concatenated over the stacks.

    Attributes
    ----------
    cause, grid : (e,) indices. count : (e,) degrees of freedom.
    chi2 : (e,) squared norm of the projected residual, divided by the variance factor.
    log_p : (e,) natural logarithm of the single-test F probability.
    log_evidence : (e,) logarithm of the Bayes factor against no cause.
    variance_factor : residual variance without the best entry.
    redundancy : degrees of freedom of the residuals.
    """

    cause: Array
    grid: Array
    count: Array
    chi2: Array
    log_p: Array
    log_evidence: Array
    variance_factor: float
    redundancy: int

    @property
    def best(self) -> int:
        """Entry with the smallest single-test probability."""
        return int(np.argmin(self.log_p))


def orthonormal_basis(jacobian: Array) -> Array:
    """Orthonormal columns that span a (possibly rank-deficient) Jacobian (m, p)."""
    size = np.linalg.norm(jacobian, axis=0)
    scaled = jacobian[:, size > 0] / size[size > 0]
    values, vectors = np.linalg.eigh(scaled.T @ scaled)
    if len(values) and values[0] > 1e-5 * values[-1]:  # far from dependent: squared columns lose nothing that matters
        return np.asarray(scaled @ (vectors / np.sqrt(values)))
    U, s, _ = np.linalg.svd(scaled, full_matrices=False)
    return U[:, s > 1e-9 * s[0]] if len(s) else U


Fitted = Array | Callable[[Array], Array]
"""What a model absorbs: an orthonormal basis (m, p), or a function that removes it from columns (m, k)."""


def remove(fitted: Fitted, columns: Array) -> Array:
    """Columns (m, k) without what the fitted model absorbs."""
    if callable(fitted):
        return fitted(columns)
    return np.asarray(columns - fitted @ (fitted.T @ columns))


def stack_entries(entries: Sequence[Entry], fitted: Fitted) -> tuple[Stack, ...]:
    """Project all entries out of the fitted model and orthonormalise them, grouped by number of columns."""
    stacks = []
    for width in sorted({entry.columns.shape[1] for entry in entries}):
        group = [entry for entry in entries if entry.columns.shape[1] == width]
        projected = _projected(np.stack([entry.columns for entry in group]), fitted)
        cause, grid = (np.array([getattr(entry, name) for entry in group]) for name in ("cause", "grid"))
        stacks.append(_orthonormalised(projected, cause, grid, np.array([entry.positive for entry in group])))
    return tuple(stacks)


def restack(stacks: Sequence[Stack], further: Array) -> tuple[Stack, ...]:
    """The stacks with further orthonormal columns (m, k) projected out, which are orthogonal to what was before."""
    again = []
    for stack in stacks:
        projected = _projected(stack.basis * stack.singular[:, None, :], further)
        new = _orthonormalised(projected, stack.cause, stack.grid, stack.positive)
        again.append(replace(new, right=new.right @ stack.right))
    return tuple(again)


def _projected(columns: Array, fitted: Fitted) -> Array:
    """Columns (e, m, c) without what the model absorbs."""
    e, m, c = columns.shape
    flat = columns.transpose(1, 0, 2).reshape(m, -1)
    norms = np.linalg.norm(flat, axis=0)
    flat = remove(fitted, flat)
    # a column that vanishes against its own size is rounding noise
    flat[:, np.linalg.norm(flat, axis=0) < 1e-7 * norms] = 0.0
    return np.ascontiguousarray(flat.reshape(m, e, c).transpose(1, 0, 2))


def _orthonormalised(projected: Array, cause: Array, grid: Array, positive: Array) -> Stack:
    if projected.shape[2] == 1:
        singular = np.linalg.norm(projected, axis=1)
        right = np.ones((len(projected), 1, 1))
        basis = projected / np.where(singular > 0, singular, 1.0)[:, None, :]
    else:
        values, vectors = np.linalg.eigh(np.swapaxes(projected, 1, 2) @ projected)
        singular = np.sqrt(np.clip(values[:, ::-1], 0.0, None))
        vectors = vectors[:, :, ::-1]
        right = np.swapaxes(vectors, 1, 2)
        basis = projected @ (vectors / np.where(singular > 0, singular, 1.0)[:, None, :])
    seen = (singular > LEAST_SIGNAL) & (singular > 1e-5 * singular.max(axis=1, keepdims=True, initial=0.0))
    basis *= seen[:, None, :]
    return Stack(cause, grid, basis, singular * seen, right, seen.sum(axis=1), positive)


def log_bayes_factor(singular: Array, z: Array, positive: Array | None = None) -> Array:
    """Evidence of entries (e,) from singular values (e, c) in sigma per prior amplitude and scores z (e, c).

    With one column, ``positive`` (e,) is the prior probability of a positive amplitude: the normal prior's two halves
    then have unequal weights.
    """
    parts = []
    for scale in PRIOR_SCALES:
        gain = (scale * singular) ** 2
        part = np.sum(0.5 * z**2 * gain / (1.0 + gain) - 0.5 * np.log1p(gain), axis=1)
        if positive is not None and z.shape[1] == 1:
            chance = special.ndtr((z * np.sqrt(gain / (1.0 + gain)))[:, 0])
            part = part + np.log(2.0 * (positive * chance + (1.0 - positive) * (1.0 - chance)))
        parts.append(part)
    return np.asarray(np.logaddexp.reduce(parts, axis=0) - np.log(len(PRIOR_SCALES)))


def scan(stacks: Sequence[Stack], residual: Array, redundancy: int) -> ScanResult:
    """Test all entries against projected residuals (m,).

    Weakness: one variance factor for all rows; rows must be whitened with covariances right up to that factor.
    """
    scores = [residual @ stack.basis for stack in stacks]
    raw = np.concatenate([np.sum(z**2, axis=1) for z in scores])
    cause = np.concatenate([stack.cause for stack in stacks])
    grid = np.concatenate([stack.grid for stack in stacks])
    count = np.concatenate([stack.count for stack in stacks])
    total = float(residual @ residual)
    log_p = log_f_probability(raw, count, total, redundancy)
    best = int(np.argmin(log_p))
    variance = (total - raw[best]) / max(redundancy - count[best], 1)
    sigma = np.sqrt(max(variance, 1e-300))
    evidence = np.concatenate(
        [
            log_bayes_factor(stack.singular / sigma, z / sigma, stack.positive)
            for stack, z in zip(stacks, scores, strict=True)
        ]
    )
    evidence[count == 0] = -np.inf
    return ScanResult(cause, grid, count, raw / variance, log_p, evidence, float(variance), redundancy)


def log_f_probability(raw: Array, count: Array, total: Array | float, redundancy: int) -> Array:
    """Logarithm of the F test's probability that `count` columns explain `raw` of the `total` sum of squares."""
    left = np.maximum(redundancy - count, 1)
    used = np.maximum(count, 1)
    ratio = (raw / used) / (np.maximum(np.asarray(total) - raw, 1e-300) / left)
    return np.asarray(np.where(count > 0, stats.f.logsf(ratio, used, left), 0.0))
