"""Parameters that the data cannot tell apart: elimination in an order of preference."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

Array = NDArray[np.float64]

RELATIVE_PIVOT = 1e-11
"""Squared; below this a column is numerically a combination of others."""


@dataclass(frozen=True)
class Eliminated:
    """A parameter that the data cannot tell apart.

    Attributes
    ----------
    name : of the parameter.
    reason : 'no influence', 'dependent' (a combination of others does the same), or 'weak' (its sigma would exceed what
        is plausible, so the data say nothing that was not known).
    tied_to : change of other parameters that does the same as one unit of this one; empty for no influence.
    sigma : standard deviation it would have with the others free (infinite where dependent).
    """

    name: str
    reason: str
    tied_to: Mapping[str, float]
    sigma: float


@dataclass(frozen=True)
class _Dropped:
    """A parameter that goes: its index, why, and the sigma it would have."""

    index: int
    reason: str
    sigma: float


def split_dependent(
    N: Array,
    names: Sequence[str],
    limits: Array | None = None,
    relative_pivot: float = RELATIVE_PIVOT,
    ties: bool = True,
) -> tuple[list[int], list[Eliminated]]:
    """Walk through the parameters in the given order; keep those that the ones kept so far cannot replace.

    Cholesky factorisation that skips a column whose pivot vanishes (Foerstner and Wrobel 2016, section 4.1), here also
    where the pivot, the information that is left, is too small for the plausible size of the parameter.

    Parameters
    ----------
    N : normal matrix (p, p) of whitened columns, in order of preference.
    names : names (p,).
    limits : largest sigma (p,) worth keeping; None for no such limit.
    relative_pivot : pivot over diagonal below which a column counts as dependent.
    ties : find out what the eliminated ones are tied to (else ``tied_to`` stays empty).

    Returns
    -------
    kept : indices in the order given.
    eliminated : the others with what they are tied to.
    """
    diagonal = np.diag(N)
    scale = np.sqrt(np.where(diagonal > 0, diagonal, 1.0))
    floor = np.zeros(len(names)) if limits is None else 1.0 / (np.asarray(limits) * scale) ** 2
    kept, dropped = _independent(N, scale, floor, relative_pivot)
    if limits is not None:
        kept, weak = _drop_weak_directions(N, kept, np.asarray(limits))
        dropped += weak
    tied = _ties(N, scale, names, kept, dropped) if ties and dropped else [{} for _ in dropped]
    return kept, [Eliminated(names[d.index], d.reason, t, d.sigma) for d, t in zip(dropped, tied, strict=True)]


def with_ties(N: Array, names: Sequence[str], kept: int, eliminated: Sequence[Eliminated]) -> list[Eliminated]:
    """The same eliminations, each tied to the parameters that were kept in the end.

    ``N`` (p, p), ``names`` (p,) : normal matrix of whitened columns, the ``kept`` ones first, then the eliminated.
    """
    scale = np.sqrt(np.where(np.diag(N) > 0, np.diag(N), 1.0))
    dropped = [_Dropped(kept + k, e.reason, e.sigma) for k, e in enumerate(eliminated)]
    tied = _ties(N, scale, names, list(range(kept)), dropped)
    return [replace(e, tied_to=t) for e, t in zip(eliminated, tied, strict=True)]


def _independent(N: Array, scale: Array, floor: Array, relative_pivot: float) -> tuple[list[int], list[_Dropped]]:
    """Indices whose pivots in the equilibrated matrix exceed ``relative_pivot`` and ``floor`` (p,), and the others."""
    p = len(N)
    diagonal = np.diag(N)
    largest = float(diagonal.max(initial=0.0))
    scaled = N / np.outer(scale, scale)
    if p and largest > 0 and np.all(diagonal > 1e-30 * largest):
        factor, failed = linalg.lapack.dpotrf(scaled, lower=1)
        if not failed and np.all(np.diag(factor) ** 2 > np.maximum(relative_pivot, floor)):
            return list(range(p)), []
    kept: list[int] = []
    dropped: list[_Dropped] = []
    rows = np.zeros((p, p), order="F")  # transposed Cholesky factor of the columns kept, grown column by column
    for k in range(p):
        m = len(kept)
        if diagonal[k] <= 1e-30 * largest or diagonal[k] == 0.0:
            dropped.append(_Dropped(k, "no influence", np.inf))
            continue
        part = scaled[kept, k]
        if m:
            part = linalg.blas.dtrsv(rows[:m, :m], part, trans=1)
        pivot = float(scaled[k, k] - part @ part)
        if pivot <= relative_pivot:
            dropped.append(_Dropped(k, "dependent", np.inf))
        elif pivot < floor[k]:
            dropped.append(_Dropped(k, "weak", float(1.0 / np.sqrt(pivot) / scale[k])))
        else:
            rows[:m, m], rows[m, m] = part, np.sqrt(pivot)
            kept.append(k)
    return kept, dropped


def _ties(
    N: Array, scale: Array, names: Sequence[str], kept: list[int], dropped: list[_Dropped]
) -> list[dict[str, float]]:
    """Changes of the kept parameters that do the same as one unit of each dropped one."""
    if not kept or not dropped:
        return [{} for _ in dropped]
    Nk = N[np.ix_(kept, kept)] / np.outer(scale[kept], scale[kept])
    right = N[np.ix_(kept, [d.index for d in dropped])] / scale[kept][:, None]
    shares = linalg.lstsq(Nk, right, cond=1e-14)[0]
    tied: list[dict[str, float]] = []
    for d, column in zip(dropped, shares.T, strict=True):
        share = np.abs(column / scale[d.index])  # in units of column norms: comparable between metres and radians
        strong = np.flatnonzero(share > 0.02 * max(1e-300, share.max()))
        none = d.reason == "no influence"
        tied.append({} if none else {names[kept[s]]: float(column[s] / scale[kept[s]]) for s in strong})
    return tied


def _drop_weak_directions(N: Array, kept: list[int], limits: Array) -> tuple[list[int], list[_Dropped]]:
    """Drop parameters until none has a sigma, with all others free, above what is plausible.

    Each may be well determined given those before it, and yet a mixture of many be open: then the last of them in the
    order of preference goes, whose fixing costs nothing since its own sigma is above its plausible size.
    """
    dropped: list[_Dropped] = []
    kept = list(kept)
    while True:
        bounded = [k for k in kept if np.isfinite(limits[k])]
        free = [k for k in kept if not np.isfinite(limits[k])]
        if not bounded:
            return kept, dropped
        M = N[np.ix_(bounded, bounded)]
        if free:
            across = N[np.ix_(free, bounded)]
            M = M - across.T @ linalg.lstsq(N[np.ix_(free, free)], across, cond=1e-14)[0]
        scaled = M * np.outer(limits[bounded], limits[bounded])
        factor, failed = linalg.lapack.dpotrf(scaled, lower=1)
        if not failed:
            inverse = linalg.lapack.dtrtri(factor, lower=1)[0]
            if np.einsum("ij,ij->j", inverse, inverse).max() < 1.0:
                return kept, dropped
        values, vectors = linalg.eigh(scaled, check_finite=False)
        sigma = np.sqrt(np.sum(vectors**2 / np.maximum(values, 1e-14 * values[-1]), axis=1))
        if sigma.max() < 1.0:
            return kept, dropped
        last = int(np.flatnonzero(sigma >= max(1.0, 0.3 * sigma.max()))[-1])
        dropped.append(_Dropped(bounded[last], "weak", float(sigma[last] * limits[bounded[last]])))
        kept.remove(bounded[last])
