"""LinearCause-wise level of the scan: how small the smallest probability gets when nothing is missing.

The candidates are strongly correlated, so Bonferroni's number of tests is far too large. Residuals are simulated on
the same design, scanned, and the effective number of independent tests is read from the distribution of the smallest
probability. The noise has the tails that the residuals show: with long ones, causes that act in a few poses only are
found by chance far more often.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from robcal.diagnosis.scan.statistics import Fitted, Stack, log_f_probability, remove
from robcal.physics.cause import Array

CLEAR = 3.0
"""Standard deviations of the fourth moment of Gaussian residuals above which tails are long."""


@dataclass(frozen=True)
class FamilyWise:
    """Effective number of tests at the level of interest, and the simulated smallest log-probabilities (sorted)."""

    tests: float
    smallest: Array

    def probability(self, log_p: float) -> float:
        """LinearCause-wise probability of a smallest single-test probability."""
        single = np.exp(log_p)
        if self.tests * single < 1e-4:
            return float(min(1.0, self.tests * single))
        return float(-np.expm1(self.tests * np.log1p(-min(single, 1 - 1e-16))))


def tails(residual: Array, redundancy: int) -> float:
    """Degrees of freedom of Student's distribution with the tails of residuals (m,); infinite unless clearly long.

    By the fourth moment. Weakness: an effect in few rows lengthens the tails a little.
    """
    variance = float(residual @ residual) / max(redundancy, 1)
    excess = float(np.mean(residual**4)) / max(variance, 1e-300) ** 2 - 3.0
    if excess < CLEAR * np.sqrt(24.0 / len(residual)):
        return float(np.inf)
    return 4.0 + 6.0 / excess


def simulate(
    stacks: Sequence[Stack],
    fitted: Fitted,
    redundancy: int,
    rows: int,
    *,
    runs: int = 400,
    seed: int = 0,
    freedom: float = np.inf,
    block: Array | None = None,
) -> FamilyWise:
    """Simulate the scan's smallest probability under "nothing is missing".

    Parameters
    ----------
    fitted : what the model absorbs. rows : m, number of residuals.
    freedom, block : noise with long tails: blocks (m,) of rows, an observation each, follow Student's distribution.
    """
    rng = np.random.default_rng(seed)
    m = rows
    noise = rng.standard_normal((m, runs))
    if block is not None and np.isfinite(freedom):
        _, number = np.unique(block, return_inverse=True)
        noise *= np.sqrt((freedom - 2.0) / rng.chisquare(freedom, size=(int(number.max()) + 1, runs)))[number]
    noise = remove(fitted, noise)
    total = np.sum(noise**2, axis=0)
    smallest = np.zeros(runs)
    for stack in stacks:
        keep = stack.count > 0
        if not np.any(keep):
            continue
        basis, count = stack.basis[keep], stack.count[keep]
        e, _, c = basis.shape
        score = basis.transpose(0, 2, 1).reshape(e * c, m) @ noise
        raw = np.sum(score.reshape(e, c, runs) ** 2, axis=1)
        # the largest statistic among entries of equal count is enough
        for value in np.unique(count):
            largest = raw[count == value].max(axis=0)
            log_p = log_f_probability(largest, np.full(runs, value), total, redundancy)
            smallest = np.minimum(smallest, log_p)
    smallest.sort()
    # quantile match in the tail: P(min p < x) = 1 - (1 - x)^tests
    level = np.array([0.01, 0.02, 0.05, 0.1])
    at = np.exp(np.quantile(smallest, level))
    tests = float(np.exp(np.mean(np.log(np.log1p(-level) / np.log1p(-np.minimum(at, 0.999999))))))
    return FamilyWise(max(tests, 1.0), smallest)
