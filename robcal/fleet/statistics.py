"""Parameters of many calibrated robots: median and spread, outlying robots, differences between batches.

Median and median absolute deviation (Hampel 1974) are not moved by the robots that are looked for. A robot is outlying
by one of two tests, each at half of the wanted rate of false alarms: its largest deviation in units of spread and its
own standard deviation together (Sidak 1967 over its parameters), or the sum of all of them as chi-square with the
covariance of its parameters. Both statistics are scaled so that their medians over the fleet are what they should be,
because spreads estimated from few robots are too small as often as too large.

Batches are compared parameter by parameter: places by Kruskal and Wallis (1952), spreads by Brown and Forsythe (1974),
with Holm's (1979) correction over all comparisons.

Weakness: parameters that differ together between robots (other than through their covariances) count as independent.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import stats

from robcal.errors import InvalidInput
from robcal.transforms import Array

FEWEST = 8
"""Robots below which no spread can be told."""
SHARE = 0.5
"""Parameters that fewer robots have are left out."""
MAD = 1.482602218505602
"""Standard deviation over median absolute deviation of a normal distribution."""


@dataclass(frozen=True)
class Member:
    """A robot of the fleet: values (p,) of its parameters and their covariance (p, p); ``batch`` it came with."""

    name: str
    parameters: tuple[str, ...]
    values: Array
    covariance: Array
    batch: str = ""


@dataclass(frozen=True)
class ParameterStatistics:
    """One parameter over the fleet.

    Attributes
    ----------
    robots : how many have it. median : of their values. spread : standard deviation between robots, that of the
        estimates taken out. sigma : median standard deviation of an estimate.
    values, z : by robot; z is the deviation from the median over spread and sigma together.
    """

    name: str
    robots: tuple[str, ...]
    median: float
    spread: float
    sigma: float
    values: Array
    z: Array


@dataclass(frozen=True)
class Outlier:
    """A robot out of the ordinary: probability that an ordinary one deviates as much, and where (parameter: z)."""

    name: str
    p_value: float
    parameters: Mapping[str, float]


@dataclass(frozen=True)
class BatchDifference:
    """A parameter in which batches differ: 'place' or 'spread', corrected probability, medians by batch."""

    parameter: str
    kind: str
    p_value: float
    medians: Mapping[str, float]


@dataclass(frozen=True)
class Fleet:
    """What is usual and what is not."""

    parameters: tuple[ParameterStatistics, ...]
    outliers: tuple[Outlier, ...]
    differences: tuple[BatchDifference, ...]
    batches: Mapping[str, int]


def fleet(members: Sequence[Member], false_alarms: float = 0.01) -> Fleet:
    """Statistics of a fleet; ``false_alarms`` is the share of ordinary robots that may be called outlying.

    Raises
    ------
    InvalidInput : fewer than eight robots, or none with parameters in common.
    """
    if len(members) < FEWEST:
        raise InvalidInput(f"{len(members)} robots are too few to tell what is usual: at least {FEWEST} are needed")
    found = _parameters(members)
    if not found:
        raise InvalidInput("the robots have no parameters in common: identify them all with the same model")
    batches: dict[str, int] = {}
    for member in members:
        batches[member.batch] = batches.get(member.batch, 0) + 1
    outliers = _outliers(members, found, false_alarms)
    differences = _differences(members, found, 0.01) if len(batches) > 1 else ()
    return Fleet(found, outliers, differences, dict(sorted(batches.items())))


def _parameters(members: Sequence[Member]) -> tuple[ParameterStatistics, ...]:
    names = list(dict.fromkeys(name for member in members for name in member.parameters))
    found = []
    for name in names:
        having = [(m, m.parameters.index(name)) for m in members if name in m.parameters]
        if len(having) < max(FEWEST, SHARE * len(members)):
            continue
        values = np.array([m.values[k] for m, k in having])
        variances = np.array([m.covariance[k, k] for m, k in having])
        median = float(np.median(values))
        total = (MAD * float(np.median(np.abs(values - median)))) ** 2
        own = float(np.median(variances))
        spread = float(np.sqrt(max(total - own, 0.0)))
        z = (values - median) / np.sqrt(np.maximum(spread**2 + variances, 1e-300))
        robots = tuple(m.name for m, _ in having)
        found.append(ParameterStatistics(name, robots, median, spread, float(np.sqrt(own)), values, z))
    return tuple(found)


def _outliers(
    members: Sequence[Member], parameters: Sequence[ParameterStatistics], false_alarms: float
) -> tuple[Outlier, ...]:
    known = {p.name: p for p in parameters}
    largest, squares, degrees = (np.zeros(len(members)) for _ in range(3))
    each: list[dict[str, float]] = []
    for row, member in enumerate(members):
        columns = [k for k, name in enumerate(member.parameters) if name in known]
        names = [member.parameters[k] for k in columns]
        z = {name: float(known[name].z[known[name].robots.index(member.name)]) for name in names}
        each.append(z)
        if not names:
            continue
        d = member.values[columns] - np.array([known[name].median for name in names])
        spread = np.diag([known[name].spread ** 2 for name in names])
        covariance = member.covariance[np.ix_(columns, columns)] + spread
        scale = np.sqrt(np.maximum(np.diag(covariance), 1e-300))
        whitened = np.linalg.pinv(covariance / np.outer(scale, scale), rcond=1e-10, hermitian=True)
        squares[row] = (d / scale) @ whitened @ (d / scale)
        degrees[row] = len(names)
        largest[row] = max(abs(v) for v in z.values())
    with_any = degrees > 0
    # medians over the fleet are what they should be: half of the robots are beyond, half are not
    squares /= max(float(np.median(squares[with_any] / stats.chi2.median(degrees[with_any]))), 1e-300)
    largest /= max(float(np.median(largest[with_any] / _median_of_largest(degrees[with_any]))), 1e-300)
    p_sum = stats.chi2.sf(squares, np.maximum(degrees, 1))
    p_one = -np.expm1(np.maximum(degrees, 1) * np.log1p(-2 * stats.norm.sf(largest)))
    p = np.minimum(1.0, 2 * np.minimum(p_sum, p_one))
    found = []
    for row in np.flatnonzero(with_any & (p < false_alarms)).tolist():
        beyond = stats.norm.isf(0.005 / degrees[row])
        order = sorted(each[row].items(), key=lambda item: -abs(item[1]))
        named = [item for item in order if abs(item[1]) > beyond] or order[:3]
        found.append(Outlier(members[row].name, float(p[row]), dict(named)))
    return tuple(sorted(found, key=lambda o: o.p_value))


def _median_of_largest(degrees: Array) -> Array:
    """Median of the largest of so many absolute standard normal values."""
    return np.asarray(stats.norm.isf(-np.expm1(np.log(0.5) / degrees) / 2))


def _differences(
    members: Sequence[Member], parameters: Sequence[ParameterStatistics], level: float
) -> tuple[BatchDifference, ...]:
    batch = {m.name: m.batch for m in members}
    tests: list[tuple[float, str, str, dict[str, float]]] = []
    for p in parameters:
        groups: dict[str, list[float]] = {}
        for robot, value in zip(p.robots, p.values, strict=True):
            groups.setdefault(batch[robot], []).append(float(value))
        enough = {name: np.array(v) for name, v in sorted(groups.items()) if len(v) >= 4}
        if len(enough) < 2 or all(np.ptp(v) == 0 for v in enough.values()):
            continue
        medians = {name: float(np.median(v)) for name, v in enough.items()}
        tests.append((float(stats.kruskal(*enough.values()).pvalue), p.name, "place", medians))
        tests.append((float(stats.levene(*enough.values(), center="median").pvalue), p.name, "spread", medians))
    tests.sort(key=lambda t: t[0])
    found, corrected = [], 0.0
    for rank, (raw, name, kind, medians) in enumerate(tests):
        corrected = max(corrected, min(1.0, raw * (len(tests) - rank)))
        if corrected < level:
            found.append(BatchDifference(name, kind, corrected, medians))
    return tuple(found)
