"""How a bundle adjustment is done."""

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True)
class AdjustSettings:
    """How to adjust.

    Attributes
    ----------
    robust : start with Huber weights, limit ``huber`` (standard deviations of a residual vector).
    snooping : take out marks whose residual is significant on the family-wise level ``snooping_level``; it is small
        because the tails of real marks are heavier than normal ones, and what lies in them does no harm.
    variance_components : estimate how far the marks (per group) and, from five redundant ones on, the scale bars
        scatter more or less than stated; otherwise the stated covariances are believed.
    undetermined : 'leave_out' holds intrinsics that the data do not determine at their start values and lists them,
        'raise' makes it an error. Focal lengths are never left out silently: held only if ``hold_focal``.
    bars_contradiction : scale bars that disagree by more than this many sigmas are an error.
    max_iterations, tolerance : of Gauss-Newton; tolerance on the promised relative decrease of the cost.
    """

    robust: bool = True
    huber: float = 2.5
    snooping: bool = True
    snooping_level: float = 1e-5
    variance_components: bool = True
    undetermined: Literal["leave_out", "raise"] = "leave_out"
    hold_focal: bool = False
    bars_contradiction: float = 6.0
    max_iterations: int = 60
    tolerance: float = 1e-9
