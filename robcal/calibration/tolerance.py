"""Do the errors of a robot keep a tolerance, seen through a measurement that errs itself?

An error keeps (or misses) the tolerance beyond doubt where it does so by more than the expanded uncertainty of the
measurement; between is undecided (ISO 14253-1:2017, one-sided at 95 %). What that says of further poses is the lower
bound of a share (Clopper and Pearson 1934, Biometrika 26).
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy import stats

CONFIDENCE = 0.95
FEW = 0.05
"""Share of places beyond the tolerance up to which a robot is usable with care."""


@dataclass(frozen=True)
class Conformity:
    """Errors against a tolerance.

    Attributes
    ----------
    tolerance, largest, uncertainty : m; the uncertainty is expanded, of the measurement along an error.
    places : measured places; within, beyond : of these, what keeps and what misses the tolerance beyond doubt.
    over : places whose measured error is larger than the tolerance, in doubt or not.
    share : at least this share of further poses (drawn like these) keeps the tolerance, 95 % sure.
    """

    tolerance: float
    largest: float
    uncertainty: float
    places: int
    within: int
    beyond: int
    over: int
    share: float

    @property
    def undecided(self) -> int:
        """Places that the measurement is too coarse to judge."""
        return self.places - self.within - self.beyond

    @property
    def kept(self) -> bool:
        """Whether no measured error is larger than the tolerance."""
        return self.over == 0

    @property
    def statement(self) -> str:
        """One clause for people."""
        limit = f"the tolerance of {1e3 * self.tolerance:.4g} mm"
        largest = f"largest error {1e3 * self.largest:.3g} mm"
        if self.over:
            sure = "" if self.beyond == self.over else f", {self.beyond} of them beyond doubt"
            return f"{self.over} of {self.places} kept-out errors miss {limit}{sure} ({largest})"
        doubt = f", {self.undecided} of them too close to tell" if self.undecided else ""
        return f"all {self.places} kept-out errors keep {limit}{doubt} ({largest})"


def conformity(errors: ArrayLike, tolerance: float, sigma: float = 0.0) -> Conformity:
    """Errors (n,) m against a tolerance (m); ``sigma`` : of the measurement along a direction, m.

    Errors that are not finite count as no measurement.
    """
    e = np.asarray(errors, dtype=float)
    e = e[np.isfinite(e)]
    expanded = float(stats.norm.ppf(CONFIDENCE)) * (sigma if np.isfinite(sigma) else 0.0)
    over = int(np.sum(e > tolerance))
    inside = len(e) - over
    return Conformity(
        tolerance=tolerance,
        largest=float(e.max()) if len(e) else float("nan"),
        uncertainty=expanded,
        places=len(e),
        within=int(np.sum(e + expanded <= tolerance)),
        beyond=int(np.sum(e - expanded > tolerance)),
        over=over,
        share=float(stats.beta.ppf(1 - CONFIDENCE, inside, over + 1)) if inside else 0.0,
    )
