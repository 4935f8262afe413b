"""What changed between two calibrations of one robot, and how sure that is."""

from dataclasses import dataclass

import numpy as np
from scipy import stats

from robcal.errors import InvalidInput
from robcal.fleet.statistics import Member


@dataclass(frozen=True)
class ParameterChange:
    """Change of a parameter, its standard deviation, and Holm's corrected probability of as much by chance."""

    name: str
    change: float
    sigma: float
    p_value: float


@dataclass(frozen=True)
class Change:
    """All changes, and the probability of as much altogether by chance (chi-square with both covariances)."""

    parameters: tuple[ParameterChange, ...]
    chi_square: float
    degrees: int
    p_value: float


def change(before: Member, after: Member) -> Change:
    """Changes of the parameters that both calibrations have; their errors count as independent.

    Raises
    ------
    InvalidInput : no parameters in common.
    """
    names = [name for name in before.parameters if name in after.parameters]
    if not names:
        raise InvalidInput(f"'{before.name}' and '{after.name}' have no parameters in common: nothing to compare")
    rows = [[m.parameters.index(name) for name in names] for m in (before, after)]
    d = after.values[rows[1]] - before.values[rows[0]]
    C = before.covariance[np.ix_(rows[0], rows[0])] + after.covariance[np.ix_(rows[1], rows[1])]
    sigma = np.sqrt(np.maximum(np.diag(C), 1e-300))
    correlation = C / np.outer(sigma, sigma)
    chi_square = float((d / sigma) @ np.linalg.pinv(correlation, rcond=1e-10, hermitian=True) @ (d / sigma))
    raw = 2 * stats.norm.sf(np.abs(d / sigma))
    corrected = np.empty(len(names))
    running = 0.0
    for rank, k in enumerate(np.argsort(raw, kind="stable")):
        running = max(running, min(1.0, float(raw[k]) * (len(names) - rank)))
        corrected[k] = running
    changes = tuple(
        ParameterChange(name, float(d[k]), float(sigma[k]), float(corrected[k])) for k, name in enumerate(names)
    )
    return Change(changes, chi_square, len(names), float(stats.chi2.sf(chi_square, len(names))))
